// Picture of a MuJoCo model from above a ground with a grid, with marks where feet have struck.

import * as THREE from "./third_party/three/build/three.module.min.js";

import { aim, drawnBySoftware, drawing, fitting, followTheme, orbit } from "./view.js";

// Light and sky; everything else has the colours of the manifest.
const LIGHTS = {
  light: { sky: "#dde7f0", sun: 2.2, fill: 1.6, label: "#18212b", behind: "rgba(255, 255, 255, 0.75)" },
  dark: { sky: "#141b24", sun: 1.5, fill: 0.8, label: "#e7ecf2", behind: "rgba(26, 33, 41, 0.75)" },
};
const GROUND = 60; // [m]
const MARKS = 24;
const DISTANCE = { near: 2, far: 9 };
const SIDE = [0.02, 0.7]; // [m], of the line at the requested length
const ARROW = { from: 0.45, length: 0.7 }; // [m], along the course
const LABEL = { width: 200, height: 64, scale: 0.0021 }; // [px], and metres per pixel
// Of mjtGeom.
const [PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX] = [0, 2, 3, 4, 5, 6];

export class Scene {
  /**
   * @param {HTMLCanvasElement} canvas  What to draw on.
   * @param {object} mujoco  The model and data of one state, as a `Simulator` has them.
   * @param {string} followed  Name of the body in the middle of the picture.
   * @param {object} looks  The manifest's scene: colours, marks and the viewpoint.
   * @throws If the browser has no WebGL.
   */
  constructor(canvas, { model, data }, followed, looks) {
    this.canvas = canvas;
    this.data = data;
    this.looks = looks;
    this.body = model.body(followed).id;
    Object.assign(this, drawing(canvas, looks.viewpoint, 0.1, 60));
    this.scene = new THREE.Scene();
    this.scene.fog = new THREE.Fog(0, 9, looks.viewpoint.far);
    this.sun = new THREE.DirectionalLight("#fff4e2", 2);
    this.sun.castShadow = !drawnBySoftware(this.renderer); // whose shaders for shadows take long to compile
    this.sun.shadow.mapSize.set(1024, 1024);
    Object.assign(this.sun.shadow.camera, { left: -2.5, right: 2.5, top: 2.5, bottom: -2.5, near: 1, far: 12 });
    this.sun.shadow.radius = 4;
    this.fill = new THREE.HemisphereLight("#ffffff", "#8a97a5", 1);
    this.ground = new THREE.Mesh(new THREE.PlaneGeometry(GROUND, GROUND), new THREE.MeshLambertMaterial());
    this.ground.receiveShadow = true;
    this.ground.material.map = gridOf(looks);
    this.parts = partsOf(model, looks);
    this.marks = new THREE.Group();
    this.line = flat(...SIDE, looks.asked);
    this.line.visible = false;
    this.arrow = arrowOf(looks.course);
    this.scene.add(this.sun, this.sun.target, this.fill, this.ground, this.marks, this.line, this.arrow, ...this.parts.map(({ mesh }) => mesh));
    this.target = new THREE.Vector3(0, 0, looks.viewpoint.height);
    this.asked = { length: null, course: 0 };
    this.drawn = 0; // [ms] when the picture was drawn last
    followTheme((theme) => this.#paint(LIGHTS[theme]));
    this.fit = fitting(this.renderer, this.camera, canvas, () => this.sparing);
    orbit(canvas, this.view, DISTANCE);
    this.restart();
  }

  /** Show what is asked for: the length of a step, or null, and the course [rad]. */
  ask(length, course) {
    this.asked = { length, course };
  }

  /** Begin an episode: forget the marks and what was drawn before. */
  restart() {
    this.marks.clear();
    this.last = null;
    this.take();
    this.take();
  }

  /** Take over the state after a control step. */
  take() {
    const { xpos } = this.data;
    for (const part of this.parts) {
      [part.from, part.to] = [part.to, part.from];
      part.place(part.to, this.data);
    }
    const b = 3 * this.body;
    this.goal = [xpos[b], xpos[b + 1]];
  }

  /** Leave a mark on the ground, with a value beside it or null. */
  mark([x, y, aheadX, aheadY, side], value) {
    const { marks, lengths, shortest } = this.looks;
    const print = new THREE.Mesh(sole, new THREE.MeshBasicMaterial({ color: marks[side], transparent: true }));
    print.position.set(x, y, 0.006 + 0.0002 * (this.marks.children.length % MARKS));
    print.rotation.z = Math.atan2(aheadY, aheadX);
    const group = new THREE.Group();
    group.add(print);
    if (value !== null && value >= shortest) {
      const label = labelOf(value.toFixed(2), this.colours);
      const across = side ? 1 : -1;
      const length = Math.hypot(aheadX, aheadY) || 1;
      label.position.set(x - (across * 0.24 * aheadY) / length, y + (across * 0.24 * aheadX) / length, 0.05);
      group.add(label);
    }
    this.last = [x, y];
    this.marks.add(group);
    if (this.marks.children.length > MARKS) this.marks.remove(this.marks.children[0]);
    this.marks.children.forEach((old, i, all) => {
      old.children[0].material.opacity = 0.25 + 0.75 * ((i + 1) / all.length);
      if (i < all.length - lengths && old.children[1]) old.remove(old.children[1]);
    });
  }

  /** Draw, a share of the way from the previous state to the latest. */
  draw(share = 1) {
    for (const { mesh, from, to } of this.parts) {
      mesh.scale.lerpVectors(from.scale, to.scale, share);
      mesh.position.lerpVectors(from.position, to.position, share);
      mesh.quaternion.slerpQuaternions(from.turn, to.turn, share);
    }
    const [x, y] = this.goal;
    const now = performance.now();
    const near = Math.hypot(x - this.target.x, y - this.target.y) < 1;
    const pull = near ? 1 - Math.exp(-0.008 * (now - this.drawn)) : 1;
    this.drawn = now;
    this.target.x += (x - this.target.x) * pull;
    this.target.y += (y - this.target.y) * pull;
    this.#aids();
    this.ground.position.set(Math.round(this.target.x), Math.round(this.target.y), 0);
    this.sun.position.copy(this.target).add(offset);
    this.sun.target.position.copy(this.target);
    aim(this.camera, this.target, this.view);
    this.fit();
    this.renderer.render(this.scene, this.camera);
  }

  /** Draw with less detail from now on, because the computer is too slow. */
  spare() {
    if (this.sparing) return;
    this.sparing = true;
    this.sun.castShadow = false;
  }

  /** Draw the line at the requested length from the last mark, and the arrow along the course. */
  #aids() {
    const { length, course } = this.asked;
    const [ahead, left] = [Math.cos(course), Math.sin(course)];
    this.line.visible = Boolean(this.last) && length !== null;
    if (this.line.visible) this.line.position.set(this.last[0] + length * ahead, this.last[1] + length * left, 0.012);
    this.line.rotation.z = this.arrow.rotation.z = course;
    this.arrow.position.set(this.target.x, this.target.y, 0.012);
  }

  #paint(colours) {
    this.colours = colours;
    const { sky, sun, fill } = colours;
    this.scene.background = new THREE.Color(sky);
    this.scene.fog.color.set(sky);
    this.sun.intensity = sun;
    this.fill.intensity = fill;
  }
}

const [up, along] = [new THREE.Vector3(0, 0, 1), new THREE.Vector3()];

const matrix = new THREE.Matrix4();
const offset = new THREE.Vector3(2, -3.2, 5.5);

/** Outline of a sole, 0.26 m long, around its middle. */
const sole = (() => {
  const shape = new THREE.Shape();
  shape.absellipse(0.065, 0, 0.065, 0.05, -Math.PI / 2, Math.PI / 2);
  shape.absellipse(-0.09, 0, 0.045, 0.038, Math.PI / 2, (3 * Math.PI) / 2);
  shape.closePath();
  return new THREE.ShapeGeometry(shape, 12);
})();

/** A coloured rectangle on the ground. */
function flat(length, width, color) {
  return new THREE.Mesh(new THREE.PlaneGeometry(length, width), new THREE.MeshBasicMaterial({ color }));
}

/** An arrow on the ground ahead of the origin. */
function arrowOf(colour) {
  const { from, length } = ARROW;
  const shaft = flat(length, 0.03, colour);
  shaft.position.x = from + length / 2;
  const barbs = [-1, 1].map((side) => {
    const barb = flat(0.2, 0.03, colour);
    barb.position.set(from + length - 0.07, 0.055 * side, 0);
    barb.rotation.z = -0.7 * side;
    return barb;
  });
  return new THREE.Group().add(shaft, ...barbs);
}

/** Geoms, capsules between bodies and balls on them, each with a function that finds its pose. */
function partsOf(model, { bodies, body, links, balls }) {
  const colours = new Map(Object.entries(bodies).map(([name, colour]) => [model.body(name).id, colour]));
  const parts = [];
  const add = (shape, color, place) => {
    const mesh = new THREE.Mesh(shape, new THREE.MeshStandardMaterial({ color, roughness: 0.62, metalness: 0.02 }));
    mesh.castShadow = mesh.receiveShadow = true;
    const pose = () => ({ position: new THREE.Vector3(), turn: new THREE.Quaternion(), scale: new THREE.Vector3(1, 1, 1) });
    parts.push({ mesh, place, from: pose(), to: pose() });
  };
  for (let index = 0; index < model.ngeom; index++) {
    const [a, b, c] = model.geom_size.subarray(3 * index, 3 * index + 3);
    const shape = shapeOf(model.geom_type[index], a, b, c);
    if (!shape) continue;
    add(shape, colours.get(model.geom_bodyid[index]) ?? body, ({ position, turn }, { geom_xpos, geom_xmat }) => {
      position.fromArray(geom_xpos, 3 * index);
      turned(turn, geom_xmat, index);
    });
  }
  for (const { bodies: [one, other], radius, colour } of links) {
    const [first, last] = [one, other].map((name) => model.body(name).id);
    add(new THREE.CylinderGeometry(radius, radius, 1, 24).rotateX(Math.PI / 2), colour, ({ position, turn, scale }, { xpos }) => {
      position.fromArray(xpos, 3 * first);
      along.fromArray(xpos, 3 * last).sub(position);
      position.addScaledVector(along, 0.5);
      scale.z = along.length();
      turn.setFromUnitVectors(up, along.normalize());
    });
  }
  for (const { body: name, at, diameter, colour } of balls) {
    const index = model.body(name).id;
    add(new THREE.SphereGeometry(diameter / 2, 16, 12), colour, ({ position, turn }, { xpos, xmat }) => {
      turned(turn, xmat, index);
      position.fromArray(at).applyQuaternion(turn).add(along.fromArray(xpos, 3 * index));
    });
  }
  return parts;
}

function turned(turn, axes, index) {
  const m = axes.subarray(9 * index, 9 * index + 9);
  turn.setFromRotationMatrix(matrix.set(m[0], m[1], m[2], 0, m[3], m[4], m[5], 0, m[6], m[7], m[8], 0, 0, 0, 0, 1));
}

/** Geometry of a geom; three's axis of capsules and cylinders is y, MuJoCo's is z. */
function shapeOf(type, a, b, c) {
  const upright = Math.PI / 2;
  switch (type) {
    case SPHERE: return new THREE.SphereGeometry(a, 32, 20);
    case CAPSULE: return new THREE.CapsuleGeometry(a, 2 * b, 10, 24).rotateX(upright);
    case ELLIPSOID: return new THREE.SphereGeometry(1, 32, 20).scale(a, b, c);
    case CYLINDER: return new THREE.CylinderGeometry(a, a, 2 * b, 32).rotateX(upright);
    case BOX: return new THREE.BoxGeometry(2 * a, 2 * b, 2 * c);
    case PLANE: // the ground is drawn without end
    default: return null;
  }
}

/** Texture of one metre of ground, with lines every half metre. */
function gridOf({ ground, lines: [fine, bold] }) {
  const size = 512;
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = size;
  const context = canvas.getContext("2d");
  context.fillStyle = ground;
  context.fillRect(0, 0, size, size);
  for (const [colour, at, width] of [[fine, size / 2, 5], [bold, 0, 8], [bold, size, 8]]) {
    context.fillStyle = colour;
    context.fillRect(at - width / 2, 0, width, size);
    context.fillRect(0, at - width / 2, size, width);
  }
  const texture = new THREE.CanvasTexture(canvas);
  texture.wrapS = texture.wrapT = THREE.RepeatWrapping;
  texture.repeat.set(GROUND, GROUND);
  texture.anisotropy = 8;
  texture.colorSpace = THREE.SRGBColorSpace;
  return texture;
}

function labelOf(text, { label, behind }) {
  const canvas = document.createElement("canvas");
  const { width, height, scale } = LABEL;
  [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext("2d");
  context.fillStyle = behind;
  if (context.roundRect) context.roundRect(36, 4, width - 72, height - 8, 14);
  else context.rect(36, 4, width - 72, height - 8); // older browsers
  context.fill();
  context.font = "600 44px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillStyle = label;
  context.fillText(text, width / 2, height / 2 + 2);
  const map = new THREE.CanvasTexture(canvas);
  map.colorSpace = THREE.SRGBColorSpace;
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map, depthWrite: false }));
  sprite.scale.set(scale * width, scale * height, 1);
  return sprite;
}
