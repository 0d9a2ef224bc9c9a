/** WebGL renderer of the Gaussians, which draws a frame only after a change. */
import { SparkRenderer, SplatFileType, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";
import { Outline } from "./outline.js";
import { Preview } from "./preview.js";
import { Splats } from "./splats.js";

/** Milliseconds per frame above which frames are coarser while the camera moves. */
const SLOW = 120;
/** Milliseconds per frame above which the first frame with new colors is coarse. */
const VERY_SLOW = 700;
/** Milliseconds without a change before a frame at full resolution. */
const REST = 200;
/** Milliseconds without a change before a slow renderer adds the outline. */
const LONG_REST = 800;

/** @param {THREE.WebGLRenderer} renderer @returns {Promise<void>} Resolves when the GPU has finished. */
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

/** @param {HTMLCanvasElement} canvas @returns {THREE.WebGLRenderer | null} Null without WebGL 2. */
export function createRenderer(canvas) {
  try {
    return new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
  } catch {
    return null;
  }
}

/** @param {THREE.WebGLRenderer} renderer @returns {boolean} True if WebGL draws on the CPU. */
export function isSoftware(renderer) {
  const gl = renderer.getContext();
  const name = gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info")?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER);
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

/** WebGL renderer of a scene. It dispatches `frame` events with `full` and `milliseconds`. */
export class SceneRenderer extends EventTarget {
  /**
   * @param {THREE.WebGLRenderer} renderer
   * @param {import("./view.js").View3D} view
   * @param {() => boolean} covered True while an image from the server covers the canvas.
   */
  constructor(renderer, view, covered) {
    super();
    this.covered = covered;
    this.canvas = renderer.domElement;
    this.view = view;
    this.renderer = renderer;
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
    /** True after the first frame at full resolution. */
    this.finished = false;
    this.timer = 0;
    this.frames = 0;
    this.canvas.addEventListener("webglcontextlost", () => this.dispatchEvent(new Event("lost")));
    view.addEventListener("move", () => this.invalidate("camera"));
  }

  /** @param {string} url URL of an SPZ file. @param {(share: number) => void} progress */
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

  /** @param {string} css Background color. */
  setBackground(css) {
    this.renderer.setClearColor(new THREE.Color(css), 1);
    this.invalidate("colors");
  }

  /** @param {Uint8Array} codes @param {number[][]} palette */
  paint(codes, palette) {
    const hidden = this.splats?.paint(codes, palette);
    this.invalidate(hidden ? "order" : "colors");
  }

  /** @param {number} position Divider in -1..1, with trained colors to the left of it; -2 for no divider. */
  setSplit(position) {
    if (this.splats) this.splats.uniforms.split.value = position;
    this.invalidate("colors");
  }

  /** @param {number} share Blend in 0..1, from the trained colors (0) to the colors of the answer (1). */
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

  /** True if an image from the server will show new colors sooner than a frame. */
  get needsStill() {
    return !this.finished || (this.costs.full > VERY_SLOW && !this.preview.ready);
  }

  /** Schedule a new frame. @param {"camera" | "colors" | "order"} what Part of the scene that has changed. */
  invalidate(what) {
    this.changed = { what, when: performance.now() };
    if (what !== "colors") this.preview.ready = false;
    clearTimeout(this.timer);
    if (!this.waiting) {
      this.waiting = true;
      requestAnimationFrame(() => this.draw());
    }
  }

  /** Draw one frame, at low resolution if the renderer is slow, and schedule the frame at full resolution. */
  async draw() {
    if (this.busy) return;
    this.waiting = false;
    if (!this.splats || !this.view.placed) return;
    this.busy = true;
    const still = performance.now() - this.changed.when > REST || this.changed.what !== "camera";
    const known = this.frames > 0; // the first frame is coarse because it may take long
    const quick = this.costs.full < VERY_SLOW && !this.preview.ready;
    const full = this.covered() || (known && (!this.slow || (still && (quick || this.coarse))));
    const milliseconds = await (this.preview.ready && !full ? this.renderPreview() : this.render(full));
    this.coarse = !full;
    this.finished ||= full && this.spark.activeSplats > 0;
    this.busy = false;
    this.dispatchEvent(Object.assign(new Event("frame"), { full: full && !this.waiting, milliseconds }));
    if (this.waiting) requestAnimationFrame(() => this.draw());
    else if (!full) this.timer = setTimeout(() => this.finish(), this.changed.what === "camera" ? REST : 0);
    else if (this.slow) this.timer = setTimeout(() => this.rest(), LONG_REST);
  }

  /** Add the outline to a full frame of a slow renderer, and store an image for the preview of the next colors. */
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

  /** Draw the full frame after a coarse frame. */
  finish() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => this.draw());
  }

  /** Show a preview of new colors. @returns {Promise<number>} GPU time in milliseconds. */
  async renderPreview() {
    const start = performance.now();
    this.preview.draw(this.renderer, this.view.camera);
    await drawn(this.renderer);
    return performance.now() - start;
  }

  /** @param {boolean} full @returns {Promise<number>} GPU time in milliseconds. */
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

  /** @returns {Promise<Blob | null>} PNG of the current view. */
  async screenshot() {
    this.renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.renderer.render(this.scene, this.view.camera);
    if (this.outlined && this.splats) this.outline.draw(this.renderer, this.scene, this.view.camera, this.splats);
    return new Promise((resolve) => this.canvas.toBlob(resolve, "image/png"));
  }
}
