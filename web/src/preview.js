/**
 * Preview of new colors within milliseconds, for renderers that need a second per frame. It recolors a stored image of
 * the scene: each pixel gets the color of its nearest Gaussian.
 */
import * as THREE from "three";
import { fullScreenPass } from "./passes.js";
import { GRAY_LEVEL, WIDTH } from "./splats.js";

/** Width of the stored image relative to the page. */
const RATIO = 0.5;
const FRAGMENT = `
precision highp float;
precision highp int;
precision highp usampler2D;
uniform sampler2D own;
uniform sampler2D nearest;
uniform usampler2D codes;
uniform sampler2D palette;
uniform vec2 size;
uniform vec3 background;
uniform float split;
uniform float blend;
out vec4 color;
void main() {
  vec2 uv = gl_FragCoord.xy / size;
  vec4 base = texture(own, uv);
  ivec2 pixel = ivec2(uv * vec2(textureSize(nearest, 0)));
  vec4 found = texelFetch(nearest, pixel, 0);
  if (found.a > 0.5 && 2.0 * uv.x - 1.0 >= split) {
    ivec3 bytes = ivec3(round(found.rgb * 255.0));
    int index = bytes.x + 256 * bytes.y + 65536 * bytes.z;
    int code = int(texelFetch(codes, ivec2(index % ${WIDTH}, index / ${WIDTH}), 0).r);
    vec4 tint = texelFetch(palette, ivec2(code, 0), 0);
    float gray = texelFetch(palette, ivec2(code, 1), 0).r;
    vec3 level = vec3(${GRAY_LEVEL} * dot(base.rgb, vec3(0.3, 0.59, 0.11)));
    base.rgb = mix(mix(base.rgb, level, gray * blend), tint.rgb, tint.a * blend);
  }
  color = vec4(base.rgb + (1.0 - base.a) * background, 1.0);
}`;

export class Preview {
  constructor() {
    this.target = new THREE.WebGLRenderTarget(1, 1, { depthBuffer: false, count: 2 });
    this.target.textures[1].minFilter = this.target.textures[1].magFilter = THREE.NearestFilter;
    this.ready = false;
    this.uniforms = {
      own: { value: this.target.textures[0] },
      nearest: { value: this.target.textures[1] },
      size: { value: new THREE.Vector2() },
      background: { value: new THREE.Color() },
    };
    /** @type {THREE.Scene | null} */
    this.pass = null;
  }

  /**
   * Store an image of the scene in its trained colors.
   * @param {THREE.WebGLRenderer} renderer @param {THREE.Scene} scene @param {THREE.Camera} camera
   * @param {import("./splats.js").Splats} splats
   */
  capture(renderer, scene, camera, splats) {
    const size = renderer.getSize(new THREE.Vector2());
    this.target.setSize(Math.ceil(size.x * RATIO), Math.ceil(size.y * RATIO));
    const blend = splats.uniforms.blend.value;
    splats.uniforms.blend.value = 0;
    const opacity = renderer.getClearAlpha();
    renderer.getClearColor(this.uniforms.background.value);
    renderer.setClearColor(0, 0);
    renderer.setRenderTarget(this.target);
    renderer.render(scene, camera);
    renderer.setClearColor(this.uniforms.background.value, opacity);
    renderer.setRenderTarget(null);
    splats.uniforms.blend.value = blend;
    const { codes, palette, split } = splats.uniforms;
    Object.assign(this.uniforms, { codes, palette, split, blend: splats.uniforms.blend });
    this.pass ??= fullScreenPass(FRAGMENT, this.uniforms, THREE.NoBlending);
    this.ready = true;
  }

  /** Draw the stored image in the current colors. @param {THREE.WebGLRenderer} renderer @param {THREE.Camera} camera */
  draw(renderer, camera) {
    renderer.getDrawingBufferSize(this.uniforms.size.value);
    if (this.pass) renderer.render(this.pass, camera);
  }
}
