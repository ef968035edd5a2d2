// An agent that acts in the browser: load everything, then step in real time.

import { at } from "./dom.js";
import { Page, download } from "./page.js";
import { Panel } from "./panel.js";
import { Readout } from "./readout.js";
import { approach, controlsOf, defaultsOf, entriesOf, fragmentOf, fromFragment, thetaOf } from "./request.js";
import { createSimulator } from "./simulator.js";

const THIRD_PARTY = "third_party";
const MUJOCO = `${THIRD_PARTY}/@mujoco/mujoco/mujoco`;
const ONNX = `${THIRD_PARTY}/onnxruntime-web/dist`;
const AFTER_FALL = 1200; // [ms] before the next episode
const ANNOUNCE = 4; // [s] after a request, what was measured is read out

export const RUNTIME = `${ONNX}/ort-wasm-simd-threaded.wasm`;

/** Return the module of onnxruntime-web, once its WebAssembly is here. */
export async function runtimeOf(bytes) {
  const [ort, wasmBinary] = await Promise.all([import(`./${ONNX}/ort.wasm.min.mjs`), bytes]);
  ort.env.wasm.numThreads = 1; // more need headers that a static host does not send
  ort.env.wasm.wasmBinary = wasmBinary;
  return ort;
}

export class SimulatedPage extends Page {
  resting = "Resume";
  behind = 0.25; // [s] that a frame catches up at most; beyond this the agent acts slower than real time

  async load() {
    const { manifest } = this;
    const own = [...Object.values(manifest.models), ...Object.values(manifest.graphs)];
    const engines = [`${MUJOCO}.wasm`, RUNTIME];
    const files = download([...own, ...engines], manifest.downloads);
    // Each engine starts as soon as its own files are here.
    const mujoco = Promise.all([import(`./${MUJOCO}.js`), files.get(engines[0])]).then(([{ default: load }, wasmBinary]) =>
      load({ wasmBinary }),
    );
    const ort = runtimeOf(files.get(RUNTIME));
    const [simulator, drawing] = await Promise.all([createSimulator({ mujoco, ort, manifest, files }), import("./scene.js")]);
    this.simulator = simulator;
    try {
      this.scene = new drawing.Scene(at("scene"), this.simulator.kinematics, manifest.followed, manifest.scene);
    } catch (error) {
      this.cannotDraw(error);
    }
  }

  /** What buttons and keys do. */
  get actions() {
    return { push: () => this.push(), again: () => this.again() };
  }

  start() {
    const { manifest } = this;
    this.entries = entriesOf(manifest);
    at("scene").setAttribute("aria-label", `${manifest.picture}. Arrow keys turn the camera.`);
    this.explain(manifest.legend);
    this.readout = new Readout(manifest.measures, manifest.window);
    const ask = (name, value) => this.ask({ ...this.request, [name]: value });
    this.panel = new Panel(at("requests"), at("others"), this.entries, manifest.measures, ask, manifest.idle_note);
    at("legend").classList.toggle("pointing", this.panel.points);
    this.request = fromFragment(this.entries, location.hash, { ...defaultsOf(this.entries), ...manifest.opens });
    this.episode = 0;
    this.ask(this.request);
    this.again();
    addEventListener("resize", () => this.panel.measured(this.readout));
    addEventListener("hashchange", () => this.ask(fromFragment(this.entries, location.hash, this.request)));
    this.listen(this.actions);
    this.pause(matchMedia("(prefers-reduced-motion: reduce)").matches);
    at("loading").hidden = true;
    this.before = performance.now();
    this.next();
  }

  /** Take over what is asked for, from the next control step on. */
  ask(request) {
    this.request = request;
    this.simulator.style = Float32Array.from(thetaOf(this.entries, request));
    this.readout.clear();
    this.panel.request(request);
    this.panel.measured(this.readout);
    this.announceAt = this.time + ANNOUNCE;
    this.#steer(0);
    clearTimeout(this.writing); // browsers refuse when the address changes too often
    this.writing = setTimeout(() => history.replaceState(null, "", this.link), 200);
  }

  get link() {
    return new URL(fragmentOf(this.entries, this.request), location.href).href;
  }

  /** Let the controls approach what is asked for during some time [s]. */
  #steer(seconds) {
    const { controls } = this.simulator;
    const wanted = controlsOf(this.entries, this.request);
    this.manifest.controls.forEach((control, i) => (controls[i] = approach(control, controls[i], wanted[i], seconds)));
    const course = this.manifest.controls.findIndex(({ unit }) => unit === "deg");
    const length = this.manifest.measures.find(({ at_marks }) => at_marks);
    this.scene?.ask(length ? this.request[length.parameter] : null, course < 0 ? 0 : (controls[course] * Math.PI) / 180);
  }

  /** Begin an episode in another of the initial states. */
  again() {
    this.simulator.reset(this.episode++);
    this.simulator.controls = Float64Array.from(this.manifest.controls, (control) => control.default);
    this.#steer(0);
    this.readout.clear();
    this.panel.measured(this.readout);
    this.pending = 0;
    this.fell = null;
    this.tell("");
    this.announceAt = ANNOUNCE;
    this.scene?.restart();
    this.scene?.draw();
  }

  push() {
    if (this.paused) this.pause(false);
    this.simulator.push(2 * Math.PI * Math.random());
    this.tell(`Pushed with ${this.manifest.push.force} N`, 1000);
  }

  /** Time since the episode began [s]. */
  get time() {
    return this.simulator.steps * this.manifest.physics.control_step;
  }

  /** Draw another picture soon; if the agent cannot go on, say so. */
  next() {
    const stop = (error) => {
      console.error(error);
      this.tell(`The agent stopped: ${error.message}`);
    };
    requestAnimationFrame(() => this.frame().catch(stop));
  }

  async frame() {
    const now = performance.now(); // the time that the browser hands over lies in the past where drawing is slow
    const elapsed = (now - this.before) / 1000;
    this.before = now;
    const { control_step: step } = this.manifest.physics;
    if (!this.paused && this.fell === null) {
      const caught = Math.min(elapsed, this.behind);
      this.pending += caught;
      let steps = 0;
      for (; this.pending >= step && this.fell === null; steps++) {
        await this.advance();
        this.pending -= step;
      }
      this.#pace(elapsed, caught); // not the steps, which most pictures of a fast screen have none of
      if (steps) this.panel.measured(this.readout);
      this.scene?.draw(Math.min(this.pending / step, 1));
      at("clock").textContent = `${this.time.toFixed(1)} s`;
    } else {
      if (this.fell !== null && now - this.fell > AFTER_FALL) this.again();
      this.scene?.draw();
    }
    this.next();
  }

  /** One control step. */
  async advance() {
    this.#steer(this.manifest.physics.control_step);
    const { measured, mark, terminated } = await this.simulator.step();
    this.readout.add(this.time, measured);
    this.scene?.take();
    if (mark.every(Number.isFinite)) {
      const index = this.manifest.measures.findIndex(({ at_marks }) => at_marks);
      this.scene?.mark(mark, index < 0 ? null : measured[index]);
    }
    if (this.time >= this.announceAt) {
      this.announceAt = Infinity;
      at("announcement").textContent = this.panel.sentences(this.readout);
    }
    if (terminated) {
      this.fell = performance.now();
      const words = `The agent ${this.manifest.terminated} after ${this.time.toFixed(1)} s`;
      this.tell(words);
      at("announcement").textContent = words;
    }
  }

  /** Say so if the computer is slower than real time. */
  #pace(elapsed, simulated) {
    this.rate = 0.95 * (this.rate ?? 1) + 0.05 * (simulated / Math.max(elapsed, 0.001));
    if (this.rate < 0.7) this.scene?.spare();
    at("pace").textContent = this.rate < 0.9 ? `${this.rate.toFixed(1)} × real time` : "";
  }
}

/** Start the page of a manifest. */
export async function start(manifest) {
  const page = new SimulatedPage(manifest);
  await page.load();
  page.start();
}
