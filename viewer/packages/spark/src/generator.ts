// SPDX-License-Identifier: Apache-2.0
/** The function that Spark runs for each splat: an anchor's MLPs for this eye, or a free Gaussian. */

import { dyno } from "@sparkjsdev/spark";
import { type Shape, streamSplatGlsl } from "@structgstream/gl/shading";
import type { IUniform, Vector3 } from "three";

/** Uniforms in addition to those of the fields. */
export interface SceneUniforms {
  readonly eye: IUniform<Vector3>;
  /** Number of splats of anchors; the others are free Gaussians. */
  readonly structuredCount: IUniform<number>;
  readonly cameraCount: IUniform<number>;
  readonly ownBlur: IUniform<number>;
}

function sceneGlsl(shape: Shape): string {
  return `${streamSplatGlsl(shape)}
void streamGsplat(int i, out Gsplat splat) {
  StreamSplat found = streamSplat(i);
  splat.index = i;
  splat.center = found.mean;
  splat.scales = found.scales;
  splat.quaternion = found.rotation;
  splat.rgba = found.color;
  splat.flags = found.color.a > 0.0 ? GSPLAT_FLAG_ACTIVE : 0u;
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
      statements: [`streamGsplat(${inputs.index}, ${outputs.gsplat});`],
      uniforms,
    }),
  });
  return block.outputs.gsplat;
}
