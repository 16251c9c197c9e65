// SPDX-License-Identifier: Apache-2.0
/** Sampling intervals, computed once per state of the scene and read by the projection of every picture. */

import type { Tensor } from "@structgstream/core";
import type { TrainingCameras } from "../sampling.js";
import type { Snapshot } from "../scene.js";
import { samplingProgram } from "../shaders/sampling.js";
import { bindTextures } from "./binding.js";
import type { Device } from "./device.js";
import type { Program, Resources } from "./resources.js";
import type { SceneTextures } from "./sceneTextures.js";
import { TABLE_WIDTH_BITS, Table } from "./table.js";

export class SamplingPass {
  /** Bits of a float for each anchor, then for each free Gaussian. */
  readonly intervals: Table;
  private readonly cameras: Table;
  private readonly program: Program;
  private readonly framebuffer: WebGLFramebuffer;
  private attached: WebGLTexture | undefined;
  private written: TrainingCameras | undefined;
  private readonly seen: (Tensor | undefined)[] = [];

  constructor(
    private readonly resources: Resources,
    device: Device,
  ) {
    this.program = resources.program(samplingProgram());
    this.framebuffer = resources.framebuffer();
    this.intervals = new Table(resources, device, "R32UI", "sampling intervals");
    this.cameras = new Table(resources, device, "RGBA32F", "training cameras");
  }

  /**
   * @param scene has the snapshot's fields
   * @throws GlError too large for this device
   */
  update(scene: SceneTextures, { fields, training }: Snapshot): void {
    const given = [fields.get("anchor_positions"), fields.get("free")];
    if (this.written === training && given.every((tensor, i) => tensor === this.seen[i])) return;
    const { gl } = this.resources;
    const { anchors, free } = scene.sizes;
    const count = anchors + free;
    if (this.written !== training) this.cameras.write(training.rows);
    this.intervals.reserve(count);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    if (this.attached !== this.intervals.texture) {
      this.attached = this.intervals.texture;
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.attached!, 0);
    }
    const { program } = this;
    bindTextures(gl, program, { ...scene.textures("positions", "free"), cameras: this.cameras.texture });
    gl.uniform1i(program.at("anchors"), anchors);
    gl.uniform1i(program.at("count"), count);
    gl.uniform1i(program.at("cameraCount"), training.count);
    gl.disable(gl.BLEND);
    gl.viewport(0, 0, 1 << TABLE_WIDTH_BITS, Math.ceil(count / (1 << TABLE_WIDTH_BITS)));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    this.written = training;
    this.seen.splice(0, 2, ...given);
  }
}
