/**
 * Extension of Spark's renderer that adds one color byte per Gaussian, and batches of Gaussians as instances.
 *
 * The shader looks up colors while it draws a frame. Geometry, spherical harmonics and sort order do not change, so a
 * new answer needs no sorting, and the next frame shows it. Hidden Gaussians keep their position in the sort order.
 * Software WebGL draws instances one by one; batches make it four times as fast.
 *
 * The extension patches the shaders of Spark, whose version is pinned; `patched` throws if a line is missing.
 */
import * as THREE from "three";

/** Gaussians per instance. */
const BATCH = 256;
/** Width of the texture of codes. */
export const WIDTH = 2048;
/** Brightness of unselected Gaussians, relative to the gray value of their trained colors. */
export const GRAY_LEVEL = 0.8;
/** Minimum opacity of the nearest Gaussian of a pixel. */
const OPAQUE = 0.3;
/** Code of Gaussians that are not drawn. */
const HIDDEN = 255;

const UNIFORMS = `
uniform int lastSplat;
uniform usampler2D codes;
uniform sampler2D palette;
uniform float split;
uniform float blend;
uniform bool masked;
uniform usampler2D ordering;`;
const NUMBER = `
    int splatNumber = gl_InstanceID * ${BATCH} + int(position.z);
    if (splatNumber >= lastSplat) return;
    ivec2 orderingCoord`;
const COLOR = `
    uint code = texelFetch(codes, ivec2(int(splatIndex) % ${WIDTH}, int(splatIndex) / ${WIDTH}), 0).r;
    if (code == ${HIDDEN}u) return;
    vec4 tint = texelFetch(palette, ivec2(int(code), 0), 0);
    float gray = texelFetch(palette, ivec2(int(code), 1), 0).r;
    if (masked) {
        rgba.rgb = vec3(tint.a > 0.0 ? 1.0 : 0.0);
    } else if (clipCenter.x >= split * clipCenter.w) {
        vec3 level = vec3(${GRAY_LEVEL} * dot(rgba.rgb, vec3(0.3, 0.59, 0.11)));
        rgba.rgb = mix(mix(rgba.rgb, level, gray * blend), tint.rgb, tint.a * blend);
    }
    vRgba = rgba;`;
/** Size of a triangle, which ends at the minimum drawn opacity of its Gaussian. */
const TIGHT = `
    vRgba.a = rgba.a;
    if (rgba.a <= 1.0) {
        adjustedStdDev = min(adjustedStdDev, sqrt(2.0 * log(rgba.a / minAlpha)));
        vSplatUv = position.xy * adjustedStdDev;
    }`;

/** Nearest Gaussian of each pixel for a second render target. Opacity 1 replaces the previous value, 0 keeps it. */
const NEAREST = `fragColor = vec4(rgba.rgb * rgba.a, rgba.a);
    uvec3 bytes = uvec3(vSplatIndex, vSplatIndex >> 8, vSplatIndex >> 16) & 255u;
    nearest = rgba.a > ${OPAQUE} ? vec4(vec3(bytes) / 255.0, 1.0) : vec4(0.0);`;

/** @param {string} shader @param {[string, string][]} changes @returns {string} */
function patched(shader, changes) {
  return changes.reduce((text, [from, to]) => {
    if (!text.includes(from)) throw new Error(`Spark's shader has no line "${from}".`);
    return text.replaceAll(from, to);
  }, shader);
}

/** @returns {THREE.InstancedBufferGeometry} Triangles around the unit circle; z is the number within the batch. */
function batchGeometry() {
  const corners = [
    [0, 2],
    [-Math.sqrt(3), -1],
    [Math.sqrt(3), -1],
  ];
  const position = new Float32Array(9 * BATCH);
  for (let i = 0; i < BATCH; i++) corners.forEach(([x, y], corner) => position.set([x, y, i], 9 * i + 3 * corner));
  const geometry = new THREE.InstancedBufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(position, 3));
  return geometry;
}

/** @param {number} count @returns {THREE.DataTexture} One byte per Gaussian. */
function codeTexture(count) {
  const rows = Math.max(1, Math.ceil(count / WIDTH));
  const data = new Uint8Array(rows * WIDTH);
  const texture = new THREE.DataTexture(data, WIDTH, rows, THREE.RedIntegerFormat, THREE.UnsignedByteType);
  texture.internalFormat = "R8UI";
  texture.unpackAlignment = 1;
  texture.needsUpdate = true;
  return texture;
}

/** Gaussians of a scene with a single mesh. */
export class Splats {
  /** @param {import("@sparkjsdev/spark").SparkRenderer} spark @param {number} count Number of Gaussians. */
  constructor(spark, count) {
    this.spark = spark;
    this.count = count;
    this.codes = codeTexture(count);
    this.palette = new THREE.DataTexture(new Float32Array(256 * 2 * 4), 256, 2, THREE.RGBAFormat, THREE.FloatType);
    this.palette.needsUpdate = true;
    this.uniforms = {
      lastSplat: { value: 0 },
      codes: { value: this.codes },
      palette: { value: this.palette },
      split: { value: -2 },
      blend: { value: 1 },
      masked: { value: false },
    };
    Object.assign(spark.uniforms, this.uniforms);
    spark.material.vertexShader = patched(spark.material.vertexShader, [
      ["gl_InstanceID", "splatNumber"],
      ["uniform usampler2D ordering;", UNIFORMS],
      ["ivec2 orderingCoord", NUMBER],
      ["vRgba = rgba;", COLOR],
      ["vRgba.a = rgba.a;", TIGHT],
    ]);
    spark.material.fragmentShader = patched(spark.material.fragmentShader, [
      ["out vec4 fragColor;", "layout(location = 0) out vec4 fragColor;\nlayout(location = 1) out vec4 nearest;"],
      ["fragColor = vec4(rgba.rgb * rgba.a, rgba.a);", NEAREST],
    ]);
    const geometry = batchGeometry();
    spark.geometry = geometry;
    const prepare = spark.onBeforeRender;
    spark.onBeforeRender = (...frame) => {
      prepare.apply(spark, frame);
      this.uniforms.lastSplat.value = spark.activeSplats;
      spark.uniforms.encodeLinear.value = false;
      geometry.instanceCount = Math.ceil(spark.activeSplats / BATCH);
    };
  }

  /**
   * Change the colors of the next frame.
   * @param {Uint8Array} codes One code per Gaussian.
   * @param {number[][]} palette Rows of red, green and blue in 0..255, opacity in 0..1, and 1 to mix with gray.
   * @returns {boolean} True if the set of hidden Gaussians has changed.
   */
  paint(codes, palette) {
    const old = this.codes.image.data;
    let changed = false;
    for (let i = 0; i < this.count && !changed; i++) changed = (codes[i] === HIDDEN) !== (old[i] === HIDDEN);
    old.set(codes.subarray(0, this.count));
    this.codes.needsUpdate = true;
    const data = this.palette.image.data;
    palette.forEach(([red, green, blue, share, gray], i) => {
      data.set([red / 255, green / 255, blue / 255, share], 4 * i);
      data[4 * (256 + i)] = gray;
    });
    this.palette.needsUpdate = true;
    return changed;
  }
}
