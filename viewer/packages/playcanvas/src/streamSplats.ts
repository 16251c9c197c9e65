// SPDX-License-Identifier: Apache-2.0
/** Streams as entities of a PlayCanvas scene. */

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
  streamSplatGlsl,
  trainingCamerasOf,
  upAxis,
  type Vector,
} from "@structgstream/gl/shading";
import {
  type AppBase,
  BoundingBox,
  Entity,
  type EventHandle,
  GSPLATDATA_LARGE,
  type GSplatComponent,
  GSplatContainer,
  GSplatFormat,
  Mat4,
  Vec3,
} from "playcanvas";
import { FieldTextures } from "./fieldTextures.js";

/**
 * Settings of the scene (`Object.assign(app.scene.gsplat, RENDERING)`) with which streams look as trained: the engine's own
 * leave out small and faint splats, and round scales to steps of 9 %.
 */
export const RENDERING = { minPixelSize: 0, minContribution: 0, dataFormat: GSPLATDATA_LARGE } as const;

/** Movement of the camera, in scene units, below which splats are not generated again. */
const STILL = 1e-4;
/** Variance that the engine adds to every splat, in square pixels: its shader has 0.3 in square half pixels. */
const ENGINE_BLUR = 0.075;
/** Reserve of containers, which cannot grow. */
const ROOM = 1.25;

/** The functions that the engine calls for a splat, in the order in which it does; its quaternions are w, x, y, z. */
function readGlsl(shape: Shape): string {
  return `${streamSplatGlsl(shape)}
StreamSplat present;
vec3 getCenter() {
  present = streamSplat(int(splat.index));
  return present.mean;
}
vec4 getRotation() { return present.rotation.wxyz; }
vec3 getScale() { return present.scales; }
vec4 getColor() { return present.color; }
`;
}

/**
 * Shows one frame at a time, as the entity `entity`, whose axes and units are the capture's, turned from y down to
 * y up; it can be moved as any entity.
 *
 * The MLPs are evaluated on the GPU for the position of `camera`, when that or the frame changes. Exposure of single cameras
 * and the environment are left out, because the surrounding scene has its own.
 */
export class StreamSplats {
  readonly entity = new Entity("structgstream");
  protected destroyed = false;
  private readonly component: GSplatComponent;
  private readonly handles: EventHandle[] = [];
  private textures: FieldTextures | undefined;
  private shape: Shape | undefined;
  private container: GSplatContainer | undefined;
  private readonly eye = new Vec3(Number.NaN, 0, 0);
  private ownBlur = 0;

  /**
   * @param camera entity with the camera that sees the splats
   * @throws StreamError the app draws with WebGPU
   */
  constructor(
    protected readonly app: AppBase,
    private readonly camera: Entity,
    private readonly header: StreamHeader,
  ) {
    if (!app.graphicsDevice.isWebGL2)
      throw new StreamError("Streams need PlayCanvas' WebGL2 device; this one is another.");
    const { center: middle, scale } = header.similarity;
    this.entity.setLocalScale(1 / scale, 1 / scale, 1 / scale);
    this.entity.setLocalEulerAngles(180, 0, 0); // from y down, z forward
    this.entity.setLocalPosition(middle[0], -middle[1], -middle[2]);
    this.component = this.entity.addComponent("gsplat") as GSplatComponent;
    this.handles.push(app.on("prerender", () => this.look()));
    this.entity.once("destroy", () => this.release());
  }

  /**
   * Shows a frame, given as `StreamReader.frame(index).fields`.
   *
   * @throws StreamError these are no whole frame, or the entity was destroyed
   */
  show(fields: Fields): void {
    if (this.destroyed) throw new StreamError("These splats were destroyed; make new ones.");
    if (!fields.has("anchor_offsets") || !fields.has("free")) {
      throw new StreamError("These fields are no whole frame; expected those of StreamReader.frame(index).");
    }
    const shape = shapeOf(fields, this.header.distanceInput);
    const { anchors, offsetsPerAnchor, free } = sizesOf(fields);
    const count = anchors * offsetsPerAnchor + free;
    if (!this.textures || !this.shape || !sameShape(this.shape, shape)) this.begin(shape);
    this.textures!.write(fields);
    const container = count > (this.container?.maxSplats ?? 0) ? this.replaced(shape, count) : this.container!;
    writeCenters(container, fields);
    container.update(count);
    if (this.component.resource !== container) this.component.resource = container;
    for (const [name, texture] of this.textures!.textures) this.component.setParameter(name, texture);
    this.component.setParameter("structuredCount", anchors * offsetsPerAnchor);
  }

  /** Where the rig's first camera is, what the rig looks at, and its up direction, in the world. */
  view(): { eye: Vec3; target: Vec3; up: Vec3 } {
    const toWorld = this.entity.getWorldTransform();
    const cameras = rigCameras(this.header);
    const point = (scene: Vector) => toWorld.transformPoint(new Vec3(...scene));
    const up = toWorld.transformVector(new Vec3(...upAxis(cameras))).normalize();
    return { eye: point(center(cameras[0]!)), target: point(focusPoint(cameras)), up };
  }

  /** Removes the entity and releases what it has on the GPU. */
  destroy(): void {
    this.entity.destroy();
  }

  protected release(): void {
    this.destroyed = true;
    for (const handle of this.handles.splice(0)) handle.off();
    this.textures?.destroy();
    this.textures = undefined;
    this.container?.destroy();
    this.container = undefined;
  }

  /** Calls a function when the app updates, until the entity is destroyed. */
  protected onUpdate(call: (elapsedSeconds: number) => void): void {
    this.handles.push(this.app.on("update", call));
  }

  private begin(shape: Shape): void {
    const training = trainingCamerasOf(this.header);
    this.textures?.destroy();
    this.textures = new FieldTextures(this.app.graphicsDevice, shape, training);
    this.shape = shape;
    this.component.setParameter("cameraCount", training.count);
    this.component.setParameter("eye", [0, 0, 0]);
    this.component.setParameter("ownBlur", 0);
    this.eye.x = Number.NaN;
    this.component.resource = null as never;
    this.container?.destroy();
    this.container = undefined;
  }

  private replaced(shape: Shape, count: number): GSplatContainer {
    const device = this.app.graphicsDevice;
    const format = new GSplatFormat(device, [], { readGLSL: readGlsl(shape), readWGSL: "" });
    this.component.resource = null as never;
    this.container?.destroy();
    const room = this.container ? Math.ceil(count * ROOM) : count;
    this.container = new GSplatContainer(device, room, format);
    return this.container;
  }

  /** Before each picture: the MLPs' eye, and the engine's low-pass for this size of the picture. */
  private look(): void {
    const { camera } = this.camera;
    if (!this.container || !camera) return;
    const toScene = new Mat4().copy(this.entity.getWorldTransform()).invert();
    const eye = toScene.transformPoint(this.camera.getPosition());
    const height = (camera.renderTarget?.height ?? this.app.graphicsDevice.height) * camera.rect.w;
    const focal = (camera.projectionMatrix.data[5]! * height) / 2;
    const ownBlur = ENGINE_BLUR / focal ** 2;
    if (ownBlur === this.ownBlur && eye.distance(this.eye) < STILL) return;
    this.ownBlur = ownBlur;
    this.eye.copy(eye);
    this.component.setParameter("ownBlur", ownBlur);
    this.component.setParameter("eye", [eye.x, eye.y, eye.z]);
  }
}

/** A whole stream that plays by the clock of its app, whose `timeScale` counts. */
export class StreamClip extends StreamSplats {
  readonly playback: Playback;
  private now = 0;

  /** @throws StreamError the stream has no frame that can be shown, or the app draws with WebGPU */
  constructor(app: AppBase, camera: Entity, reader: StreamReader, options?: PlaybackOptions) {
    if (!reader.header) throw new StreamError(`${reader.name} has no frame that can be shown.`);
    super(app, camera, reader.header);
    this.playback = new Playback(reader, ({ fields }) => this.show(fields), options);
    this.onUpdate((elapsedSeconds) => {
      this.now += elapsedSeconds;
      this.playback.update(this.now);
    });
  }

  /** Loads a stream file; see `fetchStream` of `@structgstream/gl/shading` for errors. */
  static async load(
    app: AppBase,
    camera: Entity,
    url: string | URL,
    options: PlaybackOptions & { signal?: AbortSignal } = {},
  ): Promise<StreamClip> {
    return new StreamClip(app, camera, await fetchStream(url, options.signal), options);
  }

  protected override release(): void {
    this.playback.pause();
    super.release();
  }
}

/** Means of all Gaussians, which the engine sorts, and the box around them. */
function writeCenters(container: GSplatContainer, fields: Fields): void {
  const { anchors, offsetsPerAnchor, free } = sizesOf(fields);
  const [positions, offsets, scales, rows] = (
    ["anchor_positions", "anchor_offsets", "offset_scales", "free"] as const
  ).map((name) => fields.get(name)!.data as Float32Array) as [Float32Array, Float32Array, Float32Array, Float32Array];
  const centers = container.centers as Float32Array;
  let at = 0;
  for (let m = 0; m < anchors; m++) {
    const [sx, sy, sz] = [Math.exp(scales[3 * m]!), Math.exp(scales[3 * m + 1]!), Math.exp(scales[3 * m + 2]!)];
    for (let k = 0; k < offsetsPerAnchor; k++) {
      centers[at] = positions[3 * m]! + offsets[at]! * sx;
      centers[at + 1] = positions[3 * m + 1]! + offsets[at + 1]! * sy;
      centers[at + 2] = positions[3 * m + 2]! + offsets[at + 2]! * sz;
      at += 3;
    }
  }
  const columns = rows.length / Math.max(free, 1);
  for (let i = 0; i < free; i++, at += 3) centers.set(rows.subarray(i * columns, i * columns + 3), at);
  const [low, high] = [new Vec3(Infinity, Infinity, Infinity), new Vec3(-Infinity, -Infinity, -Infinity)];
  const point = new Vec3();
  for (let i = 0; i < at; i += 3) {
    point.set(centers[i]!, centers[i + 1]!, centers[i + 2]!);
    low.min(point);
    high.max(point);
  }
  const box = new BoundingBox();
  box.setMinMax(low, high);
  container.aabb = box;
}
