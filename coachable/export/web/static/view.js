// What the scenes of all pages share: a camera that the visitor turns, and a picture as large as its place.

import * as THREE from "./third_party/three/build/three.module.min.js";

const LOWEST = 0.03; // [rad], elevation
const HIGHEST = 1.4;
const DEGREE = Math.PI / 180;
const TURN = 0.12; // [rad], per press of an arrow key
const NEARER = 0.87; // per press of a key

/**
 * Make a renderer with shadows, a camera, and the view that the visitor changes.
 *
 * @param {HTMLCanvasElement} canvas  What to draw on.
 * @param {{azimuth: number, elevation: number, distance: number}} viewpoint  Angles [deg] and distance [m] at first.
 * @param {number} near  Distance from which on the camera sees something [m].
 * @param {number} far  Distance up to which it does [m].
 * @throws If the browser has no WebGL.
 */
export function drawing(canvas, { azimuth, elevation, distance }, near, far) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  renderer.shadowMap.enabled = true;
  renderer.shadowMap.type = THREE.PCFSoftShadowMap;
  const camera = new THREE.PerspectiveCamera(45, 1, near, far);
  camera.up.set(0, 0, 1);
  return { renderer, camera, view: { azimuth: azimuth * DEGREE, elevation: elevation * DEGREE, distance } };
}

/** Call a function with "dark" or "light" now, and again whenever the visitor changes the browser's theme. */
export function followTheme(paint) {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const show = () => paint(dark.matches ? "dark" : "light");
  dark.addEventListener("change", show);
  show();
}

/**
 * Turn a view by dragging or with the arrow keys, and come nearer with the wheel, two fingers, plus and minus.
 *
 * @param {HTMLCanvasElement} canvas  Where the visitor drags.
 * @param {{azimuth: number, elevation: number, distance: number}} view  Angles [rad] and distance [m] to change.
 * @param {{near: number, far: number}} limits  Of the distance [m].
 */
export function orbit(canvas, view, limits) {
  const fingers = new Map();
  const zoom = (factor) => {
    view.distance = Math.min(Math.max(view.distance * factor, limits.near), limits.far);
  };
  const turn = (across, upwards) => {
    view.azimuth += across;
    view.elevation = Math.min(Math.max(view.elevation + upwards, LOWEST), HIGHEST);
  };
  const keys = {
    ArrowLeft: () => turn(-TURN, 0),
    ArrowRight: () => turn(TURN, 0),
    ArrowUp: () => turn(0, TURN),
    ArrowDown: () => turn(0, -TURN),
    "+": () => zoom(NEARER),
    "-": () => zoom(1 / NEARER),
  };
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  });
  canvas.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
    if (other) {
      const apart = ([x, y]) => Math.hypot(x - other[0], y - other[1]);
      zoom(apart(before) / Math.max(apart(now), 1));
    } else {
      turn(-0.008 * (now[0] - before[0]), 0.006 * (now[1] - before[1]));
    }
    fingers.set(event.pointerId, now);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(0.001 * event.deltaY));
  });
}

/** Whether the browser draws without a graphics card. */
export function drawnBySoftware(renderer) {
  const context = renderer.getContext();
  const named = context.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? context.RENDERER;
  return /swiftshader|llvmpipe|software/i.test(context.getParameter(named));
}

/** Put a camera at a view of a target. */
export function aim(camera, target, { azimuth, elevation, distance }) {
  const flat = distance * Math.cos(elevation);
  camera.position.set(flat * Math.cos(azimuth), flat * Math.sin(azimuth), distance * Math.sin(elevation));
  camera.position.add(target);
  camera.lookAt(target);
}

/** Return a function that makes the picture as large as its canvas, with fewer pixels if `isSparing` returns true. */
export function fitting(renderer, camera, canvas, isSparing) {
  let fitted = "";
  return () => {
    const { clientWidth: width, clientHeight: height } = canvas;
    const ratio = isSparing() ? 0.5 : Math.min(devicePixelRatio, 2);
    const wanted = [width, height, ratio].join();
    if (fitted === wanted) return;
    fitted = wanted;
    renderer.setPixelRatio(ratio);
    renderer.setSize(width, height, false);
    camera.aspect = width / Math.max(height, 1);
    camera.updateProjectionMatrix();
  };
}
