// SPDX-License-Identifier: Apache-2.0
/** The fields of a scene and its training cameras as three.js textures: four numbers per texel, in the shader's order. */

import type { FieldName, Fields, Tensor } from "@structgstream/core";
import {
  packedWeights,
  paddedRows,
  type Shape,
  TABLE_WIDTH_BITS,
  type TrainingCameras,
} from "@structgstream/gl/shading";
import { DataTexture, FloatType, type IUniform, RGBAFormat } from "three";

const WIDTH = 1 << TABLE_WIDTH_BITS;

/** Names in the shader, and their fields. */
const TABLES: Readonly<Record<string, readonly FieldName[]>> = {
  positions: ["anchor_positions"],
  offsetScales: ["offset_scales"],
  baseScales: ["base_scales"],
  offsets: ["anchor_offsets"],
  features: ["anchor_features"],
  appearance: ["appearance"],
  free: ["free"],
  weights: ["opacity_mlp", "color_mlp", "covariance_mlp", "appearance_basis"],
};

export class FieldTextures {
  /** By names in the shader; three.js uploads changes. */
  readonly uniforms: Readonly<Record<string, IUniform<DataTexture>>>;
  private written = new Map<FieldName, Tensor | undefined>();

  constructor(
    private readonly shape: Shape,
    training: TrainingCameras,
  ) {
    const empty = Object.keys(TABLES).map((name) => [name, { value: table(new Float32Array(4)) }] as const);
    this.uniforms = { ...Object.fromEntries(empty), cameras: { value: table(training.rows) } };
  }

  /** Sets a scene of the same shape; fields that are the same objects as before are not uploaded again. */
  write(fields: Fields): void {
    for (const [name, sources] of Object.entries(TABLES)) {
      if (sources.every((source) => fields.get(source) === this.written.get(source))) continue;
      const uniform = this.uniforms[name]!;
      uniform.value = written(uniform.value, this.numbers(name, fields));
    }
    this.written = new Map(fields);
  }

  dispose(): void {
    for (const { value } of Object.values(this.uniforms)) value.dispose();
  }

  private numbers(name: string, fields: Fields): Float32Array {
    if (name === "weights") return packedWeights(fields, this.shape);
    const tensor = fields.get(TABLES[name]![0]!)!;
    const data = tensor.data as Float32Array;
    // Offsets have three numbers for each Gaussian, all others one row for each anchor or free Gaussian.
    return paddedRows(data, name === "offsets" ? 3 : tensor.shape[1]!);
  }
}

/** The texture with these numbers, or a new one if they do not fit. */
function written(texture: DataTexture, numbers: Float32Array): DataTexture {
  const data = texture.image.data as Float32Array;
  if (numbers.length > data.length) {
    texture.dispose();
    return table(numbers);
  }
  data.set(numbers);
  texture.needsUpdate = true;
  return texture;
}

function table(numbers: Float32Array): DataTexture {
  const rows = Math.max(Math.ceil(numbers.length / (4 * WIDTH)), 1);
  const data = new Float32Array(4 * WIDTH * rows);
  data.set(numbers);
  const texture = new DataTexture(data, WIDTH, rows, RGBAFormat, FloatType);
  texture.needsUpdate = true;
  return texture;
}
