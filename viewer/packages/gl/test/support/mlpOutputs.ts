// SPDX-License-Identifier: Apache-2.0
/** Reads what the MLP passes wrote out of their textures; waits for the GPU. */

import type { SplatRenderer } from "../../src/index.js";
import { halfFloat } from "./halfFloat.js";

/** Numbers of a Gaussian: opacity, rgb, shares of the scales, quaternion, and one that is unused (`shaders/mlp.ts`). */
const STRIDE = 12;
const TABLE_WIDTH = 2048;
const LAYER_WIDTH = 1024;

/** The anchors of the order shown, and `STRIDE` numbers for each of their Gaussians. */
export function mlpOutputs(renderer: SplatRenderer): { anchors: Uint32Array; outputs: Float32Array } {
  // biome-ignore-start lint/complexity/useLiteralKeys: tests look behind what is private
  const pipeline = renderer["pipeline"]!;
  const { mlp, scene, shape } = pipeline["stage"]!;
  const { order } = renderer["sorted"]!;
  const { gl } = pipeline.device;
  const most = pipeline.device.splatsPerPass[pipeline.path];
  // biome-ignore-end lint/complexity/useLiteralKeys: tests look behind what is private
  const { textures, arrays } = mlp.outputs();
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  const splats = shape.offsetsPerAnchor;
  const outputs = arrays.outputs
    ? ofLayers(gl, arrays.outputs, scene.anchorCount, splats)
    : ofTable(gl, textures.outputs!, scene.anchorCount, splats, most, mlp.passTexels);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.deleteFramebuffer(framebuffer);
  return { anchors: order.anchors.slice(0, order.anchorCount), outputs };
}

function ofTable(
  gl: WebGL2RenderingContext,
  texture: WebGLTexture,
  count: number,
  splats: number,
  most: number,
  passTexels: number,
): Float32Array {
  const passes = Math.ceil(splats / most);
  const rows = (passTexels / TABLE_WIDTH) * passes;
  const texels = new Float32Array(4 * TABLE_WIDTH * rows);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  gl.readPixels(0, 0, TABLE_WIDTH, rows, gl.RGBA, gl.FLOAT, texels);
  const all = new Float32Array(count * splats * STRIDE);
  for (let pass = 0; pass < passes; pass++) {
    const first = pass * most;
    const numbers = Math.min(most, splats - first) * STRIDE;
    for (let v = 0; v < count; v++) {
      const from = 4 * pass * passTexels + v * numbers;
      all.set(texels.subarray(from, from + numbers), (v * splats + first) * STRIDE);
    }
  }
  return all;
}

function ofLayers(gl: WebGL2RenderingContext, texture: WebGLTexture, count: number, splats: number): Float32Array {
  const rows = Math.ceil(count / LAYER_WIDTH);
  const texels = new Uint32Array(4 * LAYER_WIDTH * rows);
  const all = new Float32Array(count * splats * STRIDE);
  for (let layer = 0; layer < Math.ceil((6 * splats) / 4); layer++) {
    gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, texture, 0, layer);
    gl.readPixels(0, 0, LAYER_WIDTH, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, texels);
    // Number `n` of an anchor's 32-bit ones, six to a Gaussian, is half floats 2n and 2n + 1.
    for (let v = 0; v < count; v++) {
      for (let n = 4 * layer; n < Math.min(4 * layer + 4, 6 * splats); n++) {
        const bits = texels[4 * v + n - 4 * layer]!;
        all[v * splats * STRIDE + 2 * n] = halfFloat(bits & 0xffff);
        all[v * splats * STRIDE + 2 * n + 1] = halfFloat(bits >>> 16);
      }
    }
  }
  return all;
}
