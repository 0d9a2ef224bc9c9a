/** The scene: draws the Gaussians with WebGL, when something has changed, and moves the camera. */
import { SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { Outline } from "./outline.js";
import { Splats } from "./splats.js";

/** Milliseconds per frame from which on a moving camera gets coarser frames. */
const SLOW = 120;
/** Milliseconds per frame from which on a changed answer is first drawn coarsely. */
const VERY_SLOW = 700;
/** Milliseconds without a change after which the finest frame is drawn. */
const REST = 200;
/** Milliseconds of rest after which a slow renderer adds the outline. */
const LONG_REST = 800;
/** Degrees of the vertical field of view at the start. */
const FOV = 55;

/** @typedef {{position: number[], look_at: number[], up: number[], fov?: number}} View */

/** @param {THREE.WebGLRenderer} renderer @returns {Promise<void>} Resolves when the GPU has drawn all so far. */
function drawn(renderer) {
  const gl = /** @type {WebGL2RenderingContext} */ (renderer.getContext());
  const fence = /** @type {WebGLSync} */ (gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0));
  gl.flush();
  return new Promise((resolve) => {
    const poll = () => {
      if (gl.isContextLost() || gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.SIGNALED) {
        gl.deleteSync(fence);
        resolve();
      } else setTimeout(poll, 4);
    };
    setTimeout(poll, 0);
  });
}

/** @returns {boolean} True if this browser can draw the scene itself. */
export function hasWebGL() {
  const gl = document.createElement("canvas").getContext("webgl2");
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return gl !== null;
}

/** The camera and its controls, with or without WebGL. Dispatches `move` events. */
export class View3D extends EventTarget {
  /** @param {HTMLElement} element Receives the pointer. */
  constructor(element) {
    super();
    this.element = element;
    this.camera = new THREE.PerspectiveCamera(FOV, 1, 0.01, 1000);
    this.animation = 0;
    this.smooth = true;
  }

  /** @param {number[]} up @param {number} radius Of the scene. */
  start(up, radius) {
    this.radius = radius;
    this.camera.near = radius / 2000;
    this.camera.far = radius * 200;
    this.camera.up.fromArray(up);
    this.controls = new OrbitControls(this.camera, this.element);
    this.controls.minDistance = radius / 500;
    this.controls.maxDistance = radius * 30;
    this.controls.zoomToCursor = true;
    this.controls.addEventListener("change", () => this.moved());
    this.controls.addEventListener("start", () => cancelAnimationFrame(this.animation));
    this.resize();
  }

  resize() {
    this.width = Math.max(1, this.element.clientWidth);
    this.height = Math.max(1, this.element.clientHeight);
    this.camera.aspect = this.width / this.height;
    this.camera.updateProjectionMatrix();
    this.moved();
  }

  moved() {
    this.dispatchEvent(new Event("move"));
  }

  /** @returns {View & {width: number, height: number}} */
  view() {
    return {
      position: this.camera.position.toArray(),
      look_at: this.controls.target.toArray(),
      up: this.camera.up.toArray(),
      fov: this.camera.fov,
      width: Math.round(this.width),
      height: Math.round(this.height),
    };
  }

  /** Camera in the convention of OpenCV, for pixels of the page. */
  intrinsics() {
    this.camera.updateMatrixWorld();
    const focal = this.height / 2 / Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2));
    const m = this.camera.matrixWorldInverse.clone().premultiply(new THREE.Matrix4().makeScale(1, -1, -1));
    const rows = m.transpose().toArray();
    return {
      K: [[focal, 0, this.width / 2], [0, focal, this.height / 2], [0, 0, 1]],
      world_to_camera: [0, 4, 8, 12].map((i) => rows.slice(i, i + 4)),
      width: Math.round(this.width),
      height: Math.round(this.height),
    };
  }

  /** @param {View} view @param {boolean} [animate] */
  go(view, animate = true) {
    cancelAnimationFrame(this.animation);
    const from = { position: this.camera.position.clone(), target: this.controls.target.clone(), fov: this.camera.fov };
    const to = {
      position: new THREE.Vector3().fromArray(view.position),
      target: new THREE.Vector3().fromArray(view.look_at),
      fov: view.fov ?? this.camera.fov,
    };
    const start = performance.now();
    const duration = animate && this.smooth && !matchMedia("(prefers-reduced-motion: reduce)").matches ? 450 : 0;
    const step = () => {
      const share = duration ? Math.min(1, (performance.now() - start) / duration) : 1;
      const eased = share * share * (3 - 2 * share);
      this.camera.position.lerpVectors(from.position, to.position, eased);
      this.controls.target.lerpVectors(from.target, to.target, eased);
      this.camera.fov = THREE.MathUtils.lerp(from.fov, to.fov, eased);
      this.camera.updateProjectionMatrix();
      this.controls.update();
      this.moved();
      if (share < 1) this.animation = requestAnimationFrame(step);
    };
    step();
  }

  /** Shows what a training image shows. @param {{world_to_camera: number[][], K: number[][], height: number}} camera */
  goToCamera({ world_to_camera: rows, K, height }) {
    const [right, down, forward] = rows.map((row) => new THREE.Vector3(row[0], row[1], row[2]));
    const position = new THREE.Vector3();
    [right, down, forward].forEach((axis, i) => position.addScaledVector(axis, -rows[i][3]));
    const depth = Math.max(this.controls.minDistance, this.controls.target.clone().sub(position).dot(forward));
    const look = position.clone().addScaledVector(forward, depth);
    const fov = THREE.MathUtils.radToDeg(2 * Math.atan(height / 2 / K[1][1]));
    const up = this.camera.up.toArray();
    this.go({ position: position.toArray(), look_at: look.toArray(), up, fov: Math.min(90, fov) });
  }

  /** Turns around the middle of the view. @param {number} right @param {number} up Radians. */
  turn(right, up) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const side = new THREE.Vector3().crossVectors(this.camera.up, offset).normalize();
    const steep = offset.angleTo(this.camera.up);
    offset.applyAxisAngle(side, -THREE.MathUtils.clamp(up, steep - Math.PI + 0.05, steep - 0.05));
    offset.applyAxisAngle(this.camera.up.clone().normalize(), right);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.moved();
  }

  /** @param {number} factor Of the distance. */
  zoom(factor) {
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
    this.moved();
  }

  /** @param {number} x @param {number} y Pixels of the element. */
  ray(x, y) {
    const caster = new THREE.Raycaster();
    this.camera.updateMatrixWorld();
    caster.setFromCamera(new THREE.Vector2((2 * x) / this.width - 1, 1 - (2 * y) / this.height), this.camera);
    return { origin: caster.ray.origin.toArray(), direction: caster.ray.direction.toArray() };
  }

  /** @param {number[]} point @returns {{x: number, y: number, visible: boolean}} Pixels of the element. */
  project(point) {
    const p = new THREE.Vector3().fromArray(point).project(this.camera);
    return { x: ((p.x + 1) / 2) * this.width, y: ((1 - p.y) / 2) * this.height, visible: p.z < 1 };
  }
}

/** Draws a scene with WebGL. Dispatches `frame` events, with `full` and `milliseconds`. */
export class SceneRenderer extends EventTarget {
  /** @param {HTMLCanvasElement} canvas @param {View3D} view */
  constructor(canvas, view) {
    super();
    this.canvas = canvas;
    this.view = view;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    this.scene = new THREE.Scene();
    this.spark = new SparkRenderer({
      renderer: this.renderer, enableLod: false, sortRadial: false, minAlpha: 1 / 255,
      onDirty: () => this.invalidate("order"),
    });
    this.scene.add(this.spark);
    this.outline = new Outline();
    this.outlined = false;
    /** @type {Splats | null} */
    this.splats = null;
    this.costs = { full: 0, coarse: 0 };
    this.coarseRatio = 0.5;
    this.changed = { what: "order", when: 0 };
    this.busy = this.waiting = this.coarse = this.plain = false;
    this.timer = 0;
    this.frames = 0;
    canvas.addEventListener("webglcontextlost", () => this.dispatchEvent(new Event("lost")));
    view.addEventListener("move", () => this.invalidate("camera"));
  }

  /** @param {string} url Of an SPZ file. @param {(share: number) => void} progress */
  async load(url, progress) {
    const mesh = new SplatMesh({
      url, fileType: SplatFileType.SPZ, lod: false, raycastable: false,
      onProgress: (event) => progress(event.total ? event.loaded / event.total : 0),
    });
    await mesh.initialized;
    this.splats = new Splats(this.spark, mesh.numSplats);
    this.scene.add(mesh);
    this.invalidate("order");
  }

  /** @param {string} css Color behind the scene. */
  setBackground(css) {
    this.renderer.setClearColor(new THREE.Color(css), 1);
    this.invalidate("colors");
  }

  /** @param {Uint8Array} codes @param {number[][]} palette */
  paint(codes, palette) {
    this.splats?.paint(codes, palette);
    this.invalidate("colors");
  }

  /** @param {number} position In -1..1; what is left of it keeps its own colors. -2: nothing. */
  setSplit(position) {
    if (this.splats) this.splats.uniforms.split.value = position;
    this.invalidate("colors");
  }

  /** @param {number} share In 0..1: 0 shows the colors of the scene, 1 those of the answer. */
  setBlend(share) {
    if (this.splats) this.splats.uniforms.blend.value = share;
    this.invalidate("colors");
  }

  /** @param {boolean} on */
  setOutline(on) {
    this.outlined = on;
    this.invalidate("colors");
  }

  get slow() {
    return this.costs.full > SLOW;
  }

  /** Draws soon. @param {"camera" | "colors" | "order"} what Has changed. */
  invalidate(what) {
    this.changed = { what, when: performance.now() };
    clearTimeout(this.timer);
    if (!this.waiting) {
      this.waiting = true;
      requestAnimationFrame(() => this.draw());
    }
  }

  /** Draws one frame, coarser if a fine one would come too late, and the fine one once nothing changes any more. */
  async draw() {
    if (this.busy) return;
    this.waiting = false;
    if (!this.splats) return;
    this.busy = true;
    const still = performance.now() - this.changed.when > REST || this.changed.what !== "camera";
    const full = !this.slow || (still && (this.costs.full < VERY_SLOW || this.coarse));
    const milliseconds = await this.render(full);
    this.coarse = !full;
    this.busy = false;
    this.dispatchEvent(Object.assign(new Event("frame"), { full, milliseconds }));
    if (this.waiting) requestAnimationFrame(() => this.draw());
    else if (!full) this.timer = setTimeout(() => this.finish(), this.changed.what === "camera" ? REST : 0);
    else if (this.plain) this.timer = setTimeout(() => this.addOutline(), LONG_REST);
  }

  /** Adds the outline to a fine frame of a slow renderer, which would otherwise come later. */
  async addOutline() {
    if (this.busy || this.waiting || !this.splats) return;
    this.busy = true;
    this.plain = false;
    this.outline.draw(this.renderer, this.scene, this.view.camera, this.splats);
    await drawn(this.renderer);
    this.busy = false;
    if (this.waiting) requestAnimationFrame(() => this.draw());
  }

  /** Draws the fine frame after a coarse one. */
  finish() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => this.draw());
  }

  /** @param {boolean} full @returns {Promise<number>} Milliseconds that the GPU took. */
  async render(full) {
    const { renderer, view } = this;
    const start = performance.now();
    const ratio = full ? Math.min(2, devicePixelRatio) : this.coarseRatio;
    if (renderer.getPixelRatio() !== ratio) renderer.setPixelRatio(ratio);
    const size = renderer.getSize(new THREE.Vector2());
    if (size.x !== view.width || size.y !== view.height) renderer.setSize(view.width, view.height, false);
    renderer.render(this.scene, view.camera);
    this.plain = full && this.outlined && this.slow;
    if (full && this.outlined && !this.slow && this.splats) {
      this.outline.draw(renderer, this.scene, view.camera, this.splats);
    }
    await drawn(renderer);
    const milliseconds = performance.now() - start;
    if (this.spark.activeSplats > 0) {
      const kind = full ? "full" : "coarse";
      this.costs[kind] = this.frames++ > 1 && this.costs[kind] ? (this.costs[kind] + milliseconds) / 2 : milliseconds;
      if (!full && milliseconds > 600 && this.coarseRatio > 0.25) this.coarseRatio /= 2;
      view.smooth = !this.slow;
    }
    return milliseconds;
  }

  /** @returns {Promise<Blob | null>} PNG of the scene as it is drawn. */
  async screenshot() {
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.renderer.render(this.scene, this.view.camera);
    if (this.outlined && this.splats) this.outline.draw(this.renderer, this.scene, this.view.camera, this.splats);
    return new Promise((resolve) => this.canvas.toBlob(resolve, "image/png"));
  }
}
