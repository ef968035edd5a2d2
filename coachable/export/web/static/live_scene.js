// Picture of a simulation that runs now: a recording of the latest two states, which is played while it is written.

import { RecordedScene } from "./recorded_scene.js";

const TURN = 32767; // a quaternion's 1 in a recording

export class LiveScene {
  /**
   * @param {HTMLCanvasElement} canvas  What to draw on.
   * @param {HTMLElement} labels  Receives the texts in the scene.
   * @param {object} manifest  Content of manifest.json.
   * @param {object} simulator  Its `seen` has the poses of the figures, new marks, and the camera.
   * @param {{figures: object, backdrop: object}} shapes  Decoded files.
   * @throws If the browser has no WebGL.
   */
  constructor(canvas, labels, manifest, simulator, { figures, backdrop }) {
    this.simulator = simulator;
    this.looks = manifest.marks;
    this.count = figures.figures;
    const empty = { first: new Uint32Array(0), last: new Uint32Array(0), shape: new Uint8Array(0), colours: new Uint8Array(0) };
    const group = { ...empty, positions: new Float32Array(0), turns: new Float32Array(0), sizes: new Float32Array(0) };
    const changes = { at: new Uint32Array(0), part: new Uint16Array(0), size: new Float32Array(0), colour: new Uint8Array(0) };
    this.arrays = new Map([
      ...[...figures.arrays].map(([name, array]) => [`0/${name}`, array]),
      ...Object.entries(changes).map(([name, array]) => [`0/changed_${name}`, array]),
      ...["marks", "glows"].flatMap((name) => Object.entries(group).map(([key, array]) => [`${name}/${key}`, array])),
      ["0/positions", new Float32Array(6 * this.count)],
      ["0/turns", new Float32Array(8 * this.count)],
      ["focus", new Float32Array(6)],
      ["heading", new Float32Array(2)],
    ]);
    const segments = [{ first: 0, frames: 2, counts: figures.counts, place: 0 }];
    this.scene = new RecordedScene(canvas, labels, manifest.viewpoint);
    this.scene.play({ frames: 2, segments, labels: [[], []], arrays: this.arrays }, [backdrop]);
    this.restart();
  }

  /** Begin an episode: forget the marks and what was drawn before. */
  restart() {
    this.marks = [];
    this.#mark();
    this.take();
    this.take();
  }

  /** Take over the state after a control step. */
  take() {
    const { figures, marks, camera } = this.simulator.seen;
    for (const [name, size] of [["0/positions", 3 * this.count], ["0/turns", 4 * this.count], ["focus", 3], ["heading", 1]]) {
      this.arrays.get(name).copyWithin(0, size);
    }
    for (let figure = 0; figure < this.count; figure++) {
      const pose = figures.slice(7 * figure, 7 * figure + 7);
      this.arrays.get("0/positions").set(pose.slice(0, 3), 3 * (this.count + figure));
      this.arrays.get("0/turns").set(pose.slice(3).map((value) => TURN * value), 4 * (this.count + figure));
    }
    this.arrays.get("focus").set(camera.slice(0, 3), 3);
    this.arrays.get("heading").set(camera.slice(3), 1);
    for (let at = 0; at < marks.length; at += 4) if (Number.isFinite(marks[at])) this.marks.push(marks.slice(at, at + 4));
    if (marks.some(Number.isFinite)) this.#mark();
    this.scene.refresh();
  }

  /** Draw, a share of the way from the previous state to the latest. */
  draw(share = 1) {
    this.scene.draw(share);
  }

  /** Draw with less detail from now on, because the computer is too slow. */
  spare() {
    this.scene.spare();
  }

  /** There is nothing to draw of a request. */
  ask() {}

  /** Write the marks into the recording. */
  #mark() {
    const { most, size, height, colour } = this.looks;
    this.marks.splice(0, this.marks.length - most);
    const write = (name, Kind, row) => this.arrays.set(`marks/${name}`, Kind.from(this.marks.flatMap(row)));
    write("first", Uint32Array, () => 0);
    write("last", Uint32Array, () => 1);
    write("shape", Uint8Array, () => 0); // boxes
    write("positions", Float32Array, ([x, y]) => [x, y, height]);
    write("turns", Float32Array, ([, , , turn]) => [Math.cos(turn / 2), 0, 0, Math.sin(turn / 2)].map((value) => TURN * value));
    write("sizes", Float32Array, ([, , length]) => [length, ...size]);
    write("colours", Uint8Array, () => colour);
  }
}
