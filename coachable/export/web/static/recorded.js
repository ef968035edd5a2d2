// A page that plays recorded episodes, one for each of some styles.

import { drawMap, moveDots, showGauges } from "./dials.js";
import { at } from "./dom.js";
import { Page, download, fetched } from "./page.js";
import { RecordedPanel } from "./recorded_panel.js";
import { decode, fragmentOf, fromFragment, nearest } from "./recording.js";

const AFTER_END = 1500; // [ms] before the recording begins anew
const SLOW = 0.2; // [s] between pictures; if several in turn take longer, fewer details are drawn
const PAUSED = 2; // [s] between pictures, as in a tab that was hidden

class RecordedPage extends Page {
  async load() {
    const { manifest } = this;
    const count = manifest.recordings.length;
    at("notice").textContent =
      `Recording: this page plays ${count} recorded ${count === 1 ? "episode" : "episodes"} of the agent, one for each ` +
      "style below, because this simulation is a Python program, which does not run in a browser.";
    at("notice").hidden = false;
    at("where").textContent = "Everything comes from this site.";
    at("scale").hidden = true;
    at("trained").hidden = true;
    at("scene").setAttribute("aria-label", "Recording of the agent. Arrow keys turn the camera.");
    at("keys").textContent = "Keys: Space pauses, R starts again, arrows move the slider in focus or turn the camera.";
    this.explain(manifest.legend);
    this.loaded = new Map();
    const { number, moment } = fromFragment(manifest, location.hash);
    const files = download([...manifest.backdrops, manifest.recordings[number].file], manifest.downloads);
    const decoded = [...files.values()].map((bytes) => bytes.then(decode));
    const drawing = await import("./recorded_scene.js");
    const recording = decoded.pop();
    this.loaded.set(number, recording);
    this.backdrops = await Promise.all(decoded);
    try {
      this.scene = new drawing.RecordedScene(at("scene"), at("labels"), manifest.viewpoint);
    } catch (error) {
      this.cannotDraw(error);
    }
    this.panel = new RecordedPanel(at("requests"), at("others"), manifest, (name, value) => this.ask(name, value));
    this.time = moment ?? 0; // [s]
    await this.select(number);
  }

  start() {
    addEventListener("hashchange", () => {
      const { number, moment } = fromFragment(this.manifest, location.hash);
      this.select(number, moment);
    });
    addEventListener("resize", () => this.panel.select(this.wanted));
    at("moment-row").hidden = false;
    at("moment").addEventListener("input", () => this.seek(Number(at("moment").value)));
    this.listen({ again: () => this.seek(0) });
    this.pause(matchMedia("(prefers-reduced-motion: reduce)").matches);
    at("loading").hidden = true;
    this.before = performance.now();
    requestAnimationFrame(() => this.frame());
    this.#prefetch();
  }

  /** Show the recording in which a parameter has a value, or the one with a number. */
  ask(name, value) {
    const { style } = this.manifest.recordings[this.wanted];
    this.select(name === null ? value : nearest(this.manifest, { ...style, [name]: value }, name));
  }

  /** Show a recording from a moment [s], or from the present one on. */
  async select(number, moment = null) {
    this.#choose(number);
    const recording = await this.#read(number).catch((error) => this.#miss(number, error));
    if (this.wanted !== number) return; // the visitor asked for something else meanwhile, or it is missing
    this.number = number;
    this.recording = recording;
    this.length = (recording.frames - 1) * this.manifest.control_step;
    at("moment").max = this.length.toFixed(1);
    this.scene?.play(recording, this.backdrops);
    this.shown = null;
    this.seek(moment ?? this.time);
    at("announcement").textContent = this.panel.sentences(number);
  }

  /** Say on the panel and in the address which recording is wanted. */
  #choose(number) {
    this.wanted = number;
    this.panel.select(number);
    clearTimeout(this.writing); // browsers refuse when the address changes too often
    this.writing = setTimeout(() => history.replaceState(null, "", fragmentOf(this.manifest, number)), 200);
  }

  /** Go on with the recording that is shown, because another one could not be loaded. */
  #miss(number, error) {
    if (this.number === undefined) throw error; // there is none yet
    console.error(error);
    if (this.wanted !== number) return;
    this.#choose(this.number);
    const words = "This recording could not be loaded: try again";
    this.tell(words, 4000);
    at("announcement").textContent = words;
  }

  /** Go to a moment [s]. */
  seek(moment) {
    this.time = Math.min(moment, this.length);
    at("moment").value = this.time;
    this.ended = null;
    this.tell("");
  }

  get link() {
    return new URL(fragmentOf(this.manifest, this.number, this.time), location.href).href;
  }

  frame() {
    const now = performance.now();
    const elapsed = (now - this.before) / 1000;
    this.before = now;
    if (elapsed < PAUSED) this.slow = elapsed > SLOW ? (this.slow ?? 0) + 1 : 0;
    if (this.slow > 5) this.scene?.spare();
    if (this.ended !== null && !this.paused && now - this.ended > AFTER_END) this.seek(0);
    else if (!this.paused && this.ended === null) {
      this.time = Math.min(this.time + Math.min(elapsed, 1), this.length);
      if (this.time >= this.length) this.#end(now);
    }
    this.#show();
    requestAnimationFrame(() => this.frame());
  }

  #show() {
    const moment = this.time / this.manifest.control_step;
    this.scene?.draw(moment);
    const index = Math.min(Math.floor(moment + 1e-6), this.recording.frames - 1);
    at("clock").textContent = `${this.time.toFixed(1)} s of ${this.length.toFixed(1)} s`;
    if (document.activeElement !== at("moment") || !this.paused) at("moment").value = this.time;
    at("moment").setAttribute("aria-valuetext", `${this.time.toFixed(1)} seconds`);
    if (index === this.shown) return;
    this.shown = index;
    showGauges(this.recording.gauges[index]);
    this.#map(index);
  }

  #end(now) {
    this.ended = now;
    const { terminated } = this.manifest.recordings[this.number];
    this.tell(terminated ? `The agent ${this.manifest.terminated} after ${this.length.toFixed(1)} s` : "The recording ends here");
  }

  #map(index) {
    const { map, arrays } = this.recording;
    at("map").toggleAttribute("hidden", !map);
    if (!map) return;
    if (at("map").dataset.of !== String(this.number)) {
      at("map").dataset.of = this.number;
      drawMap(map.outline, map.colours);
    }
    const width = 2 * map.colours.length;
    moveDots([...arrays.get("map").subarray(width * index, width * (index + 1))]);
  }

  #read(number) {
    if (!this.loaded.has(number)) {
      const { file } = this.manifest.recordings[number];
      const recording = fetched(file).then(async (answer) => decode(new Uint8Array(await answer.arrayBuffer())));
      this.loaded.set(number, recording);
      recording.catch(() => this.loaded.delete(number)); // so that it can be tried again
    }
    return this.loaded.get(number);
  }

  /** Load the other recordings one after the other, so that the sliders act at once. */
  async #prefetch() {
    for (const number of this.manifest.recordings.keys()) await this.#read(number).catch(() => {});
  }
}

/** Start the page of a manifest. */
export async function start(manifest) {
  const page = new RecordedPage(manifest);
  await page.load();
  page.start();
}
