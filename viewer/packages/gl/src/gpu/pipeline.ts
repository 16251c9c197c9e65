// SPDX-License-Identifier: Apache-2.0
/** All GPU stages, from fields to the canvas; created again after a context was restored. */

import type { Fields } from "@structgstream/core";
import { center, resized } from "../cameraMath.js";
import { type Shape, sameShape, shapeOf } from "../scene.js";
import type { Sorted } from "../sorting/orders.js";
import type { Camera, MlpPath } from "../types.js";
import { chosenPath, type Device } from "./device.js";
import { FeedbackPass } from "./feedbackPass.js";
import type { MlpPass } from "./mlpPass.js";
import { type Look, PicturePass, type Target } from "./picturePass.js";
import { ProjectionPass } from "./projectionPass.js";
import { Resources } from "./resources.js";
import { SamplingPass } from "./samplingPass.js";
import { SceneTextures } from "./sceneTextures.js";
import { SplatPass } from "./splatPass.js";
import { TargetsPass } from "./targetsPass.js";

/** The stages that depend on the scene's shape: widths of the MLPs, Gaussians per anchor. */
interface Stage {
  readonly shape: Shape;
  readonly scene: SceneTextures;
  readonly sampling: SamplingPass;
  readonly mlp: MlpPass;
  readonly projection: ProjectionPass;
}

const NOTHING = new Float32Array(0);
const CANVAS: Target = { framebuffer: null, x: 0, y: 0, transparent: false };

export class Pipeline {
  private readonly resources: Resources;
  /** Those of the stage, which are deleted with it. */
  private readonly ofStage: Resources;
  readonly path: MlpPath;
  private readonly splats: SplatPass;
  private readonly picture: PicturePass;
  private stage: Stage | undefined;
  private fields: Fields | undefined;

  /** @throws GlError the device does not support the requested path, or rejects a shader */
  constructor(
    readonly device: Device,
    askedPath: MlpPath | undefined,
  ) {
    this.path = chosenPath(device, askedPath);
    this.resources = new Resources(device.gl);
    this.ofStage = new Resources(device.gl);
    this.splats = new SplatPass(this.resources, device);
    this.picture = new PicturePass(this.resources);
  }

  /**
   * Sets a scene and its order; there is no scene if it throws.
   *
   * @throws GlError the scene is too large for this device
   */
  adopt({ snapshot, order }: Sorted, distanceInput: boolean): void {
    const shape = shapeOf(snapshot.fields, distanceInput);
    if (!this.stage || !sameShape(this.stage.shape, shape)) {
      this.forget();
      this.stage = this.stageFor(shape);
    }
    try {
      this.stage.scene.adopt(snapshot, order);
      this.stage.sampling.update(this.stage.scene, snapshot);
    } catch (error) {
      this.forget();
      throw error;
    }
    this.fields = snapshot.fields;
  }

  /** The scene of a stream played before. */
  forget(): void {
    this.ofStage.deleteAll();
    this.stage = undefined;
    this.fields = undefined;
  }

  get counts(): Resources["counts"] {
    const [own, stage] = [this.resources.counts, this.ofStage.counts];
    return {
      textures: own.textures + stage.textures,
      buffers: own.buffers + stage.buffers,
      programs: own.programs + stage.programs,
      framebuffers: own.framebuffers + stage.framebuffers,
    };
  }

  delete(): void {
    this.forget();
    this.resources.deleteAll();
  }

  evaluate(camera: Camera): void {
    this.stage?.mlp.evaluate(this.stage.scene, center(camera));
  }

  /** Draws splats at `scale` times the camera's size. */
  draw(camera: Camera, scale: number): void {
    const factor = Math.min(scale, this.device.maxTextureSize / Math.max(camera.width, camera.height));
    const width = Math.max(Math.round(camera.width * factor), 1);
    const height = Math.max(Math.round(camera.height * factor), 1);
    this.stage?.projection.project(this.stage.scene, resized(camera, width, height));
    this.splats.draw(this.stage?.scene, this.stage?.projection, width, height);
  }

  /** Copies the last rendering to the canvas, or another target. */
  show(camera: Camera, look: Look, target = CANVAS): void {
    const environment = this.fields?.get("environment")?.data as Float32Array | undefined;
    if (!this.splats.target) return;
    this.picture.draw(this.splats.target, camera, environment ?? NOTHING, look, target);
  }

  private stageFor(shape: Shape): Stage {
    const { ofStage: resources, device } = this;
    const most = device.splatsPerPass[this.path];
    const Pass = this.path === "mrt" ? TargetsPass : FeedbackPass;
    const sampling = new SamplingPass(resources, device);
    const mlp = new Pass(resources, device, shape, most);
    return {
      shape,
      scene: new SceneTextures(resources, device, shape),
      sampling,
      mlp,
      projection: new ProjectionPass(resources, device, shape.offsetsPerAnchor, mlp, sampling.intervals),
    };
  }
}
