// SPDX-License-Identifier: Apache-2.0
/** Blending: four corners around each splat, in the worker's order, every pixel by the trainer's rules. */

import type { ProgramSource } from "../gpu/resources.js";
import { TABLE_GLSL } from "../gpu/table.js";
import { RULES_GLSL } from "./projection.js";

/** Number of vertices with 16-bit indices: the largest index, 65535, starts a new primitive. */
export const SPLATS_PER_CALL = 16383;
const CORNERS = [0, 1, 2, 2, 1, 3];
export const INDICES_PER_SPLAT = CORNERS.length;

/** Two triangles for each splat of one draw call. */
export function cornerIndices(): Uint16Array {
  const splat = (i: number) => Math.floor(i / INDICES_PER_SPLAT);
  return Uint16Array.from(
    { length: INDICES_PER_SPLAT * SPLATS_PER_CALL },
    (_, i) => 4 * splat(i) + CORNERS[i % INDICES_PER_SPLAT]!,
  );
}

/** The picture's top row is the target's first. */
export function splatProgram(): ProgramSource {
  return {
    vertex: `${TABLE_GLSL}${RULES_GLSL}
uniform usampler2D slots, first, second;
uniform int start;
uniform vec2 size;
flat out vec2 mean;
flat out vec3 conic;
flat out vec4 paint;

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  mean = vec2(0.0);
  conic = vec3(0.0);
  paint = vec4(0.0);
  int slot = int(texelFetch(slots, place(start + (gl_VertexID >> 2)), 0).x);
  uvec4 rest = texelFetch(second, place(slot), 0);
  float opacity = uintBitsToFloat(rest.y);
  if (opacity == 0.0) return;
  vec4 found = uintBitsToFloat(texelFetch(first, place(slot), 0));
  float xx = found.z, xy = found.w, yy = uintBitsToFloat(rest.x);
  mean = found.xy;
  conic = vec3(yy, -xy, xx) / (xx * yy - xy * xy);
  paint = vec4(unpackHalf2x16(rest.z), unpackHalf2x16(rest.w).x, opacity);
  // The rectangle along the ellipse's axes, where alpha falls to MIN_ALPHA, and a little more for roundings.
  float middle = 0.5 * (xx + yy), spread = length(vec2(0.5 * (xx - yy), xy));
  float large = middle + spread, small = max(middle - spread, 0.0);
  vec2 along = xx >= yy ? vec2(large - yy, xy) : vec2(xy, large - xx);
  along = spread > 1e-6 * large ? normalize(along) : vec2(1.0, 0.0);
  float reach = 2.0 * max(log(opacity / MIN_ALPHA), 0.0);
  vec2 corner = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  vec2 from = corner.x * (sqrt(reach * large) + 0.02) * along + corner.y * (sqrt(reach * small) + 0.02) * vec2(-along.y, along.x);
  gl_Position = vec4((mean + from) / size * 2.0 - 1.0, 0.0, 1.0);
}
`,
    fragment: `${RULES_GLSL}
flat in vec2 mean;
flat in vec3 conic;
flat in vec4 paint;
out vec4 color;

void main() {
  vec2 d = gl_FragCoord.xy - mean;
  float power = 0.5 * (conic.x * d.x * d.x + conic.z * d.y * d.y) + conic.y * d.x * d.y;
  float alpha = paint.w * exp(-power);
  if (alpha < MIN_ALPHA) discard;
  alpha = min(alpha, MAX_ALPHA);
  color = vec4(paint.xyz * alpha, alpha);
}
`,
  };
}
