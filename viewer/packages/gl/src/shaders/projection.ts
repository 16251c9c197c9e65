// SPDX-License-Identifier: Apache-2.0
/** From slots to splats: each Gaussian's ellipse on the picture, by the rules of docs/bitstream.md. */

import type { ProgramSource } from "../gpu/resources.js";
import { TABLE_GLSL, TABLE_WIDTH_BITS } from "../gpu/table.js";
import { TRAINING_LOW_PASS } from "../sampling.js";
import { COVERING_VERTEX } from "./mlp.js";

export const RULES_GLSL = `
const float MIN_ALPHA = 1.0 / 255.0;
const float MAX_ALPHA = 0.999;
`;

/** Smallest variance without aliasing, square pixels of the drawn picture. */
const MIN_LOW_PASS = 0.15;

/**
 * One fragment is one slot. First target: mean x, y, covariance xx, xy; second: covariance yy, opacity, colour in halves.
 * A slot with an opacity of 0 is not drawn.
 *
 * @param reading of an `MlpPass`
 */
export function projectionProgram(splats: number, reading: string): ProgramSource {
  return {
    vertex: COVERING_VERTEX,
    fragment: `${TABLE_GLSL}${RULES_GLSL}${reading}
const float TRAINING_LOW_PASS = ${TRAINING_LOW_PASS}, MIN_LOW_PASS = ${MIN_LOW_PASS};
uniform sampler2D positions, offsetScales, baseScales, offsets, free;
uniform usampler2D anchors, intervals;
uniform int anchorCount, slotCount, freeAt;
uniform mat3 rotation; // world to camera
uniform vec3 translation;
uniform vec4 K; // fx, fy, cx, cy
uniform vec2 size;
uniform float near;
layout(location = 0) out uvec4 first;
layout(location = 1) out uvec4 second;

struct Gaussian { vec3 mean; vec3 scales; vec4 q; float opacity; vec3 color; int point; };

Gaussian structured(int slot) {
  int v = slot / ${splats};
  int k = slot - v * ${splats};
  int m = int(texelFetch(anchors, place(v), 0).x);
  vec4 a, b, c;
  readGaussian(v, k, a, b, c);
  vec3 offset = texelFetch(offsets, place(m * ${splats} + k), 0).xyz;
  vec3 mean = texelFetch(positions, place(m), 0).xyz + offset * exp(texelFetch(offsetScales, place(m), 0).xyz);
  return Gaussian(mean, exp(texelFetch(baseScales, place(m), 0).xyz) * b.xyz, vec4(b.w, c.xyz), a.x, a.yzw, m);
}

Gaussian loose(int i) {
  vec2 t[7];
  for (int j = 0; j < 7; j++) t[j] = texelFetch(free, place(i * 7 + j), 0).xy;
  return Gaussian(vec3(t[0], t[1].x), exp(vec3(t[1].y, t[2])), vec4(t[3], t[4]), 1.0 / (1.0 + exp(-t[5].x)),
                  vec3(t[5].y, t[6]), freeAt + i);
}

mat3 turned(vec4 q) {
  q *= inversesqrt(dot(q, q));
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
  first = second = uvec4(0u);
  int slot = (int(gl_FragCoord.y) << ${TABLE_WIDTH_BITS}) + int(gl_FragCoord.x);
  if (slot >= slotCount) return;
  int structuredCount = anchorCount * ${splats};
  Gaussian g;
  if (slot < structuredCount) g = structured(slot); else g = loose(slot - structuredCount);
  vec3 point = rotation * g.mean + translation;
  // Comparisons are true for numbers only: what is not a number is not drawn.
  if (!(g.opacity >= MIN_ALPHA && point.z >= near)) return;
  vec2 tangent = point.xy / point.z;
  vec2 margin = 0.15 * size / K.xy;
  vec2 limited = clamp(tangent, -(K.zw / K.xy + margin), (size - K.zw) / K.xy + margin);
  mat3 axes = rotation * turned(g.q);
  axes = mat3(axes[0] * g.scales.x, axes[1] * g.scales.y, axes[2] * g.scales.z);
  vec2 focal = K.xy / point.z;
  vec3 depths = vec3(axes[0].z, axes[1].z, axes[2].z);
  vec3 x = focal.x * (vec3(axes[0].x, axes[1].x, axes[2].x) - limited.x * depths);
  vec3 y = focal.y * (vec3(axes[0].y, axes[1].y, axes[2].y) - limited.y * depths);
  float xx = dot(x, x), xy = dot(x, y), yy = dot(y, y);
  // Low-pass of the training pixels, then as much more as the pixels of this picture need, which costs opacity.
  vec2 side = focal * uintBitsToFloat(texelFetch(intervals, place(g.point), 0).x);
  float trained = TRAINING_LOW_PASS * side.x * side.y, total = max(trained, MIN_LOW_PASS);
  // Determinants without cancellation: that of the projection alone is the square of a cross product.
  vec3 normal = cross(x, y);
  float before = dot(normal, normal) + trained * (xx + yy + trained);
  float after = dot(normal, normal) + total * (xx + yy + total);
  float opacity = g.opacity * sqrt(before / after);
  if (!(opacity >= MIN_ALPHA)) return;
  xx += total;
  yy += total;
  vec2 mean = K.xy * tangent + K.zw;
  float reach = 2.0 * log(255.0 * opacity);
  vec2 extent = sqrt(max(reach, 0.0) * vec2(xx, yy));
  bool inside = all(greaterThan(mean + extent, vec2(0.0))) && all(lessThan(mean - extent, size));
  bool tame = all(lessThan(extent, vec2(1e7))) && all(lessThan(abs(mean), vec2(1e7)));
  if (!(xx * yy - xy * xy > 0.0 && inside && tame)) return;
  first = floatBitsToUint(vec4(mean, xx, xy));
  second = uvec4(floatBitsToUint(yy), floatBitsToUint(opacity), packHalf2x16(g.color.xy), packHalf2x16(vec2(g.color.z, 0.0)));
}
`,
  };
}
