// SPDX-License-Identifier: Apache-2.0
/** The fields of a scene and its training cameras as textures of PlayCanvas. */

import type { Fields } from "@structgstream/core";
import {
  FieldTables,
  type Shape,
  TABLE_NAMES,
  TABLE_WIDTH_BITS,
  type TrainingCameras,
} from "@structgstream/gl/shading";
import { ADDRESS_CLAMP_TO_EDGE, FILTER_NEAREST, type GraphicsDevice, PIXELFORMAT_RGBA32F, Texture } from "playcanvas";

const WIDTH = 1 << TABLE_WIDTH_BITS;

export class FieldTextures {
  /** By names in the shader. */
  readonly textures = new Map<string, Texture>();
  private readonly tables: FieldTables;

  constructor(
    private readonly device: GraphicsDevice,
    shape: Shape,
    training: TrainingCameras,
  ) {
    this.tables = new FieldTables(shape);
    for (const name of TABLE_NAMES) this.set(name, new Float32Array(4));
    this.set("cameras", training.rows);
  }

  /** Sets a scene of the same shape. */
  write(fields: Fields): void {
    for (const [name, numbers] of this.tables.changed(fields)) this.set(name, numbers);
  }

  destroy(): void {
    for (const texture of this.textures.values()) texture.destroy();
    this.textures.clear();
  }

  private set(name: string, numbers: Float32Array): void {
    const rows = Math.max(Math.ceil(numbers.length / (4 * WIDTH)), 1);
    let texture = this.textures.get(name);
    if (!texture || texture.height < rows) {
      texture?.destroy();
      texture = new Texture(this.device, {
        name,
        width: WIDTH,
        height: rows,
        format: PIXELFORMAT_RGBA32F,
        mipmaps: false,
        minFilter: FILTER_NEAREST,
        magFilter: FILTER_NEAREST,
        addressU: ADDRESS_CLAMP_TO_EDGE,
        addressV: ADDRESS_CLAMP_TO_EDGE,
      });
      this.textures.set(name, texture);
    }
    const pixels = texture.lock() as Float32Array;
    pixels.set(numbers);
    texture.unlock();
  }
}
