// Picture of recorded scenes: boxes, balls and cylinders that move, marks that stay, and what never moves.

import * as THREE from "./third_party/three/build/three.module.min.js";

import { make } from "./dom.js";
import { aim, drawing, fitting, followTheme, orbit } from "./view.js";

const COLOURS = {
  light: { sky: "#dde7f0", sun: 2.4, fill: 1.7 },
  dark: { sky: "#141b24", sun: 1.5, fill: 0.75 },
};
const SHAPES = ["box", "ball", "cylinder", "sector"]; // in the order of the files
const GEOMETRIES = {
  box: new THREE.BoxGeometry(1, 1, 1),
  ball: new THREE.SphereGeometry(0.5, 24, 16),
  cylinder: new THREE.CylinderGeometry(0.5, 0.5, 1, 24).rotateX(Math.PI / 2),
  sector: new THREE.CircleGeometry(0.5, 12, -Math.PI / 3, (2 * Math.PI) / 3).translate(0, 0, 0.5),
};
const GLOW = 0.45; // opacity of translucent primitives
const TURN = 32767; // a quaternion's 1
const SLOWLY = 4; // [1/s], how fast the camera follows a heading

export class RecordedScene {
  /**
   * @param {HTMLCanvasElement} canvas  What to draw on.
   * @param {HTMLElement} labels  Receives the texts in the scene.
   * @param {object} viewpoint  The manifest's viewpoint.
   * @throws If the browser has no WebGL.
   */
  constructor(canvas, labels, viewpoint) {
    this.canvas = canvas;
    this.labels = labels;
    this.viewpoint = viewpoint;
    Object.assign(this, drawing(canvas, viewpoint, 0.4, 1.5 * viewpoint.far));
    this.scene = new THREE.Scene();
    this.scene.background = new THREE.Color();
    this.scene.fog = new THREE.Fog(0, 0.35 * viewpoint.far, viewpoint.far);
    const { distance } = viewpoint;
    this.sun = new THREE.DirectionalLight("#fff4e2");
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    const reach = Math.max(distance, 4);
    Object.assign(this.sun.shadow.camera, { left: -reach, right: reach, top: reach, bottom: -reach, near: 1, far: 8 * reach });
    this.sunward = new THREE.Vector3(-0.45, -0.5, 1).multiplyScalar(3 * reach);
    this.fill = new THREE.HemisphereLight("#ffffff", "#8f979c");
    this.target = new THREE.Vector3();
    this.scene.add(this.sun, this.sun.target, this.fill);
    this.parts = new Swarm(this.scene, true);
    this.marks = new Swarm(this.scene, false);
    this.glows = new Swarm(this.scene, false, GLOW);
    this.still = new THREE.Group();
    this.scene.add(this.still);
    followTheme((theme) => this.#paint(COLOURS[theme]));
    this.fit = fitting(this.renderer, this.camera, canvas, () => this.sparing);
    orbit(canvas, this.view, { near: distance / 3, far: 4 * distance });
  }

  /** Show a decoded recording among its decoded backdrops. */
  play(recording, backdrops) {
    this.recording = recording;
    this.backdrops = backdrops;
    this.segment = null;
    this.place = null;
    this.heading = null;
    this.index = null;
  }

  /** Read marks and labels anew, because the recording has changed. */
  refresh() {
    this.index = null;
  }

  /** Draw a moment, in control steps from the start. */
  draw(moment) {
    const { segments, arrays } = this.recording;
    const index = Math.min(Math.floor(moment), this.recording.frames - 1);
    const number = segments.findIndex(({ first, frames }) => index < first + frames);
    const { first, frames, counts, place } = segments[number];
    if (place !== this.place) this.#build(this.backdrops[place]);
    this.place = place;
    const next = Math.min(index + 1, first + frames - 1);
    const share = next > index ? Math.min(moment - index, 1) : 0;
    this.#move(number, counts, index - first, next - first, share);
    if (index !== this.index) {
      for (const group of ["marks", "glows"]) this.#last(this[group], group, index);
      this.#write(index);
    }
    const [focus, heading] = [arrays.get("focus"), arrays.get("heading")];
    this.target.fromArray(focus, 3 * index).lerp(vector.fromArray(focus, 3 * next), share);
    this.#turn(heading[index] + share * Math.atan2(Math.sin(heading[next] - heading[index]), Math.cos(heading[next] - heading[index])));
    this.index = index;
    this.sun.position.copy(this.target).add(this.sunward);
    this.sun.target.position.copy(this.target);
    if (this.travels) this.still.position.set(Math.round(this.target.x), Math.round(this.target.y), 0);
    aim(this.camera, this.target, { ...this.view, azimuth: this.view.azimuth + (this.viewpoint.turns ? this.heading : 0) });
    this.fit();
    this.renderer.render(this.scene, this.camera);
    this.#placeLabels();
  }

  /** Draw with less detail from now on, because the computer is too slow. */
  spare() {
    this.sparing = true;
    this.sun.castShadow = false;
  }

  /** Turn the camera with the agent, smoothly unless the moment has jumped. */
  #turn(heading) {
    const now = performance.now();
    const apart = this.heading === null ? 0 : Math.atan2(Math.sin(heading - this.heading), Math.cos(heading - this.heading));
    const pull = this.heading === null ? 1 : 1 - Math.exp((-SLOWLY * (now - this.turned)) / 1000);
    this.heading = (this.heading ?? heading) + pull * apart;
    this.turned = now;
  }

  /** Place the moving primitives between two frames of a segment. */
  #move(number, counts, from, to, share) {
    const of = (name) => this.recording.arrays.get(`${number}/${name}`);
    const [figure, ownPlaces, ownTurns, places, turns] = ["figure", "own_positions", "own_turns", "positions", "turns"].map(of);
    const count = figure.length;
    const figures = count ? Math.max(...figure) : 0;
    if (this.segment?.number !== number || from < this.segment.at) {
      this.segment = { number, at: 0, changed: 0, sizes: of("sizes").slice(), colours: of("colours").slice() };
      this.segment.paint = true;
    }
    const { segment } = this;
    const [changedAt, changedPart, changedSize, changedColour] = ["at", "part", "size", "colour"].map((name) => of(`changed_${name}`));
    for (; segment.changed < changedAt.length && changedAt[segment.changed] <= from; segment.changed++) {
      const part = changedPart[segment.changed];
      for (let k = 0; k < 3; k++) {
        segment.sizes[3 * part + k] = changedSize[3 * segment.changed + k];
        segment.colours[3 * part + k] = changedColour[3 * segment.changed + k];
      }
      segment.paint = true;
    }
    segment.at = from;
    const poses = Array.from({ length: figures }, (_, f) => {
      const [a, b] = [from * figures + f, to * figures + f];
      vector.fromArray(places, 3 * a).lerp(other.fromArray(places, 3 * b), share);
      quaternion(turn, turns, 4 * a, TURN).slerp(quaternion(turned, turns, 4 * b, TURN), share);
      return new THREE.Matrix4().compose(vector, turn, one);
    });
    this.parts.show(counts, segment.paint && segment.colours, (part) => {
      size.fromArray(segment.sizes, 3 * part);
      matrix.compose(vector.fromArray(ownPlaces, 3 * part), quaternion(turn, ownTurns, 4 * part, 1), size);
      return figure[part] ? matrix.premultiply(poses[figure[part] - 1]) : matrix;
    });
    segment.paint = false;
  }

  /** Show the lasting primitives of a frame. */
  #last(swarm, group, index) {
    const of = (name) => this.recording.arrays.get(`${group}/${name}`);
    const [first, last, shapes, places, turns, sizes, colours] = ["first", "last", "shape", "positions", "turns", "sizes", "colours"].map(of);
    const shown = [];
    for (let row = 0; row < first.length && first[row] <= index; row++) if (last[row] >= index) shown.push(row);
    shown.sort((a, b) => shapes[a] - shapes[b]);
    const counts = Object.fromEntries(SHAPES.map((shape, s) => [shape, shown.filter((row) => shapes[row] === s).length]));
    const paint = new Uint8Array(shown.flatMap((row) => [...colours.subarray(3 * row, 3 * row + 3)]));
    swarm.show(counts, paint, (part) => {
      const row = shown[part];
      quaternion(turn, turns, 4 * row, TURN);
      return matrix.compose(vector.fromArray(places, 3 * row), turn, size.fromArray(sizes, 3 * row));
    });
  }

  /** Put what does not move into the scene. */
  #build({ surfaces, counts, travels, arrays }) {
    this.travels = travels;
    for (const child of this.still.children) child.geometry?.dispose();
    this.still.clear();
    this.still.position.set(0, 0, 0);
    surfaces.forEach(({ colour }, number) => {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(arrays.get(`${number}/vertices`), 3));
      geometry.setIndex(new THREE.BufferAttribute(arrays.get(`${number}/faces`), 1));
      geometry.computeVertexNormals();
      const mesh = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ color: colour }));
      mesh.receiveShadow = true;
      this.still.add(mesh);
    });
    const [places, turns, sizes] = ["positions", "turns", "sizes"].map((name) => arrays.get(name));
    new Swarm(this.still, true).show(counts, arrays.get("colours"), (part) => {
      quaternion(turn, turns, 4 * part, TURN);
      return matrix.compose(vector.fromArray(places, 3 * part), turn, size.fromArray(sizes, 3 * part));
    });
  }

  #write(index) {
    this.texts = this.recording.labels[index];
    const tags = [...this.labels.children];
    this.texts.forEach(([text], i) => {
      const tag = tags[i] ?? this.labels.appendChild(make("span", {}));
      if (tag.textContent !== text) tag.textContent = text;
    });
    tags.slice(this.texts.length).forEach((tag) => tag.remove());
  }

  #placeLabels() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.texts.forEach(([, ...place], i) => {
      const tag = this.labels.children[i];
      vector.fromArray(place).project(this.camera);
      tag.hidden = vector.z > 1 || Math.abs(vector.x) > 1 || Math.abs(vector.y) > 1;
      const [x, y] = [((vector.x + 1) / 2) * width, ((1 - vector.y) / 2) * height];
      tag.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px) translate(-50%, -100%)`;
    });
  }

  #paint({ sky, sun, fill }) {
    this.scene.background.set(sky);
    this.scene.fog.color.set(sky);
    this.sun.intensity = sun;
    this.fill.intensity = fill;
  }
}

/** Primitives of all shapes, with a place and a colour each. */
class Swarm {
  constructor(group, shadows, opacity = 1) {
    Object.assign(this, { group, shadows, meshes: {} });
    this.material = new THREE.MeshLambertMaterial({ transparent: opacity < 1, opacity, depthWrite: opacity === 1 });
  }

  /**
   * @param {object} counts  Number of primitives by shape.
   * @param {Uint8Array | false} colours  Colours in the order of the primitives, or false if they are as before.
   * @param {(part: number) => THREE.Matrix4} pose  Pose and size of a primitive.
   */
  show(counts, colours, pose) {
    let part = 0;
    for (const shape of SHAPES) {
      const mesh = this.#room(shape, counts[shape]);
      if (!mesh) continue;
      mesh.count = counts[shape];
      for (let i = 0; i < mesh.count; i++, part++) {
        mesh.setMatrixAt(i, pose(part));
        if (colours) mesh.setColorAt(i, colour.setRGB(...[0, 1, 2].map((k) => colours[3 * part + k] / 255), THREE.SRGBColorSpace));
      }
      mesh.instanceMatrix.needsUpdate = true;
      if (colours && mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
    }
  }

  #room(shape, count) {
    const known = this.meshes[shape];
    if (known?.instanceMatrix.count >= count || (!known && !count)) return known;
    known?.dispose();
    known?.removeFromParent();
    const mesh = new THREE.InstancedMesh(GEOMETRIES[shape], this.material, Math.ceil(1.5 * count));
    mesh.frustumCulled = false;
    mesh.castShadow = mesh.receiveShadow = this.shadows;
    this.meshes[shape] = mesh;
    this.group.add(mesh);
    return mesh;
  }
}

const [vector, other, size, one] = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Vector3(), new THREE.Vector3(1, 1, 1)];
const [turn, turned, matrix, colour] = [new THREE.Quaternion(), new THREE.Quaternion(), new THREE.Matrix4(), new THREE.Color()];

/** A rotation from w, x, y, z. */
function quaternion(target, values, at, unit) {
  return target.set(values[at + 1] / unit, values[at + 2] / unit, values[at + 3] / unit, values[at] / unit).normalize();
}
