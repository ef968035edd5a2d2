// Drives the code of a page whose simulation is a graph in Node: node drive_steps.mjs SITE < TASK, where TASK is JSON;
// prints JSON.

import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const site = process.argv[2];
const read = (name) => new Uint8Array(readFileSync(join(site, name)));
const load = (name) => import(pathToFileURL(join(site, name)).href);
const { createStepSimulator } = await load("step_simulator.js");
const manifest = JSON.parse(readFileSync(join(site, "manifest.json"), "utf8"));
const ort = await load("third_party/onnxruntime-web/dist/ort.wasm.min.mjs");
ort.env.wasm.numThreads = 1;
ort.env.wasm.wasmBinary = read("third_party/onnxruntime-web/dist/ort-wasm-simd-threaded.wasm");
const files = new Map(Object.values(manifest.graphs).map((name) => [name, read(name)]));
const simulator = await createStepSimulator({ ort, manifest, files });

const tasks = {
  /** One control step from each of some states. */
  async replay({ style, states }) {
    simulator.style = Float32Array.from(style);
    const steps = [];
    for (const { memory, observation, action } of states) {
      simulator.restore(memory, observation);
      const { measured, terminated } = await simulator.advance(action);
      steps.push({ measured, terminated, memory: Array.from(simulator.memory), observation: Array.from(simulator.observation) });
    }
    return steps;
  },
  /** A drive from one of the starts, and how long a control step takes [ms]. */
  async drive({ style, steps, start }) {
    simulator.style = Float32Array.from(style);
    simulator.reset(start);
    const results = [];
    const begin = performance.now();
    for (let i = 0; i < steps; i++) results.push(await simulator.step());
    const milliseconds = (performance.now() - begin) / steps;
    return { milliseconds, results: results.map(({ measured, terminated }) => ({ measured, terminated })), seen: simulator.seen };
  },
};
const task = JSON.parse(readFileSync(0, "utf8"));
console.log(JSON.stringify(await tasks[task.name](task)));
