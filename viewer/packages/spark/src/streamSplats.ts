// SPDX-License-Identifier: Apache-2.0
/** Streams as objects of a three.js scene. */

import { dyno, SplatAccumulator, SplatGenerator, SplatTransformer } from "@sparkjsdev/spark";
import {
  type Fields,
  Playback,
  type PlaybackOptions,
  StreamError,
  type StreamHeader,
  type StreamReader,
} from "@structgstream/core";
import {
  center,
  fetchStream,
  focusPoint,
  rigCameras,
  type Shape,
  sameShape,
  shapeOf,
  sizesOf,
  trainingCamerasOf,
  upAxis,
  type Vector,
} from "@structgstream/gl/shading";
import { type IUniform, Matrix4, Vector3 } from "three";
import { FieldTextures } from "./fieldTextures.js";
import { splatOfNumber } from "./generator.js";

type FrameUpdateContext = Parameters<NonNullable<SplatGenerator["frameUpdate"]>>[0];

/**
 * Options of `SparkRenderer` with which streams look as trained: the low-pass of the training pictures is in the scales,
 * and they are blended in the order of depth. For pictures smaller than those of training see {@link blurAmount}.
 */
export const RENDERING = { preBlurAmount: 0, blurAmount: 0, sortRadial: false, maxStdDev: 3, clipXY: 4 } as const;

/** `blurAmount` of `SparkRenderer` against aliasing. @param size of the picture, 1 that of the training pictures */
export function blurAmount(size: number): number {
  return Math.max(0.15 - 0.3 * size * size, 0);
}

/** Movement of the camera, in scene units, below which splats are not generated again. */
const STILL = 1e-4;

/**
 * Shows one frame at a time. Its units are those of the capture, and its axes too, turned from y down to y up. It can be moved as any object.
 *
 * The MLPs are evaluated on the GPU when the camera or the frame changes. Exposure of single cameras and the
 * environment are left out, because the surrounding three.js scene has its own.
 */
export class StreamSplats extends SplatGenerator {
  protected disposed = false;
  private textures: FieldTextures | undefined;
  private shape: Shape | undefined;
  private readonly transformer = new SplatTransformer();
  private readonly eye: IUniform<Vector3> = { value: new Vector3(Number.NaN, 0, 0) };
  private readonly structuredCount: IUniform<number> = { value: 0 };
  private readonly toScene = new Matrix4();

  constructor(private readonly header: StreamHeader) {
    super({});
    const { center: middle, scale } = header.similarity;
    this.scale.setScalar(1 / scale);
    this.rotation.x = Math.PI; // from y down, z forward
    this.position.set(middle[0], -middle[1], -middle[2]);
    this.frameUpdate = (context) => this.advance(context);
  }

  /**
   * Shows a frame, given as `StreamReader.frame(index).fields`.
   *
   * @throws StreamError these are no whole frame, or the object was disposed of
   */
  show(fields: Fields): void {
    if (this.disposed) throw new StreamError("These splats were disposed of; make new ones.");
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

  /** Where the rig's first camera is, what the rig looks at, and its up direction, in the world. */
  view(): { eye: Vector3; target: Vector3; up: Vector3 } {
    this.updateWorldMatrix(true, false);
    const cameras = rigCameras(this.header);
    const point = (scene: Vector) => this.localToWorld(new Vector3(...scene));
    const up = new Vector3(...upAxis(cameras)).transformDirection(this.matrixWorld);
    return { eye: point(center(cameras[0]!)), target: point(focusPoint(cameras)), up };
  }

  /** Releases the textures; the object shows nothing any more. */
  dispose(): void {
    this.disposed = true;
    this.release();
    this.numSplats = 0;
  }

  /** Called before each picture of Spark, with the present camera. */
  protected advance(context: FrameUpdateContext): void {
    if (this.textures) this.look(context);
  }

  private release(): void {
    this.textures?.dispose();
    this.textures = undefined;
    // Spark stores a program for each generator, and three.js stores it until it is disposed of.
    if (this.generator) SplatAccumulator.generatorProgram.get(this.generator)?.prepareMaterial().dispose();
    this.generator = undefined;
  }

  private begin(shape: Shape): void {
    this.release();
    const training = trainingCamerasOf(this.header);
    const textures = new FieldTextures(shape, training);
    this.textures = textures;
    this.shape = shape;
    const { eye, structuredCount } = this;
    // Spark's own low-pass is switched off by `RENDERING`.
    const numbers = { cameraCount: { value: training.count }, ownBlur: { value: 0 } };
    const uniforms = { ...textures.uniforms, eye, structuredCount, ...numbers };
    this.generator = dyno.dynoBlock({ index: "int" }, { gsplat: dyno.Gsplat }, ({ index }) => {
      if (!index) throw new RangeError("Spark gave no number of a splat");
      return { gsplat: this.transformer.applyGsplat(splatOfNumber(shape, uniforms, index)) };
    });
  }

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

/** A whole stream, which plays while it is drawn. */
export class StreamClip extends StreamSplats {
  readonly playback: Playback;

  /** @throws StreamError the stream has no frame that can be shown */
  constructor(reader: StreamReader, options?: PlaybackOptions) {
    if (!reader.header) throw new StreamError(`${reader.name} has no frame that can be shown.`);
    super(reader.header);
    this.playback = new Playback(reader, ({ fields }) => this.show(fields), options);
  }

  /** Loads a stream file; see {@link fetchStream} for errors. */
  static async load(url: string | URL, options: PlaybackOptions & { signal?: AbortSignal } = {}): Promise<StreamClip> {
    return new StreamClip(await fetchStream(url, options.signal), options);
  }

  /** Also stops playing. */
  override dispose(): void {
    this.playback.pause();
    super.dispose();
  }

  protected override advance(context: FrameUpdateContext): void {
    // Spark 2.2 does not advance the time of its context.
    if (!this.disposed) this.playback.update(performance.now() / 1000);
    super.advance(context);
  }
}
