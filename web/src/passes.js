/** Full-screen passes. */
import * as THREE from "three";

/**
 * @param {string} fragmentShader @param {Record<string, THREE.IUniform>} uniforms @param {THREE.Blending} blending
 * @returns {THREE.Scene} Scene with one triangle that covers the frame.
 */
export function fullScreenPass(fragmentShader, uniforms, blending) {
  const material = new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3,
    vertexShader: "in vec3 position; void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }",
    fragmentShader,
    uniforms,
    blending,
    transparent: true,
    premultipliedAlpha: true,
    blendSrc: THREE.OneFactor,
    blendDst: THREE.OneMinusSrcAlphaFactor,
    depthTest: false,
    depthWrite: false,
  });
  const triangle = new THREE.BufferGeometry();
  triangle.setAttribute("position", new THREE.BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
  const mesh = new THREE.Mesh(triangle, material);
  mesh.frustumCulled = false;
  return new THREE.Scene().add(mesh);
}
