// An agent that acts in the browser, in a simulation that is an ONNX graph.

import { drawMap, gaugeOf, moveDots, showGauges } from "./dials.js";
import { at } from "./dom.js";
import { download } from "./page.js";
import { decode } from "./recording.js";
import { RUNTIME, SimulatedPage, runtimeOf } from "./simulated.js";
import { createStepSimulator } from "./step_simulator.js";

const SLOW = 200; // [ms] between pictures; if several in turn take longer, fewer details are drawn
const PAUSED = 2000; // [ms] between pictures, as in a tab that was hidden

class SteppedPage extends SimulatedPage {
  behind = 1; // a control step takes much less time than it simulates, so slow pictures need not slow the agent

  async load() {
    const { manifest } = this;
    const [graphs, shapes] = [Object.values(manifest.graphs), [manifest.figures, manifest.backdrop]];
    const files = download([...graphs, ...shapes, RUNTIME], manifest.downloads);
    at("scale").hidden = true;
    at("keys").textContent = "Keys: Space pauses, R starts again, arrows move the slider in focus or turn the camera.";
    at("map").toggleAttribute("hidden", !manifest.map);
    if (manifest.map) drawMap(manifest.map.outline, [manifest.map.colour]);
    const [ort, drawing, figures, backdrop, ...contents] = await Promise.all([
      runtimeOf(files.get(RUNTIME)),
      import("./live_scene.js"),
      ...shapes.map((name) => files.get(name).then(decode)),
      ...graphs.map((name) => files.get(name)),
    ]);
    const parts = new Map(graphs.map((name, i) => [name, contents[i]]));
    this.simulator = await createStepSimulator({ ort, manifest, files: parts });
    try {
      this.scene = new drawing.LiveScene(at("scene"), at("labels"), manifest, this.simulator, { figures, backdrop });
    } catch (error) {
      this.cannotDraw(error);
    }
  }

  get actions() {
    return { again: () => this.again() };
  }

  async frame() {
    const elapsed = performance.now() - this.before;
    if (elapsed < PAUSED) this.slow = elapsed > SLOW ? (this.slow ?? 0) + 1 : 0;
    if (this.slow > 5) this.scene?.spare();
    await super.frame();
  }

  again() {
    super.again();
    this.#tell();
  }

  async advance() {
    await super.advance();
    this.#tell();
  }

  /** Show gauges and map. */
  #tell() {
    const { gauges, values, map } = this.manifest;
    const { gauges: numbers, camera } = this.simulator.seen;
    const named = Object.fromEntries(values.map((name, i) => [name, numbers[i]]));
    showGauges(gauges.map((form) => gaugeOf(form, named)));
    if (map) moveDots(map.offset.map((offset, i) => offset + map.scale[i] * camera[i]));
  }
}

/** Start the page of a manifest. */
export async function start(manifest) {
  const page = new SteppedPage(manifest);
  await page.load();
  page.start();
}
