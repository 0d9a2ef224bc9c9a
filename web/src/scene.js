/** Draws the Gaussians with WebGL, when something has changed. */
import { SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { Outline } from "./outline.js";
import { Preview } from "./preview.js";
import { Splats } from "./splats.js";

/** Milliseconds per frame from which on a moving camera gets coarser frames. */
const SLOW = 120;
/** Milliseconds per frame from which on a changed answer is first drawn coarsely. */
const VERY_SLOW = 700;
/** Milliseconds without a change after which the finest frame is drawn. */
const REST = 200;
/** Milliseconds of rest after which a slow renderer adds the outline. */
const LONG_REST = 800;

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

/** Draws a scene with WebGL. Dispatches `frame` events, with `full` and `milliseconds`. */
export class SceneRenderer extends EventTarget {
  /** @param {HTMLCanvasElement} canvas @param {import("./view.js").View3D} view */
  constructor(canvas, view) {
    super();
    this.canvas = canvas;
    this.view = view;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    this.scene = new THREE.Scene();
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      enableLod: false,
      sortRadial: false,
      minAlpha: 1 / 255,
      onDirty: () => this.invalidate("order"),
    });
    this.scene.add(this.spark);
    this.outline = new Outline();
    this.outlined = false;
    this.preview = new Preview();
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
      url,
      fileType: SplatFileType.SPZ,
      lod: false,
      raycastable: false,
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
    const hidden = this.splats?.paint(codes, palette);
    this.invalidate(hidden ? "order" : "colors");
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
    if (on === this.outlined) return;
    this.outlined = on;
    this.invalidate("colors");
  }

  get slow() {
    return this.costs.full > SLOW;
  }

  /** Draws soon. @param {"camera" | "colors" | "order"} what Has changed. */
  invalidate(what) {
    this.changed = { what, when: performance.now() };
    if (what !== "colors") this.preview.ready = false;
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
    if (!this.splats || !this.view.placed) return;
    this.busy = true;
    const still = performance.now() - this.changed.when > REST || this.changed.what !== "camera";
    const known = this.frames > 0; // the first frame is coarse: it may take long
    const quick = this.costs.full < VERY_SLOW && !this.preview.ready;
    const full = known && (!this.slow || (still && (quick || this.coarse)));
    const milliseconds = await (this.preview.ready && !full ? this.renderPreview() : this.render(full));
    this.coarse = !full;
    this.busy = false;
    this.dispatchEvent(Object.assign(new Event("frame"), { full, milliseconds }));
    if (this.waiting) requestAnimationFrame(() => this.draw());
    else if (!full) this.timer = setTimeout(() => this.finish(), this.changed.what === "camera" ? REST : 0);
    else if (this.slow) this.timer = setTimeout(() => this.rest(), LONG_REST);
  }

  /** Adds the outline to a fine frame of a slow renderer, and prepares the next colors. */
  async rest() {
    const { renderer, scene, splats, view } = this;
    if (this.busy || this.waiting || !splats) return;
    this.busy = true;
    if (this.plain) this.outline.draw(renderer, scene, view.camera, splats);
    this.plain = false;
    if (!this.preview.ready) {
      await drawn(renderer);
      if (!this.waiting) this.preview.capture(renderer, scene, view.camera, splats);
    }
    await drawn(renderer);
    this.busy = false;
    if (this.waiting) requestAnimationFrame(() => this.draw());
  }

  /** Draws the fine frame after a coarse one. */
  finish() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => this.draw());
  }

  /** Shows new colors at once. @returns {Promise<number>} Milliseconds that the GPU took. */
  async renderPreview() {
    const start = performance.now();
    this.preview.draw(this.renderer, this.view.camera);
    await drawn(this.renderer);
    return performance.now() - start;
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
      this.costs[kind] = this.frames++ > 2 && this.costs[kind] ? (this.costs[kind] + milliseconds) / 2 : milliseconds;
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
