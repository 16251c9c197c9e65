// SPDX-License-Identifier: Apache-2.0
/** The fields of a scene and its training cameras as three.js textures. */

import type { Fields } from "@structgstream/core";
import {
  FieldTables,
  type Shape,
  TABLE_NAMES,
  TABLE_WIDTH_BITS,
  type TableName,
  type TrainingCameras,
} from "@structgstream/gl/shading";
import { DataTexture, FloatType, type IUniform, RGBAFormat } from "three";

const WIDTH = 1 << TABLE_WIDTH_BITS;

export class FieldTextures {
  /** By names in the shader; three.js uploads changes. */
  readonly uniforms: Readonly<Record<TableName | "cameras", IUniform<DataTexture>>>;
  private readonly tables: FieldTables;

  constructor(shape: Shape, training: TrainingCameras) {
    this.tables = new FieldTables(shape);
    const empty = TABLE_NAMES.map((name) => [name, { value: table(new Float32Array(4)) }] as const);
    const cameras = ["cameras", { value: table(training.rows) }] as const;
    this.uniforms = Object.fromEntries([...empty, cameras]) as FieldTextures["uniforms"];
  }

  /** Sets a scene of the same shape. */
  write(fields: Fields): void {
    for (const [name, numbers] of this.tables.changed(fields)) {
      const uniform = this.uniforms[name];
      uniform.value = written(uniform.value, numbers);
    }
  }

  dispose(): void {
    for (const { value } of Object.values(this.uniforms)) value.dispose();
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
