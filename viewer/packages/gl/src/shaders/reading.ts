// SPDX-License-Identifier: Apache-2.0
/** GLSL that reads the outputs of the MLP passes of either path: `readGaussian(v, k, a, b, c)`. */

import { PAIR_TARGETS, SPLAT_VECTORS } from "../gpu/device.js";
import { LAYER_WIDTH_BITS } from "./mlp.js";

/** @param most Gaussians of an anchor that one pass computes */
export function feedbackReading(splats: number, most: number): string {
  return `
uniform sampler2D outputs;
uniform int passTexels;
void readGaussian(int v, int k, out vec4 a, out vec4 b, out vec4 c) {
  int pass = k / ${most};
  int i = pass * passTexels + (v * min(${most}, ${splats} - pass * ${most}) + k - pass * ${most}) * ${SPLAT_VECTORS};
  a = texelFetch(outputs, place(i), 0);
  b = texelFetch(outputs, place(i + 1), 0);
  c = texelFetch(outputs, place(i + 2), 0);
}
`;
}

/** All passes except the last have an even number of Gaussians, so the layers of a pair do not depend on the passes. */
export const TARGETS_READING = `
uniform usampler2DArray outputs;
void readGaussian(int v, int k, out vec4 a, out vec4 b, out vec4 c) {
  ivec2 at = ivec2(v & ${(1 << LAYER_WIDTH_BITS) - 1}, v >> ${LAYER_WIDTH_BITS});
  int layer = (k >> 1) * ${PAIR_TARGETS};
  uvec4 middle = texelFetch(outputs, ivec3(at, layer + 1), 0);
  uvec4 four = texelFetch(outputs, ivec3(at, layer + 2 * (k & 1)), 0);
  bool second = (k & 1) == 1;
  uvec2 head = second ? middle.zw : four.xy;
  uvec2 waist = second ? four.xy : four.zw;
  uvec2 tail = second ? four.zw : middle.xy;
  a = vec4(unpackHalf2x16(head.x), unpackHalf2x16(head.y));
  b = vec4(unpackHalf2x16(waist.x), unpackHalf2x16(waist.y));
  c = vec4(unpackHalf2x16(tail.x), unpackHalf2x16(tail.y));
}
`;
