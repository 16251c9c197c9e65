// SPDX-License-Identifier: Apache-2.0
/** The final picture: the blended splats in front of the environment, with the exposure of a camera of the rig. */

import { axes } from "../cameraMath.js";
import { pictureProgram } from "../shaders/picture.js";
import type { Camera } from "../types.js";
import { bindTextures } from "./binding.js";
import type { Program, Resources } from "./resources.js";

/** `picture = gain * rendering + bias` for each channel. */
export interface Look {
  readonly gain: readonly [number, number, number];
  readonly bias: readonly [number, number, number];
}

/** A part of a framebuffer; its size is that of the picture. */
export interface Target {
  /** Null for the canvas. */
  readonly framebuffer: WebGLFramebuffer | null;
  /** Lower left corner, pixels. */
  readonly x: number;
  readonly y: number;
  /** The target gets coverage as alpha, and nothing behind the splats. */
  readonly transparent: boolean;
}

export class PicturePass {
  private program: Program | undefined;
  private rows = -1;

  constructor(private readonly resources: Resources) {}

  /** @param environment [E, 3], empty without one */
  draw(
    blended: WebGLTexture,
    camera: Camera,
    environment: Float32Array,
    look: Look,
    { framebuffer, x, y, transparent }: Target,
  ): void {
    const { gl } = this.resources;
    const program = this.programFor(environment.length / 3);
    bindTextures(gl, program, { blended });
    gl.uniform2f(program.at("size"), camera.width, camera.height);
    gl.uniform2f(program.at("corner"), x, y);
    gl.uniform1i(program.at("transparent"), Number(transparent));
    gl.uniform3f(program.at("gain"), ...look.gain);
    gl.uniform3f(program.at("bias"), ...look.bias);
    if (environment.length) gl.uniform3fv(program.at("environment"), environment);
    gl.uniformMatrix3fv(program.at("rays"), true, rays(camera));
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.disable(gl.BLEND);
    gl.viewport(x, y, camera.width, camera.height);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  private programFor(rows: number): Program {
    if (this.program && rows === this.rows) return this.program;
    if (this.program) this.resources.delete(this.program.handle);
    this.program = this.resources.program(pictureProgram(rows));
    this.rows = rows;
    return this.program;
  }
}

/** Row by row, from (pixel, 1) to a direction of the scene: R^T K^-1. */
function rays(camera: Camera): number[] {
  const { fx, fy, cx, cy } = camera.K;
  const [right, down, forward] = axes(camera);
  return [0, 1, 2].flatMap((i) => {
    const [x, y] = [right[i]! / fx, down[i]! / fy];
    return [x, y, forward[i]! - x * cx - y * cy];
  });
}
