// SPDX-License-Identifier: Apache-2.0
/** The fields of a scene as tables of four numbers per texel, for the GLSL of `shaders/streamSplat.ts`. */

import type { FieldName, Fields, Tensor } from "@structgstream/core";
import { packedWeights, paddedRows, WEIGHT_FIELDS } from "./gpu/weights.js";
import type { Shape } from "./scene.js";

/** Names of samplers, and the fields that they contain. */
const TABLES = {
  positions: ["anchor_positions"],
  offsetScales: ["offset_scales"],
  baseScales: ["base_scales"],
  offsets: ["anchor_offsets"],
  features: ["anchor_features"],
  appearance: ["appearance"],
  free: ["free"],
  weights: WEIGHT_FIELDS,
} as const satisfies Record<string, readonly FieldName[]>;

export type TableName = keyof typeof TABLES;

export const TABLE_NAMES = Object.keys(TABLES) as readonly TableName[];

/** The tables that differ from those of the last scene, which fields that are other objects have. */
export class FieldTables {
  private written = new Map<FieldName, Tensor | undefined>();

  constructor(private readonly shape: Shape) {}

  /** Numbers of each table that changed with a scene of the same shape. */
  changed(fields: Fields): Map<TableName, Float32Array> {
    const names = TABLE_NAMES.filter((name) =>
      TABLES[name].some((source) => fields.get(source) !== this.written.get(source)),
    );
    this.written = new Map(fields);
    return new Map(names.map((name) => [name, this.numbers(name, fields)]));
  }

  private numbers(name: TableName, fields: Fields): Float32Array {
    if (name === "weights") return packedWeights(fields, this.shape);
    const tensor = fields.get(TABLES[name][0])!;
    // Offsets have three numbers for each Gaussian, all others one row for each anchor or free Gaussian.
    return paddedRows(tensor.data as Float32Array, name === "offsets" ? 3 : tensor.shape[1]!);
  }
}
