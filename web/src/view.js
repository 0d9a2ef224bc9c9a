/** Camera of the page and its controls. */
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

/** Initial vertical field of view in degrees. */
const FOV = 55;

/** @typedef {{position: number[], look_at: number[], up: number[], fov?: number}} View */

/** Camera and controls, with or without WebGL. It dispatches `move` events. */
export class View3D extends EventTarget {
  /** @param {HTMLElement} element Target of events. @param {number[]} up @param {number} radius Scene radius. */
  constructor(element, up, radius) {
    super();
    this.element = element;
    this.width = this.height = 1;
    this.animation = 0;
    this.smooth = true;
    this.placed = false;
    this.camera = new THREE.PerspectiveCamera(FOV, 1, radius / 2000, radius * 200);
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

  /** @returns {Required<View> & {width: number, height: number}} */
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

  /** Return the camera in OpenCV's convention, for pixels of the page. */
  intrinsics() {
    this.camera.updateMatrixWorld();
    const focal = this.height / 2 / Math.tan(THREE.MathUtils.degToRad(this.camera.fov / 2));
    const m = this.camera.matrixWorldInverse.clone().premultiply(new THREE.Matrix4().makeScale(1, -1, -1));
    const rows = m.transpose().toArray();
    return {
      K: [
        [focal, 0, this.width / 2],
        [0, focal, this.height / 2],
        [0, 0, 1],
      ],
      world_to_camera: [0, 4, 8, 12].map((i) => rows.slice(i, i + 4)),
      width: Math.round(this.width),
      height: Math.round(this.height),
    };
  }

  /** @param {View} view @param {boolean} [animate] */
  go(view, animate = true) {
    cancelAnimationFrame(this.animation);
    this.placed = true;
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

  /** Move to a training camera. @param {{world_to_camera: number[][], K: number[][], height: number}} camera */
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

  /** Turn around the target of the camera. @param {number} right @param {number} up Angles in radians. */
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

  /** @param {number} factor Factor on the distance to the target. */
  zoom(factor) {
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
    this.moved();
  }

  /** @param {number} x @param {number} y Position in pixels of the element. */
  ray(x, y) {
    const caster = new THREE.Raycaster();
    this.camera.updateMatrixWorld();
    caster.setFromCamera(new THREE.Vector2((2 * x) / this.width - 1, 1 - (2 * y) / this.height), this.camera);
    return { origin: caster.ray.origin.toArray(), direction: caster.ray.direction.toArray() };
  }

  /** @param {number[]} point @returns {{x: number, y: number, visible: boolean}} Position in pixels. */
  project(point) {
    const p = new THREE.Vector3().fromArray(point).project(this.camera);
    return { x: ((p.x + 1) / 2) * this.width, y: ((1 - p.y) / 2) * this.height, visible: p.z < 1 };
  }

  /** @param {number[]} point @returns {boolean} True if the point is in view. */
  sees(point) {
    const { x, y, visible } = this.project(point);
    return visible && x >= 0 && y >= 0 && x <= this.width && y <= this.height;
  }
}
