// SPDX-License-Identifier: Apache-2.0
/** A list of texels in a 2D texture, row by row, which shaders read by index. */

import { GlError } from "../errors.js";
import type { Device } from "./device.js";
import type { Resources } from "./resources.js";

/** Width that every WebGL2 device supports; a power of two, so that shaders can shift and mask. */
export const TABLE_WIDTH_BITS = 11;
const WIDTH = 1 << TABLE_WIDTH_BITS;
/** Reserve of lists that change their length, so that their memory can be reused. */
const ROOM = 1.25;

export type TexelFormat = "R32UI" | "RG32F" | "RGB32F" | "RGBA32F" | "RGBA32UI";
export type TexelData = Float32Array | Uint32Array;

const CHANNELS: Readonly<Record<TexelFormat, number>> = { R32UI: 1, RG32F: 2, RGB32F: 3, RGBA32F: 4, RGBA32UI: 4 };

export class Table {
  texture: WebGLTexture | undefined;
  private rows = 0;

  /** @param name name in messages */
  constructor(
    private readonly resources: Resources,
    private readonly device: Device,
    readonly format: TexelFormat,
    private readonly name: string,
  ) {}

  /**
   * Allocates memory for `texels`; the content is lost if the memory grows.
   *
   * @throws GlError more than fit this device's textures
   */
  reserve(texels: number): void {
    const rows = Math.max(Math.ceil(texels / WIDTH), 1);
    const { maxTextureSize } = this.device;
    if (rows > maxTextureSize) {
      throw new GlError(
        `The scene is too large for this device: ${texels} entries of ${this.name}, at most ${WIDTH * maxTextureSize} ` +
          "fit its textures; play a stream with fewer anchors.",
      );
    }
    if (this.texture && rows <= this.rows) return;
    const { gl } = this.resources;
    if (this.texture) this.resources.delete(this.texture);
    this.rows = this.texture ? Math.min(Math.ceil(rows * ROOM), maxTextureSize) : rows;
    this.texture = plainTexture(this.resources);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl[this.format], WIDTH, this.rows);
  }

  /** Writes the first `count` numbers of `data` to the first texels. */
  write(data: TexelData, count = data.length): void {
    const channels = CHANNELS[this.format];
    const texels = Math.ceil(count / channels);
    this.reserve(texels);
    const { gl } = this.resources;
    const formats = {
      R32UI: gl.RED_INTEGER,
      RG32F: gl.RG,
      RGB32F: gl.RGB,
      RGBA32F: gl.RGBA,
      RGBA32UI: gl.RGBA_INTEGER,
    };
    const format = formats[this.format];
    const type = data instanceof Uint32Array ? gl.UNSIGNED_INT : gl.FLOAT;
    gl.bindTexture(gl.TEXTURE_2D, this.texture!);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);
    const full = Math.floor(texels / WIDTH);
    if (full) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, full, format, type, data, 0);
    const rest = texels - full * WIDTH;
    if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, full, rest, 1, format, type, data, full * WIDTH * channels);
  }
}

/** A new 2D texture, bound, without filtering and repetition. */
export function plainTexture(resources: Resources, target?: number): WebGLTexture {
  const { gl } = resources;
  const where = target ?? gl.TEXTURE_2D;
  const texture = resources.texture();
  gl.bindTexture(where, texture);
  gl.texParameteri(where, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(where, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  gl.texParameteri(where, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(where, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  return texture;
}

/** GLSL: texel `i` of a table. */
export const TABLE_GLSL = `
ivec2 place(int i) { return ivec2(i & ${WIDTH - 1}, i >> ${TABLE_WIDTH_BITS}); }
`;
