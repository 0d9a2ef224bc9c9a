/**
 * Extends Spark's renderer: colors by one byte per Gaussian, and batches instead of one instance per Gaussian.
 *
 * Colors are looked up when a frame is drawn. Geometry, spherical harmonics and sort order stay as they are, so a new
 * answer needs no sorting, and the next frame shows it. Hidden Gaussians keep their position in the sort order.
 * Batches make software WebGL four times as fast as instances, which it draws one by one.
 *
 * The changes are made in Spark's own shaders, whose version is pinned; `patched` throws if a line is not there.
 */
import * as THREE from "three";

/** Gaussians per instance. */
const BATCH = 256;
/** Width of the texture of codes. */
export const WIDTH = 2048;
/** Brightness of what is not selected, relative to its own gray. */
export const GRAY_LEVEL = 0.8;
/** Opacity from which on a Gaussian counts as the nearest one of a pixel. */
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
/** A triangle reaches to where its Gaussian falls below the least opacity that is drawn. */
const TIGHT = `
    vRgba.a = rgba.a;
    if (rgba.a <= 1.0) {
        adjustedStdDev = min(adjustedStdDev, sqrt(2.0 * log(rgba.a / minAlpha)));
        vSplatUv = position.xy * adjustedStdDev;
    }`;

/** Nearest Gaussian of each pixel, if a second target is drawn to: blending with opacity 1 replaces, with 0 keeps. */
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

/** The Gaussians of a scene that holds a single mesh. */
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
   * Changes the colors of the next frame.
   * @param {Uint8Array} codes One per Gaussian.
   * @param {number[][]} palette Rows of red, green and blue in 0..255, and of share and gray in 0..1.
   * @returns {boolean} True if other Gaussians are hidden now.
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
