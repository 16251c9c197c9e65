// SPDX-License-Identifier: Apache-2.0
/** A frame of a stream as an object of a three.js scene. */

import { dyno, SplatGenerator, SplatTransformer } from "@sparkjsdev/spark";
import { type Fields, StreamError, type StreamHeader } from "@structgstream/core";
import { type Shape, sameShape, shapeOf, sizesOf, trainingCamerasOf } from "@structgstream/gl/shading";
import { type IUniform, Matrix4, Vector3 } from "three";
import { FieldTextures } from "./fieldTextures.js";
import { splatOfNumber } from "./generator.js";

type FrameUpdateContext = Parameters<NonNullable<SplatGenerator["frameUpdate"]>>[0];

/** Movement of the camera, in scene units, below which splats are not generated again. */
const STILL = 1e-4;

/**
 * Shows one frame at a time. Its axes are those of three.js, y up, and its units those of the capture. It can be moved as any object.
 *
 * The MLPs are evaluated on the GPU when the camera or the frame changes. Exposure of single cameras and the
 * environment are left out, because the surrounding three.js scene has its own.
 */
export class StreamSplats extends SplatGenerator {
  private textures: FieldTextures | undefined;
  private shape: Shape | undefined;
  private readonly transformer = new SplatTransformer();
  private readonly eye: IUniform<Vector3> = { value: new Vector3(Number.NaN, 0, 0) };
  private readonly structuredCount: IUniform<number> = { value: 0 };
  private readonly toScene = new Matrix4();

  constructor(private readonly header: StreamHeader) {
    super({});
    const { center, scale } = header.similarity;
    this.scale.setScalar(1 / scale);
    this.rotation.x = Math.PI; // from y down, z forward
    this.position.set(center[0], -center[1], -center[2]);
    this.frameUpdate = (context) => this.look(context);
  }

  /**
   * Shows a frame, given as `StreamReader.frame(index).fields`.
   *
   * @throws StreamError it has no anchors' fields
   */
  show(fields: Fields): void {
    if (!fields.has("anchor_offsets") || !fields.has("free")) {
      throw new StreamError("These fields are no whole frame; expected those of StreamReader.frame(index).");
    }
    const shape = shapeOf(fields, this.header.distanceInput);
    if (!this.textures || !this.shape || !sameShape(this.shape, shape)) this.begin(shape);
    this.textures!.write(fields);
    const { anchors, offsetsPerAnchor, free } = sizesOf(fields);
    this.structuredCount.value = anchors * offsetsPerAnchor;
    const splats = anchors * offsetsPerAnchor + free;
    if (splats !== this.numSplats) {
      this.numSplats = splats;
      this.updateMappingVersion();
    }
    this.updateVersion();
  }

  dispose(): void {
    this.textures?.dispose();
    this.textures = undefined;
    this.generator = undefined;
    this.numSplats = 0;
  }

  private begin(shape: Shape): void {
    this.textures?.dispose();
    const training = trainingCamerasOf(this.header);
    const textures = new FieldTextures(shape, training);
    this.textures = textures;
    this.shape = shape;
    const { eye, structuredCount } = this;
    const uniforms = { ...textures.uniforms, eye, structuredCount, cameraCount: { value: training.count } };
    this.generator = dyno.dynoBlock({ index: "int" }, { gsplat: dyno.Gsplat }, ({ index }) => {
      if (!index) throw new RangeError("Spark gave no number of a splat");
      return { gsplat: this.transformer.applyGsplat(splatOfNumber(shape, uniforms, index)) };
    });
  }

  /** Called before each picture of Spark, with the present camera. */
  private look({ viewToWorld }: FrameUpdateContext): void {
    this.updateWorldMatrix(true, false);
    const eye = new Vector3().setFromMatrixPosition(viewToWorld);
    eye.applyMatrix4(this.toScene.copy(this.matrixWorld).invert());
    const moved = this.transformer.update(this);
    if (!moved && eye.distanceTo(this.eye.value) < STILL) return;
    this.eye.value.copy(eye);
    this.updateVersion();
  }
}
