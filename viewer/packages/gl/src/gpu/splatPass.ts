// SPDX-License-Identifier: Apache-2.0
/** Blends splats from far to near into a texture. */

import { cornerIndices, INDICES_PER_SPLAT, SPLATS_PER_CALL, splatProgram } from "../shaders/splat.js";
import { bindTextures } from "./binding.js";
import type { Device } from "./device.js";
import type { ProjectionPass } from "./projectionPass.js";
import type { Program, Resources } from "./resources.js";
import type { SceneTextures } from "./sceneTextures.js";
import { plainTexture } from "./table.js";

export class SplatPass {
  /** The result: colours times coverage, and coverage. */
  target: WebGLTexture | undefined;
  private readonly program: Program;
  private readonly framebuffer: WebGLFramebuffer;
  private readonly corners: WebGLVertexArrayObject;
  private width = 0;
  private height = 0;

  constructor(
    private readonly resources: Resources,
    private readonly device: Device,
  ) {
    const { gl } = resources;
    this.program = resources.program(splatProgram());
    this.framebuffer = resources.framebuffer();
    // Instancing would need less memory, but is several times slower on software GPUs.
    this.corners = resources.vertexArray();
    gl.bindVertexArray(this.corners);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, resources.buffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, cornerIndices(), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  /** @param scene undefined for an empty picture */
  draw(scene: SceneTextures | undefined, projected: ProjectionPass | undefined, width: number, height: number): void {
    const { program } = this;
    const { gl } = this.resources;
    this.resize(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (scene && projected) {
      bindTextures(gl, program, {
        ...scene.textures("slots"),
        first: projected.first.texture,
        second: projected.second.texture,
      });
      gl.uniform2f(program.at("size"), width, height);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.bindVertexArray(this.corners);
      for (let start = 0; start < scene.splats; start += SPLATS_PER_CALL) {
        gl.uniform1i(program.at("start"), start);
        const count = Math.min(SPLATS_PER_CALL, scene.splats - start);
        gl.drawElements(gl.TRIANGLES, INDICES_PER_SPLAT * count, gl.UNSIGNED_SHORT, 0);
      }
      gl.bindVertexArray(null);
      gl.disable(gl.BLEND);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  private resize(width: number, height: number): void {
    if (this.target && width === this.width && height === this.height) return;
    const { gl } = this.resources;
    if (this.target) this.resources.delete(this.target);
    this.target = plainTexture(this.resources);
    [this.width, this.height] = [width, height];
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl[this.device.blendFormat], width, height);
    // Displayed larger than it is drawn if the resolution is scaled down.
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.target, 0);
  }
}
