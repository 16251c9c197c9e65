// SPDX-License-Identifier: Apache-2.0
/** What was blended, with what is behind it, as a picture (environment.py, harmonics.py). */

import type { ProgramSource } from "../gpu/resources.js";
import { COVERING_VERTEX } from "./mlp.js";

/** @param rows of the environment: spherical harmonics of degree 0, 1 or 2; 0 without one, then black is behind */
export function pictureProgram(rows: number): ProgramSource {
  const [y0, a, b] = [0.5 / Math.sqrt(Math.PI), Math.sqrt(3 / (4 * Math.PI)), Math.sqrt(15 / (4 * Math.PI))];
  const c = Math.sqrt(5 / (16 * Math.PI));
  const basis = [
    "Y0",
    "-A * d.y",
    "A * d.z",
    "-A * d.x",
    "B * d.x * d.y",
    "-B * d.y * d.z",
    "C * (3.0 * d.z * d.z - 1.0)",
    "-B * d.x * d.z",
    "0.5 * B * (d.x * d.x - d.y * d.y)",
  ].slice(0, rows);
  const behind = rows
    ? `
uniform vec3 environment[${rows}];
uniform mat3 rays; // of pixels, to directions in the scene
vec3 behind(vec2 pixel) {
  vec3 d = normalize(rays * vec3(pixel, 1.0));
  vec3 sum = vec3(0.5);
${basis.map((term, i) => `  sum += (${term}) * environment[${i}];`).join("\n")}
  return clamp(sum, 0.0, 1.0);
}
`
    : "vec3 behind(vec2 pixel) { return vec3(0.0); }\n";
  return {
    vertex: COVERING_VERTEX,
    fragment: `
const float Y0 = ${y0}, A = ${a}, B = ${b}, C = ${c};
const float INVISIBLE = 1.0 / 512.0;
uniform sampler2D blended;
uniform vec2 size, corner; // of the picture
uniform bool transparent;
uniform vec3 gain, bias;
out vec4 color;
${behind}
void main() {
  // The picture's first row is the target's first and the canvas' last.
  vec2 at = gl_FragCoord.xy - corner;
  vec2 pixel = vec2(at.x, size.y - at.y);
  vec4 found = texture(blended, pixel / size);
  float rest = 1.0 - found.w;
  vec3 picture = found.xyz;
  if (rest > INVISIBLE && !transparent) picture += rest * behind(pixel);
  color = vec4(clamp(gain * picture + bias, 0.0, 1.0), transparent ? found.w : 1.0);
}
`,
  };
}
