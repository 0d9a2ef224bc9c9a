/** Outline that makes the selection visible in every color. */
import * as THREE from "three";
import { fullScreenPass } from "./passes.js";

const FRAGMENT = `
precision highp float;
uniform sampler2D mask;
uniform vec2 texel;
uniform float scale;
uniform float width;
out vec4 color;
float inside(vec2 offset, vec2 uv) { return texture(mask, uv + offset * texel).r; }
void main() {
  vec2 uv = gl_FragCoord.xy * texel.xy / scale;
  float own = inside(vec2(0.0), uv), near = own, far = own;
  for (int i = 0; i < 8; i++) {
    float angle = 0.7854 * float(i);
    vec2 way = vec2(cos(angle), sin(angle));
    near = max(near, inside(way * width, uv));
    far = max(far, inside(way * 2.0 * width, uv));
  }
  float core = smoothstep(0.4, 0.6, near) * (1.0 - smoothstep(0.4, 0.6, own));
  float halo = smoothstep(0.4, 0.6, far) * (1.0 - smoothstep(0.4, 0.6, own));
  float opacity = max(core, 0.55 * halo);
  color = vec4(vec3(core) * opacity, opacity);
}`;

/** Full-screen pass that draws the outline over a rendered frame. */
export class Outline {
  constructor() {
    this.target = new THREE.WebGLRenderTarget(1, 1, { depthBuffer: false });
    this.uniforms = {
      mask: { value: this.target.texture },
      texel: { value: new THREE.Vector2() },
      scale: { value: 1 },
      width: { value: 1 },
    };
    this.pass = fullScreenPass(FRAGMENT, this.uniforms, THREE.CustomBlending);
  }

  /**
   * @param {THREE.WebGLRenderer} renderer
   * @param {THREE.Scene} scene @param {THREE.Camera} camera
   * @param {import("./splats.js").Splats} splats
   */
  draw(renderer, scene, camera, splats) {
    const size = renderer.getDrawingBufferSize(new THREE.Vector2());
    const [width, height] = [Math.ceil(size.x / 2), Math.ceil(size.y / 2)];
    this.target.setSize(width, height);
    splats.uniforms.masked.value = true;
    const [background, opacity] = [renderer.getClearColor(new THREE.Color()), renderer.getClearAlpha()];
    renderer.setClearColor(0, 0);
    renderer.setRenderTarget(this.target);
    renderer.render(scene, camera);
    renderer.setClearColor(background, opacity);
    renderer.setRenderTarget(null);
    splats.uniforms.masked.value = false;
    const { uniforms } = this;
    uniforms.texel.value.set(1 / width, 1 / height);
    uniforms.scale.value = size.x / width;
    uniforms.width.value = Math.max(0.7, 0.6 * renderer.getPixelRatio());
    renderer.autoClear = false;
    renderer.render(this.pass, camera);
    renderer.autoClear = true;
  }
}
