// SPDX-License-Identifier: Apache-2.0
/** The MLPs' weights in the order in which the shader reads them, four per texel. */

import type { FieldName, Fields } from "@structgstream/core";
import type { Shape } from "../scene.js";

/** Numbers of texels, common to shader and weights. */
export interface MlpLayout {
  /** Texels of an anchor's features, of its appearance, and of all inputs including direction and distance. */
  readonly featureTexels: number;
  readonly appearanceTexels: number;
  readonly inputTexels: number;
  /** Texels of the hidden layer's values. */
  readonly hiddenTexels: number;
  /** First texel of each head, and of the outputs within a head. */
  readonly heads: { readonly opacity: number; readonly color: number; readonly covariance: number };
  readonly outputsAt: number;
  readonly outputTexels: number;
  readonly texels: number;
}

const HEADS = [
  ["opacity", "opacity_mlp", 1],
  ["color", "color_mlp", 3],
  ["covariance", "covariance_mlp", 7],
] as const;

/** Fields that contain weights. */
export const WEIGHT_FIELDS: readonly FieldName[] = [...HEADS.map(([, field]) => field), "appearance_basis"];

export function mlpLayout(shape: Shape): MlpLayout {
  const featureTexels = Math.ceil(shape.features / 4);
  const appearanceTexels = Math.ceil(shape.appearance / 4);
  const inputTexels = featureTexels + appearanceTexels + 1;
  const hiddenTexels = Math.ceil(shape.hidden / 4);
  const outputsAt = hiddenTexels * (4 * inputTexels + 1);
  const outputTexels = hiddenTexels + 1;
  const head = (outputs: number) => outputsAt + outputs * shape.offsetsPerAnchor * outputTexels;
  const heads = { opacity: 0, color: head(1), covariance: head(1) + head(3) };
  return {
    featureTexels,
    appearanceTexels,
    inputTexels,
    hiddenTexels,
    heads,
    outputsAt,
    outputTexels,
    texels: heads.covariance + head(7),
  };
}

/**
 * All weights as texels. The appearance `a` of an anchor changes its features by `basis^T a`. Because this is linear, the
 * appearance is a separate input, with the features' weights times the basis as its weights.
 */
export function packedWeights(fields: Fields, shape: Shape): Float32Array {
  const layout = mlpLayout(shape);
  const packed = new Float32Array(4 * layout.texels);
  const basis = fields.get("appearance_basis")?.data as Float32Array | undefined;
  for (const [name, field, outputs] of HEADS) {
    packHead(
      packed.subarray(4 * layout.heads[name]),
      fields.get(field)!.data as Float32Array,
      outputs * shape.offsetsPerAnchor,
      shape,
      basis,
    );
  }
  return packed;
}

function packHead(
  to: Float32Array,
  weights: Float32Array,
  outputs: number,
  shape: Shape,
  basis: Float32Array | undefined,
): void {
  const { features, hidden, appearance } = shape;
  const inputs = features + 3 + Number(shape.distanceInput);
  const { featureTexels, appearanceTexels, inputTexels, hiddenTexels, outputsAt, outputTexels } = mlpLayout(shape);
  const [b1, w2] = [hidden * inputs, hidden * inputs + hidden];
  const b2 = w2 + outputs * hidden;
  for (let unit = 0; unit < hidden; unit++) {
    const group = 4 * (unit >> 2) * (4 * inputTexels + 1);
    const row = group + 4 * (unit & 3) * inputTexels;
    const first = unit * inputs;
    to.set(weights.subarray(first, first + features), row);
    const appearanceAt = row + 4 * featureTexels;
    for (let r = 0; basis && r < appearance; r++) {
      let sum = 0;
      for (let i = 0; i < features; i++) sum += weights[first + i]! * basis[r * features + i]!;
      to[appearanceAt + r] = sum;
    }
    to.set(weights.subarray(first + features, first + inputs), appearanceAt + 4 * appearanceTexels);
    to[group + 16 * inputTexels + (unit & 3)] = weights[b1 + unit]!;
  }
  for (let output = 0; output < outputs; output++) {
    const row = 4 * (outputsAt + output * outputTexels);
    to.set(weights.subarray(w2 + output * hidden, w2 + (output + 1) * hidden), row);
    to[row + 4 * hiddenTexels] = weights[b2 + output]!;
  }
}

/** Rows of `columns` numbers with zeros up to a multiple of four. */
export function paddedRows(data: Float32Array, columns: number): Float32Array {
  const wide = 4 * Math.ceil(columns / 4);
  if (wide === columns) return data;
  const rows = columns ? data.length / columns : 0;
  const padded = new Float32Array(rows * wide);
  for (let row = 0; row < rows; row++) padded.set(data.subarray(row * columns, (row + 1) * columns), row * wide);
  return padded;
}
