// SPDX-License-Identifier: Apache-2.0
/** The three MLPs of one anchor (docs/bitstream.md, From fields to a picture), by transform feedback or render targets. */

import { SPLAT_VECTORS } from "../gpu/device.js";
import type { ProgramSource } from "../gpu/resources.js";
import { TABLE_GLSL } from "../gpu/table.js";
import type { MlpLayout } from "../gpu/weights.js";
import type { Shape } from "../scene.js";

/** Gaussians `first` to `first + count - 1` of each anchor, which one pass computes. */
export interface SplatRange {
  readonly first: number;
  readonly count: number;
}

/** Ranges of at most `most` Gaussians that cover all. */
export function splatRanges(splats: number, most: number): SplatRange[] {
  const ranges: SplatRange[] = [];
  for (let first = 0; first < splats; first += most) ranges.push({ first, count: Math.min(most, splats - first) });
  return ranges;
}

/** `evaluate(anchor)` writes (opacity, rgb), (shares of the scales, qw), (qxyz, 0) of each Gaussian to `a`, `b`, `c`. */
export function evaluation(shape: Shape, layout: MlpLayout, range: SplatRange): string {
  return `${TABLE_GLSL}
uniform sampler2D positions, features, appearance, weights;
uniform usampler2D anchors;
uniform vec3 eye;

vec4 given[${layout.inputTexels}];
vec4 units[${layout.hiddenTexels}];
vec4 a[${range.count}], b[${range.count}], c[${range.count}];

vec4 weight(int i) { return texelFetch(weights, place(i), 0); }

void look(int anchor) {
  for (int i = 0; i < ${layout.featureTexels}; i++)
    given[i] = texelFetch(features, place(anchor * ${layout.featureTexels} + i), 0);
  for (int i = 0; i < ${layout.appearanceTexels}; i++)
    given[${layout.featureTexels} + i] = texelFetch(appearance, place(anchor * ${layout.appearanceTexels} + i), 0);
  vec3 away = texelFetch(positions, place(anchor), 0).xyz - eye;
  float len = max(length(away), 1e-12); // an anchor may sit in the camera
  given[${layout.inputTexels - 1}] = vec4(away / len, ${shape.distanceInput ? "len" : "0.0"});
}

void think(int at) {
  for (int g = 0; g < ${layout.hiddenTexels}; g++) {
    vec4 sum = weight(at + ${4 * layout.inputTexels});
    for (int i = 0; i < ${layout.inputTexels}; i++) {
      vec4 x = given[i];
      sum += vec4(dot(weight(at + i), x), dot(weight(at + i + ${layout.inputTexels}), x),
                  dot(weight(at + i + ${2 * layout.inputTexels}), x), dot(weight(at + i + ${3 * layout.inputTexels}), x));
    }
    units[g] = max(sum, 0.0);
    at += ${4 * layout.inputTexels + 1};
  }
}

float result(int at) {
  float sum = weight(at + ${layout.hiddenTexels}).x;
  for (int i = 0; i < ${layout.hiddenTexels}; i++) sum += dot(weight(at + i), units[i]);
  return sum;
}

vec3 result3(int at) { return vec3(result(at), result(at + ${layout.outputTexels}), result(at + ${2 * layout.outputTexels})); }
vec3 sigmoid(vec3 x) { return 1.0 / (1.0 + exp(-x)); }

void evaluate(int anchor) {
  look(anchor);
  think(${layout.heads.opacity});
  for (int k = 0; k < ${range.count}; k++)
    // tanh of a large number is not a number on some drivers
    a[k].x = 1.0 - 2.0 / (exp(2.0 * result(${layout.heads.opacity + layout.outputsAt} + (k + ${range.first}) * ${layout.outputTexels})) + 1.0);
  think(${layout.heads.color});
  for (int k = 0; k < ${range.count}; k++)
    a[k].yzw = sigmoid(result3(${layout.heads.color + layout.outputsAt} + (k + ${range.first}) * ${3 * layout.outputTexels}));
  think(${layout.heads.covariance});
  for (int k = 0; k < ${range.count}; k++) {
    int at = ${layout.heads.covariance + layout.outputsAt} + (k + ${range.first}) * ${7 * layout.outputTexels};
    b[k].xyz = sigmoid(result3(at));
    vec4 q = vec4(result(at + ${3 * layout.outputTexels}), result3(at + ${4 * layout.outputTexels}));
    q /= max(length(q), 1e-12);
    b[k].w = q.x;
    c[k] = vec4(q.yzw, 0.0);
  }
}
`;
}

/** One vertex is one anchor of the list; writes `SPLAT_VECTORS` vec4s for each Gaussian of the range. */
export function feedbackProgram(shape: Shape, layout: MlpLayout, range: SplatRange): ProgramSource {
  const names = Array.from({ length: range.count }, (_, k) => ["a", "b", "c"].map((part) => `out_${part}${k}`)).flat();
  const writes = names.map((name, i) => `${name} = ${"abc"[i % SPLAT_VECTORS]}[${Math.floor(i / SPLAT_VECTORS)}];`);
  return {
    vertex: `${evaluation(shape, layout, range)}
${names.map((name) => `out vec4 ${name};`).join("\n")}
void main() {
  evaluate(int(texelFetch(anchors, place(gl_VertexID), 0).x));
  ${writes.join("\n  ")}
  gl_Position = vec4(0.0);
}
`,
    fragment: "void main() {}\n",
    feedback: names,
  };
}

/** Texels of a row in the layers that {@link targetsProgram} draws into, as a power of two. */
export const LAYER_WIDTH_BITS = 10;

/** One fragment is one anchor of the list; two Gaussians fill three targets with half floats, six numbers each. */
export function targetsProgram(shape: Shape, layout: MlpLayout, range: SplatRange): ProgramSource {
  const numbers = Array.from({ length: range.count }, (_, k) => [
    `packHalf2x16(a[${k}].xy)`,
    `packHalf2x16(a[${k}].zw)`,
    `packHalf2x16(b[${k}].xy)`,
    `packHalf2x16(b[${k}].zw)`,
    `packHalf2x16(c[${k}].xy)`,
    `packHalf2x16(c[${k}].zw)`,
  ]).flat();
  while (numbers.length % 4) numbers.push("0u");
  const targets = numbers.length / 4;
  const outputs = Array.from({ length: targets }, (_, t) => `layout(location = ${t}) out uvec4 target${t};`);
  const writes = Array.from(
    { length: targets },
    (_, t) => `target${t} = uvec4(${numbers.slice(4 * t, 4 * t + 4).join(", ")});`,
  );
  return {
    vertex: COVERING_VERTEX,
    fragment: `${evaluation(shape, layout, range)}
uniform int count;
${outputs.join("\n")}
void main() {
  int v = (int(gl_FragCoord.y) << ${LAYER_WIDTH_BITS}) + int(gl_FragCoord.x);
  if (v >= count) discard;
  evaluate(int(texelFetch(anchors, place(v), 0).x));
  ${writes.join("\n  ")}
}
`,
  };
}

/** One triangle over the whole viewport. */
export const COVERING_VERTEX = `
void main() {
  gl_Position = vec4(vec2((gl_VertexID << 1) & 2, gl_VertexID & 2) * 2.0 - 1.0, 0.0, 1.0);
}
`;
