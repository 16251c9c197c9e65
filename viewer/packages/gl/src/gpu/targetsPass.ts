// SPDX-License-Identifier: Apache-2.0
/** MLPs by render targets: one fragment per anchor; outputs are packed as half floats into layers of a texture. */

import { GlError } from "../errors.js";
import type { Shape } from "../scene.js";
import { LAYER_WIDTH_BITS, splatRanges, targetsProgram } from "../shaders/mlp.js";
import { TARGETS_READING } from "../shaders/reading.js";
import type { Vector } from "../vectors.js";
import { bindInputs } from "./binding.js";
import { type Device, PAIR_TARGETS } from "./device.js";
import type { MlpPass } from "./mlpPass.js";
import type { Program, Resources } from "./resources.js";
import type { SceneTextures } from "./sceneTextures.js";
import { plainTexture } from "./table.js";
import { mlpLayout } from "./weights.js";

const WIDTH = 1 << LAYER_WIDTH_BITS;

interface Pass {
  readonly program: Program;
  readonly firstLayer: number;
  readonly targets: number;
  readonly framebuffer: WebGLFramebuffer;
}

export class TargetsPass implements MlpPass {
  readonly reading = TARGETS_READING;
  readonly passTexels = 0;
  private readonly passes: Pass[];
  private readonly layers: number;
  private texture: WebGLTexture | undefined;
  private rows = 0;

  constructor(
    private readonly resources: Resources,
    private readonly device: Device,
    shape: Shape,
    most: number,
  ) {
    const splats = shape.offsetsPerAnchor;
    this.layers = PAIR_TARGETS * Math.ceil(splats / 2);
    const layout = mlpLayout(shape);
    this.passes = splatRanges(splats, most).map((range) => ({
      program: resources.program(targetsProgram(shape, layout, range)),
      firstLayer: (PAIR_TARGETS * range.first) / 2,
      targets: Math.ceil((PAIR_TARGETS * range.count) / 2),
      framebuffer: resources.framebuffer(),
    }));
  }

  evaluate(scene: SceneTextures, eye: Vector): void {
    const { gl } = this.resources;
    const count = scene.anchorCount;
    if (count === 0) return;
    const rows = Math.ceil(count / WIDTH);
    this.reserve(rows);
    gl.disable(gl.BLEND);
    gl.viewport(0, 0, WIDTH, rows);
    for (const { program, framebuffer } of this.passes) {
      bindInputs(gl, program, scene, eye);
      gl.uniform1i(program.at("count"), count);
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  outputs(): ReturnType<MlpPass["outputs"]> {
    return { textures: {}, arrays: { outputs: this.texture } };
  }

  private reserve(rows: number): void {
    if (rows <= this.rows) return;
    const { gl } = this.resources;
    const { maxTextureSize, maxLayers } = this.device;
    if (rows > maxTextureSize || this.layers > maxLayers) {
      throw new GlError(
        `The scene is too large for this device: the MLP outputs of the visible anchors take ${rows} rows of ` +
          `${this.layers} layers, at most ${maxTextureSize} of ${maxLayers} fit; set maxSplats.`,
      );
    }
    if (this.texture) this.resources.delete(this.texture);
    this.rows = this.rows ? Math.min(Math.ceil(1.25 * rows), maxTextureSize) : rows;
    this.texture = plainTexture(this.resources, gl.TEXTURE_2D_ARRAY);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA32UI, WIDTH, this.rows, this.layers);
    for (const { framebuffer, firstLayer, targets } of this.passes) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      for (let t = 0; t < targets; t++) {
        const attachment = gl.COLOR_ATTACHMENT0 + t;
        gl.framebufferTextureLayer(gl.FRAMEBUFFER, attachment, this.texture, 0, firstLayer + t);
      }
      gl.drawBuffers(Array.from({ length: targets }, (_, t) => gl.COLOR_ATTACHMENT0 + t));
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }
}
