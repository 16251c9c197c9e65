// SPDX-License-Identifier: Apache-2.0
/** Textures of one draw call: each sampler gets a unit of its own. */

import type { Vector } from "../vectors.js";
import type { Program } from "./resources.js";
import type { SceneTextures } from "./sceneTextures.js";

/** Makes `program` current and binds its textures. */
export function bindTextures(
  gl: WebGL2RenderingContext,
  program: Program,
  textures: Readonly<Record<string, WebGLTexture | undefined>>,
  arrays: Readonly<Record<string, WebGLTexture | undefined>> = {},
): void {
  gl.useProgram(program.handle);
  let unit = 0;
  for (const [target, named] of [
    [gl.TEXTURE_2D, textures],
    [gl.TEXTURE_2D_ARRAY, arrays],
  ] as const) {
    for (const [name, texture] of Object.entries(named)) {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(target, texture ?? null);
      gl.uniform1i(program.at(name), unit++);
    }
  }
  gl.activeTexture(gl.TEXTURE0);
}

/** Makes `program` current with the inputs of the MLPs. */
export function bindInputs(gl: WebGL2RenderingContext, program: Program, scene: SceneTextures, eye: Vector): void {
  bindTextures(gl, program, scene.textures("positions", "features", "appearance", "weights", "anchors"));
  gl.uniform3f(program.at("eye"), ...eye);
}
