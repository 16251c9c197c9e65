// SPDX-License-Identifier: Apache-2.0
/** The function that Spark runs for each splat: an anchor's MLPs for this eye, or a free Gaussian. */

import { dyno } from "@sparkjsdev/spark";
import { evaluation, mlpLayout, SAMPLING_GLSL, type Shape, TRAINING_LOW_PASS } from "@structgstream/gl/shading";
import type { IUniform, Vector3 } from "three";

/** Uniforms in addition to those of the fields. */
export interface SceneUniforms {
  readonly eye: IUniform<Vector3>;
  /** Number of splats of anchors; the others are free Gaussians. */
  readonly structuredCount: IUniform<number>;
  readonly cameraCount: IUniform<number>;
}

const FREE_TEXELS = 4;

function sceneGlsl(shape: Shape): string {
  const splats = shape.offsetsPerAnchor;
  return `${evaluation(shape, mlpLayout(shape), { first: 0, count: splats })}${SAMPLING_GLSL}
uniform sampler2D offsetScales, baseScales, offsets, free;
uniform int structuredCount;

// The low-pass of the training pictures as a part of the Gaussian.
vec3 widened(vec3 scales, float interval) {
  return sqrt(scales * scales + ${TRAINING_LOW_PASS} * interval * interval);
}

void structuredSplat(int i, inout Gsplat splat) {
  int m = i / ${splats};
  int k = i - m * ${splats};
  evaluate(m);
  vec3 anchor = texelFetch(positions, place(m), 0).xyz;
  splat.center = anchor + texelFetch(offsets, place(i), 0).xyz * exp(texelFetch(offsetScales, place(m), 0).xyz);
  splat.scales = widened(exp(texelFetch(baseScales, place(m), 0).xyz) * b[k].xyz, samplingInterval(anchor));
  splat.quaternion = vec4(c[k].xyz, b[k].w);
  splat.rgba = vec4(a[k].yzw, a[k].x);
}

void freeSplat(int i, inout Gsplat splat) {
  vec4 t[${FREE_TEXELS}];
  for (int j = 0; j < ${FREE_TEXELS}; j++) t[j] = texelFetch(free, place(i * ${FREE_TEXELS} + j), 0);
  splat.center = t[0].xyz;
  splat.scales = widened(exp(vec3(t[0].w, t[1].xy)), samplingInterval(splat.center));
  splat.quaternion = normalize(vec4(t[1].w, t[2].xy, t[1].z)); // x, y, z, w
  splat.rgba = vec4(t[2].w, t[3].xy, 1.0 / (1.0 + exp(-t[2].z)));
}

void streamSplat(int i, out Gsplat splat) {
  splat.index = i;
  if (i < structuredCount) structuredSplat(i, splat); else freeSplat(i - structuredCount, splat);
  // True for numbers only: what is not a number is not drawn, nor what the trainer's rasteriser leaves out.
  splat.flags = splat.rgba.a >= 1.0 / 255.0 ? GSPLAT_FLAG_ACTIVE : 0u;
}
`;
}

/** A dyno block from a splat's index to the splat, in scene units. */
export function splatOfNumber(
  shape: Shape,
  uniforms: Readonly<Record<string, IUniform>> & SceneUniforms,
  index: dyno.DynoVal<"int">,
): dyno.DynoVal<typeof dyno.Gsplat> {
  const block = new dyno.Dyno({
    inTypes: { index: "int" },
    outTypes: { gsplat: dyno.Gsplat },
    inputs: { index },
    generate: ({ inputs, outputs }) => ({
      globals: [dyno.defineGsplat, sceneGlsl(shape)],
      statements: [`streamSplat(${inputs.index}, ${outputs.gsplat});`],
      uniforms,
    }),
  });
  return block.outputs.gsplat;
}
