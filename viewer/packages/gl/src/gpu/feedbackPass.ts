// SPDX-License-Identifier: Apache-2.0
/** MLPs by transform feedback: one vertex per anchor, in fp32. The buffer is copied to a texture on the GPU. */

import { GlError } from "../errors.js";
import type { Shape } from "../scene.js";
import { feedbackProgram, type SplatRange, splatRanges } from "../shaders/mlp.js";
import { feedbackReading } from "../shaders/reading.js";
import type { Vector } from "../vectors.js";
import { bindInputs } from "./binding.js";
import { type Device, SPLAT_VECTORS } from "./device.js";
import type { MlpPass } from "./mlpPass.js";
import type { Program, Resources } from "./resources.js";
import type { SceneTextures } from "./sceneTextures.js";
import { plainTexture, TABLE_WIDTH_BITS } from "./table.js";
import { mlpLayout } from "./weights.js";

const WIDTH = 1 << TABLE_WIDTH_BITS;
const VECTOR_BYTES = 16;

export class FeedbackPass implements MlpPass {
  readonly reading: string;
  private readonly passes: { range: SplatRange; program: Program }[];
  private readonly feedback: WebGLTransformFeedback;
  private buffer: WebGLBuffer | undefined;
  private texture: WebGLTexture | undefined;
  private passRows = 0;
  private room = 0;

  constructor(
    private readonly resources: Resources,
    private readonly device: Device,
    shape: Shape,
    most: number,
  ) {
    const splats = shape.offsetsPerAnchor;
    this.reading = feedbackReading(splats, most);
    const layout = mlpLayout(shape);
    this.passes = splatRanges(splats, most).map((range) => ({
      range,
      program: resources.program(feedbackProgram(shape, layout, range)),
    }));
    this.feedback = resources.feedback();
  }

  evaluate(scene: SceneTextures, eye: Vector): void {
    const { gl } = this.resources;
    const count = scene.anchorCount;
    if (count === 0) return;
    this.reserve(count);
    for (const [number, { range, program }] of this.passes.entries()) {
      bindInputs(gl, program, scene, eye);
      gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, this.feedback);
      gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, this.buffer!);
      gl.enable(gl.RASTERIZER_DISCARD);
      gl.beginTransformFeedback(gl.POINTS);
      gl.drawArrays(gl.POINTS, 0, count);
      gl.endTransformFeedback();
      gl.disable(gl.RASTERIZER_DISCARD);
      gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
      gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
      this.copy(count * range.count * SPLAT_VECTORS, number * this.passRows);
    }
  }

  outputs(): ReturnType<MlpPass["outputs"]> {
    return { textures: { outputs: this.texture }, arrays: {} };
  }

  /** Distance, in texels, between the outputs of consecutive passes. */
  get passTexels(): number {
    return this.passRows * WIDTH;
  }

  /** Allocates memory for the outputs of `count` anchors, with a reserve when it grows. */
  private reserve(count: number): void {
    if (count <= this.room) return;
    const { gl } = this.resources;
    const { maxTextureSize } = this.device;
    const perAnchor = this.passes[0]!.range.count * SPLAT_VECTORS;
    const rowsFor = (anchors: number) => Math.ceil((anchors * perAnchor) / WIDTH);
    const wanted = this.room ? Math.ceil(1.25 * count) : count;
    this.room = rowsFor(wanted) * this.passes.length <= maxTextureSize ? wanted : count;
    this.passRows = rowsFor(this.room);
    const rows = this.passRows * this.passes.length;
    if (rows > maxTextureSize) {
      throw new GlError(
        `The scene is too large for this device: the MLP outputs of ${count} visible anchors take ${rows} rows of a ` +
          `texture, which has at most ${maxTextureSize}; set maxSplats.`,
      );
    }
    if (this.buffer) this.resources.delete(this.buffer);
    if (this.texture) this.resources.delete(this.texture);
    this.buffer = this.resources.buffer();
    gl.bindBuffer(gl.TRANSFORM_FEEDBACK_BUFFER, this.buffer);
    gl.bufferData(gl.TRANSFORM_FEEDBACK_BUFFER, this.passRows * WIDTH * VECTOR_BYTES, gl.DYNAMIC_COPY);
    gl.bindBuffer(gl.TRANSFORM_FEEDBACK_BUFFER, null);
    this.texture = plainTexture(this.resources);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, WIDTH, rows);
  }

  private copy(texels: number, row: number): void {
    const { gl } = this.resources;
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, this.buffer!);
    gl.bindTexture(gl.TEXTURE_2D, this.texture!);
    const full = Math.floor(texels / WIDTH);
    if (full) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, WIDTH, full, gl.RGBA, gl.FLOAT, 0);
    const rest = texels - full * WIDTH;
    const offset = full * WIDTH * VECTOR_BYTES;
    if (rest) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row + full, rest, 1, gl.RGBA, gl.FLOAT, offset);
    gl.bindBuffer(gl.PIXEL_UNPACK_BUFFER, null);
  }
}
