// SPDX-License-Identifier: Apache-2.0
/** The sampling interval of each anchor and each free Gaussian: the side of a training pixel there, in scene units. */

import type { ProgramSource } from "../gpu/resources.js";
import { TABLE_GLSL, TABLE_WIDTH_BITS } from "../gpu/table.js";
import { COVERING_VERTEX } from "./mlp.js";

/** GLSL: `samplingInterval(p)` of a point. Weights fall off around each camera's picture, which avoids sudden changes. */
export const SAMPLING_GLSL = `
uniform sampler2D cameras; // three rows each (TrainingCameras)
uniform int cameraCount;
float samplingInterval(vec3 p) {
  vec2 sum = vec2(0.0); // of weights, and of weighted intervals
  for (int i = 0; i < cameraCount; i++) {
    float interval = dot(texelFetch(cameras, place(3 * i + 2), 0), vec4(p, 1.0));
    if (!(interval > 0.0)) continue;
    vec4 row = texelFetch(cameras, place(3 * i), 0), next = texelFetch(cameras, place(3 * i + 1), 0);
    vec2 uv = vec2(dot(row, vec4(p, 1.0)), dot(next, vec4(p, 1.0))) / interval;
    vec2 inside = clamp((0.65 - abs(uv - 0.5)) * 10.0, 0.0, 1.0);
    sum += (inside.x * inside.y + 1e-4) * vec2(1.0, interval);
  }
  return sum.x > 0.0 ? sum.y / sum.x : 0.0;
}
`;

/** One fragment is one point: first the anchors, then the free Gaussians. The target contains the bits of a float. */
export function samplingProgram(): ProgramSource {
  return {
    vertex: COVERING_VERTEX,
    fragment: `${TABLE_GLSL}${SAMPLING_GLSL}
uniform sampler2D positions, free;
uniform int anchors, count;
out uint interval;

void main() {
  interval = 0u;
  int i = (int(gl_FragCoord.y) << ${TABLE_WIDTH_BITS}) + int(gl_FragCoord.x);
  if (i >= count) return;
  vec3 p;
  if (i < anchors) p = texelFetch(positions, place(i), 0).xyz;
  else p = vec3(texelFetch(free, place((i - anchors) * 7), 0).xy, texelFetch(free, place((i - anchors) * 7 + 1), 0).x);
  interval = floatBitsToUint(samplingInterval(p));
}
`,
  };
}
