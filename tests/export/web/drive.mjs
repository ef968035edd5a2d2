// Drives the page's own code in Node: node drive.mjs SITE < TASK, where TASK is JSON; prints JSON.

import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const site = process.argv[2];
const read = (name) => new Uint8Array(readFileSync(join(site, name)));
const load = (name) => import(pathToFileURL(join(site, name)).href);
const { createSimulator } = await load("simulator.js");
const manifest = JSON.parse(readFileSync(join(site, "manifest.json"), "utf8"));
const mujoco = await (await load("third_party/@mujoco/mujoco/mujoco.js")).default({
  wasmBinary: read("third_party/@mujoco/mujoco/mujoco.wasm"),
});
const ort = await load("third_party/onnxruntime-web/dist/ort.wasm.min.mjs");
ort.env.wasm.numThreads = 1;
ort.env.wasm.wasmBinary = read("third_party/onnxruntime-web/dist/ort-wasm-simd-threaded.wasm");
const names = [...Object.values(manifest.models), ...Object.values(manifest.graphs)];
const files = new Map(names.map((name) => [name, read(name)]));
const simulator = await createSimulator({ mujoco, ort, manifest, files });

const tasks = {
  /** Observations and measures of recorded states. */
  async replay({ start, style, states }) {
    simulator.restore(start.positions, new Float64Array(simulator.dynamics.model.nv), start.memory, start.observation);
    simulator.style = Float32Array.from(style);
    const steps = [];
    for (const { positions, velocities, sensors } of states) {
      const { measured, terminated } = await simulator.observe(positions, velocities, sensors);
      steps.push({ measured, terminated, observation: Array.from(simulator.observation) });
    }
    return steps;
  },
  /** States and sensors under recorded actions. */
  async physics({ start, actions }) {
    simulator.restore(start.positions, new Float64Array(simulator.dynamics.model.nv), start.memory, start.observation);
    return actions.map((action) => {
      simulator.advance(action);
      const sensors = Array.from(simulator.sense());
      return { positions: Array.from(simulator.dynamics.data.qpos), sensors };
    });
  },
  /** Measured values of whole walks. */
  async walk({ style, steps }) {
    simulator.style = Float32Array.from(style);
    simulator.reset(0);
    const results = [];
    for (let i = 0; i < steps; i++) results.push(await simulator.step());
    return results.map(({ measured, terminated }) => ({ measured, terminated }));
  },
};
const task = JSON.parse(readFileSync(0, "utf8"));
console.log(JSON.stringify(await tasks[task.name](task)));
