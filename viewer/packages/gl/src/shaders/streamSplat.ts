// SPDX-License-Identifier: Apache-2.0
/** GLSL of one Gaussian of a frame for an eye, for renderers of plain Gaussians. */

import { mlpLayout } from "../gpu/weights.js";
import { TRAINING_LOW_PASS } from "../sampling.js";
import type { Shape } from "../scene.js";
import { evaluation } from "./mlp.js";
import { SAMPLING_GLSL } from "./sampling.js";

const FREE_TEXELS = 4;

/**
 * `streamSplat(i)`, in scene units: the structured Gaussians, then the free ones.
 *
 * Uniforms: the tables of `FieldTables` and of `TrainingCameras` with `cameraCount`, `eye`, `structuredCount` (Gaussians of
 * anchors), and `ownBlur` (variance that the renderer adds to a Gaussian at distance 1). Scales contain the low-pass of the
 * training pictures as far as it exceeds the renderer's. What has no opacity, or one that is no number, has 0.
 */
export function streamSplatGlsl(shape: Shape): string {
  const splats = shape.offsetsPerAnchor;
  return `${evaluation(shape, mlpLayout(shape), { first: 0, count: splats })}${SAMPLING_GLSL}
uniform sampler2D offsetScales, baseScales, offsets, free;
uniform int structuredCount;
uniform float ownBlur;

struct StreamSplat {
  vec3 mean;
  vec3 scales; // standard deviations
  vec4 rotation; // x, y, z, w
  vec4 color; // sRGB and opacity
};

vec3 widened(vec3 scales, vec3 mean, float interval) {
  vec3 away = mean - eye;
  float added = max(${TRAINING_LOW_PASS} * interval * interval - ownBlur * dot(away, away), 0.0);
  return sqrt(scales * scales + added);
}

StreamSplat structuredSplat(int i) {
  int m = i / ${splats};
  int k = i - m * ${splats};
  evaluate(m);
  vec3 anchor = texelFetch(positions, place(m), 0).xyz;
  vec3 mean = anchor + texelFetch(offsets, place(i), 0).xyz * exp(texelFetch(offsetScales, place(m), 0).xyz);
  vec3 scales = exp(texelFetch(baseScales, place(m), 0).xyz) * b[k].xyz;
  return StreamSplat(
    mean, widened(scales, mean, samplingInterval(anchor)), vec4(c[k].xyz, b[k].w), vec4(a[k].yzw, a[k].x));
}

StreamSplat freeSplat(int i) {
  vec4 t[${FREE_TEXELS}];
  for (int j = 0; j < ${FREE_TEXELS}; j++) t[j] = texelFetch(free, place(i * ${FREE_TEXELS} + j), 0);
  vec3 mean = t[0].xyz;
  return StreamSplat(
    mean,
    widened(exp(vec3(t[0].w, t[1].xy)), mean, samplingInterval(mean)),
    normalize(vec4(t[1].w, t[2].xy, t[1].z)),
    vec4(t[2].w, t[3].xy, 1.0 / (1.0 + exp(-t[2].z))));
}

StreamSplat streamSplat(int i) {
  StreamSplat splat;
  if (i < structuredCount) splat = structuredSplat(i); else splat = freeSplat(i - structuredCount);
  // True for numbers only: what the trainer's rasteriser leaves out is not drawn.
  if (!(splat.color.a >= 1.0 / 255.0)) splat.color = vec4(0.0);
  return splat;
}
`;
}
