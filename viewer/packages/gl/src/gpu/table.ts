// SPDX-License-Identifier: Apache-2.0
/** A list of texels in a 2D texture, row by row: what shaders read by number. */

import { GlError } from "../errors.js";
import type { Device } from "./device.js";
import type { Resources } from "./resources.js";

/** Every WebGL2 device has textures this wide; a power of two, so that shaders shift and mask. */
export const TABLE_WIDTH_BITS = 11;
const WIDTH = 1 << TABLE_WIDTH_BITS;
/** Lists that change their length get so much room more, to be reused for the next ones. */
const ROOM = 1.25;

export type TexelFormat = "R32UI" | "RG32F" | "RGB32F" | "RGBA32F" | "RGBA32UI";
export type TexelData = Float32Array | Uint32Array;

const CHANNELS: Readonly<Record<TexelFormat, number>> = { R32UI: 1, RG32F: 2, RGB32F: 3, RGBA32F: 4, RGBA32UI: 4 };

export class Table {
  texture: WebGLTexture | undefined;
  private rows = 0;

  /** @param name what messages call it */
  constructor(
    private readonly resources: Resources,
    private readonly device: Device,
    readonly format: TexelFormat,
    private readonly name: string,
  ) {}

  /**
   * Room for `texels`; what was there is lost when there was less.
   *
   * @throws GlError more than this device's textures hold
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
    if (this.texture) this.resources.deleteTexture(this.texture);
    this.rows = this.texture ? Math.min(Math.ceil(rows * ROOM), maxTextureSize) : rows;
    this.texture = plainTexture(this.resources);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl[this.format], WIDTH, this.rows);
  }

  /** The first texels become `data`, of which `count` numbers are used. */
  write(data: TexelData, count = data.length): void {
    const channels = CHANNELS[this.format];
    const texels = Math.ceil(count / channels);
    this.reserve(texels);
    const { gl } = this.resources;
    const format = this.format === "R32UI" ? gl.RED_INTEGER : this.format === "RG32F" ? gl.RG : this.colours();
    const type = data instanceof Uint32Array ? gl.UNSIGNED_INT : gl.FLOAT;
    gl.bindTexture(gl.TEXTURE_2D, this.texture!);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);
    const full = Math.floor(texels / WIDTH);
    if (full) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, full, format, type, data, 0);
    const rest = texels - full * WIDTH;
    if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, full, rest, 1, format, type, data, full * WIDTH * channels);
  }

  private colours(): number {
    const { gl } = this.resources;
    if (this.format === "RGBA32UI") return gl.RGBA_INTEGER;
    return this.format === "RGB32F" ? gl.RGB : gl.RGBA;
  }

  delete(): void {
    if (this.texture) this.resources.deleteTexture(this.texture);
    this.texture = undefined;
    this.rows = 0;
  }
}

/** A new 2D texture, bound, that is read as it is: no filter, no repetition. */
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
