// SPDX-License-Identifier: Apache-2.0
/** Reads what the passes before blending wrote out of their textures; waits for the GPU. */

import type { SplatRenderer } from "../../src/index.js";

const TABLE_WIDTH = 2048;
/** Numbers of a slot: mean x, y, covariance xx, xy, yy, opacity. */
export const PROJECTED_NUMBERS = 6;

/** Of the picture shown: its blended target, the sampling intervals, and what was projected for each slot. */
export interface ReadBack {
  /** Anchors' first, then free Gaussians'. */
  readonly intervals: Float32Array;
  readonly projected: Float32Array;
  /** RGBA before the environment, as floats. */
  readonly blended: Float32Array;
}

export function readBack(renderer: SplatRenderer): ReadBack {
  // biome-ignore-start lint/complexity/useLiteralKeys: tests look behind what is private
  const pipeline = renderer["pipeline"]!;
  const { scene, sampling, projection } = pipeline["stage"]!;
  const { target, width, height } = pipeline["splats"] as unknown as Record<"width" | "height", number> & {
    target: WebGLTexture;
  };
  // biome-ignore-end lint/complexity/useLiteralKeys: tests look behind what is private
  const { gl } = pipeline.device;
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  const attach = (texture: WebGLTexture) =>
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
  const words = (texture: WebGLTexture, texels: number) => {
    const rows = Math.ceil(texels / TABLE_WIDTH);
    const found = new Uint32Array(4 * TABLE_WIDTH * rows);
    attach(texture);
    if (rows) gl.readPixels(0, 0, TABLE_WIDTH, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
    return found;
  };
  const points = scene.sizes.anchors + scene.sizes.free;
  const floats = new Float32Array(words(sampling.intervals.texture!, points).buffer);
  const intervals = Float32Array.from({ length: points }, (_, i) => floats[4 * i]!);
  const [first, second] = [projection.first, projection.second].map(
    ({ texture }) => new Float32Array(words(texture!, scene.slotCount).buffer),
  );
  const projected = new Float32Array(PROJECTED_NUMBERS * scene.slotCount);
  for (let i = 0; i < scene.slotCount; i++) {
    projected.set(first!.subarray(4 * i, 4 * i + 4), PROJECTED_NUMBERS * i);
    projected.set(second!.subarray(4 * i, 4 * i + 2), PROJECTED_NUMBERS * i + 4);
  }
  const blended = new Float32Array(4 * width * height);
  attach(target);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, blended);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.deleteFramebuffer(framebuffer);
  return { intervals, projected, blended };
}
