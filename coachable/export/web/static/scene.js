// Picture of a MuJoCo model from above a ground with a grid, with marks where feet have struck.

import * as THREE from "./third_party/three/build/three.module.min.js";

import { aim, fitting, orbit } from "./view.js";

const COLOURS = {
  light: { sky: "#e9edf1", ground: "#dfe5eb", fine: "#cdd5de", bold: "#b3bfcb", body: "#d9a066", label: "#3a4754", sun: 2.2, fill: 1.5 },
  dark: { sky: "#12171d", ground: "#1b222a", fine: "#27313b", bold: "#3a4855", body: "#d79a5f", label: "#c3cdd8", sun: 2.0, fill: 0.7 },
};
const SIDES = ["#0a63c2", "#7a3fb0"]; // right and left marks differ in brightness, too
const GROUND = 60; // [m]
const MARKS = 14;
const DISTANCE = { near: 2, far: 9 };
// Of mjtGeom.
const [PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX] = [0, 2, 3, 4, 5, 6];

export class Scene {
  /**
   * @param {HTMLCanvasElement} canvas  What to draw on.
   * @param {object} mujoco  The model and data of one state, as a `Simulator` has them.
   * @param {string} followed  Name of the body in the middle of the picture.
   * @throws If the browser has no WebGL.
   */
  constructor(canvas, { model, data }, followed) {
    this.canvas = canvas;
    this.data = data;
    this.body = model.body(followed).id;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = THREE.PCFSoftShadowMap;
    this.scene = new THREE.Scene();
    this.scene.fog = new THREE.Fog(0, 9, 24);
    this.camera = new THREE.PerspectiveCamera(36, 1, 0.1, 60);
    this.camera.up.set(0, 0, 1);
    this.view = { azimuth: -0.95, elevation: 0.2, distance: 4.2 };
    this.sun = new THREE.DirectionalLight("#fff4e2", 2);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    Object.assign(this.sun.shadow.camera, { left: -2.5, right: 2.5, top: 2.5, bottom: -2.5, near: 1, far: 12 });
    this.sun.shadow.radius = 4;
    this.fill = new THREE.HemisphereLight("#ffffff", "#8a97a5", 1);
    this.ground = new THREE.Mesh(new THREE.PlaneGeometry(GROUND, GROUND), new THREE.MeshLambertMaterial());
    this.ground.receiveShadow = true;
    this.skin = new THREE.MeshStandardMaterial({ roughness: 0.62, metalness: 0.02 });
    this.parts = partsOf(model, this.skin);
    this.marks = new THREE.Group();
    this.scene.add(this.sun, this.sun.target, this.fill, this.ground, this.marks, ...this.parts.map(({ mesh }) => mesh));
    this.target = new THREE.Vector3(0, 0, 0.85);
    this.drawn = 0; // [ms] when the picture was drawn last
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.dark.addEventListener("change", () => this.#paint());
    this.#paint();
    this.fit = fitting(this.renderer, this.camera, canvas, () => this.sparing);
    orbit(canvas, this.view, DISTANCE);
    this.restart();
  }

  /** Begin an episode: forget the marks and what was drawn before. */
  restart() {
    this.marks.clear();
    this.take();
    this.take();
  }

  /** Take over the state after a control step. */
  take() {
    const { geom_xpos: positions, geom_xmat: axes, xpos } = this.data;
    for (const part of this.parts) {
      [part.from, part.to] = [part.to, part.from];
      const i = part.index;
      const m = axes.subarray(9 * i, 9 * i + 9);
      part.to.position.fromArray(positions, 3 * i);
      matrix.set(m[0], m[1], m[2], 0, m[3], m[4], m[5], 0, m[6], m[7], m[8], 0, 0, 0, 0, 1);
      part.to.turn.setFromRotationMatrix(matrix);
    }
    const b = 3 * this.body;
    this.goal = [xpos[b], xpos[b + 1]];
  }

  /** Leave a mark on the ground. */
  mark([x, y, aheadX, aheadY, side], text) {
    const print = new THREE.Mesh(sole, new THREE.MeshBasicMaterial({ color: SIDES[side], transparent: true, opacity: 0.75 }));
    print.position.set(x, y, 0.004 + 0.0002 * this.marks.children.length);
    print.rotation.z = Math.atan2(aheadY, aheadX);
    const group = new THREE.Group();
    group.add(print);
    if (text) {
      const label = labelOf(text, this.colours.label);
      const across = side ? 1 : -1;
      const length = Math.hypot(aheadX, aheadY) || 1;
      label.position.set(x - (across * 0.2 * aheadY) / length, y + (across * 0.2 * aheadX) / length, 0.05);
      group.add(label);
    }
    this.marks.add(group);
    if (this.marks.children.length > MARKS) this.marks.remove(this.marks.children[0]);
    this.marks.children.forEach((old, i, all) => {
      old.children[0].material.opacity = 0.15 + 0.6 * ((i + 1) / all.length);
    });
  }

  /** Draw, a share of the way from the previous state to the latest. */
  draw(share = 1) {
    for (const { mesh, from, to } of this.parts) {
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

  #paint() {
    this.colours = COLOURS[this.dark.matches ? "dark" : "light"];
    const { sky, body, sun, fill } = this.colours;
    this.scene.background = new THREE.Color(sky);
    this.scene.fog.color.set(sky);
    this.skin.color.set(body);
    this.sun.intensity = sun;
    this.fill.intensity = fill;
    this.ground.material.map?.dispose();
    this.ground.material.map = gridOf(this.colours);
    this.ground.material.needsUpdate = true;
  }
}

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

function partsOf(model, material) {
  const parts = [];
  for (let index = 0; index < model.ngeom; index++) {
    const [a, b, c] = model.geom_size.subarray(3 * index, 3 * index + 3);
    const shape = shapeOf(model.geom_type[index], a, b, c);
    if (!shape) continue;
    const mesh = new THREE.Mesh(shape, material);
    mesh.castShadow = mesh.receiveShadow = true;
    const pose = () => ({ position: new THREE.Vector3(), turn: new THREE.Quaternion() });
    parts.push({ index, mesh, from: pose(), to: pose() });
  }
  return parts;
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
function gridOf({ ground, fine, bold }) {
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

function labelOf(text, colour) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [160, 64];
  const context = canvas.getContext("2d");
  context.font = "600 44px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillStyle = colour;
  context.fillText(text, 80, 32);
  const map = new THREE.CanvasTexture(canvas);
  map.colorSpace = THREE.SRGBColorSpace;
  const sprite = new THREE.Sprite(new THREE.SpriteMaterial({ map, depthWrite: false }));
  sprite.scale.set(0.26, 0.104, 1);
  return sprite;
}
