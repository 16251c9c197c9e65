// SPDX-License-Identifier: Apache-2.0
/** Projects Gaussians to ellipses on the picture, once per slot and camera. */

import { axes, center } from "../cameraMath.js";
import { projectionProgram } from "../shaders/projection.js";
import type { Camera } from "../types.js";
import { dot } from "../vectors.js";
import { bindTextures } from "./binding.js";
import type { Device } from "./device.js";
import type { MlpPass } from "./mlpPass.js";
import type { Program, Resources } from "./resources.js";
import type { SceneTextures } from "./sceneTextures.js";
import { TABLE_WIDTH_BITS, Table } from "./table.js";

export class ProjectionPass {
  readonly first: Table;
  readonly second: Table;
  private readonly program: Program;
  private readonly framebuffer: WebGLFramebuffer;
  private attached: WebGLTexture | undefined;

  constructor(
    private readonly resources: Resources,
    device: Device,
    splatsPerAnchor: number,
    private readonly mlp: MlpPass,
    private readonly intervals: Table,
  ) {
    this.program = resources.program(projectionProgram(splatsPerAnchor, mlp.reading));
    this.first = new Table(resources, device, "RGBA32UI", "projected splats");
    this.second = new Table(resources, device, "RGBA32UI", "projected splats");
    this.framebuffer = resources.framebuffer();
  }

  /** @throws GlError more splats than fit this device's textures */
  project(scene: SceneTextures, camera: Camera): void {
    const { program } = this;
    const { gl } = this.resources;
    const count = scene.slotCount;
    if (count === 0) return;
    this.reserve(count);
    const { textures, arrays } = this.mlp.outputs();
    bindTextures(
      gl,
      program,
      {
        ...scene.textures("positions", "offsetScales", "baseScales", "offsets", "free", "anchors"),
        intervals: this.intervals.texture,
        ...textures,
      },
      arrays,
    );
    gl.uniform1i(program.at("passTexels"), this.mlp.passTexels);
    gl.uniform1i(program.at("anchorCount"), scene.anchorCount);
    gl.uniform1i(program.at("slotCount"), count);
    gl.uniform1i(program.at("freeAt"), scene.sizes.anchors);
    const [right, down, forward] = axes(camera);
    const eye = center(camera);
    // The shader's matrices are column by column.
    gl.uniformMatrix3fv(program.at("rotation"), true, [...right, ...down, ...forward]);
    gl.uniform3f(program.at("translation"), -dot(right, eye), -dot(down, eye), -dot(forward, eye));
    const { fx, fy, cx, cy } = camera.K;
    gl.uniform4f(program.at("K"), fx, fy, cx, cy);
    gl.uniform2f(program.at("size"), camera.width, camera.height);
    gl.uniform1f(program.at("near"), camera.near);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.viewport(0, 0, 1 << TABLE_WIDTH_BITS, Math.ceil(count / (1 << TABLE_WIDTH_BITS)));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  private reserve(count: number): void {
    const { gl } = this.resources;
    this.first.reserve(count);
    this.second.reserve(count);
    if (this.attached === this.first.texture) return;
    this.attached = this.first.texture;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    for (const [i, table] of [this.first, this.second].entries()) {
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, table.texture!, 0);
    }
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
  }
}
