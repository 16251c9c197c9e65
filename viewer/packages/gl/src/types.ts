// SPDX-License-Identifier: Apache-2.0
/** Inputs and outputs of the renderer: its interface to the player. */

import type { FieldName, Tensor } from "@structgstream/core";

/**
 * The message of a decode worker for each frame. The arrays are transferred, never shared: the renderer stores them to
 * restore a lost context, so nobody else may write to them.
 */
export interface SceneUpdate {
  /** Frame number in the stream. */
  readonly index: number;
  readonly ptsSeconds: number;
  /** Complete tensors of the fields that changed since the last update; the header contains the static ones. */
  readonly fields: ReadonlyMap<FieldName, Tensor>;
}

export interface Intrinsics {
  readonly fx: number;
  readonly fy: number;
  /** The centre of the top-left pixel is at (0.5, 0.5). */
  readonly cx: number;
  readonly cy: number;
}

/** A pinhole camera in SCENE units (`scene = (capture - center) * scale`); `rigCamera` converts a camera of a header. */
export interface Camera {
  /** 16 numbers, row by row: world to camera, OpenCV axes (x right, y down, z forward), rigid. */
  readonly viewmat: Float64Array;
  /** In pixels of `width` by `height`. */
  readonly K: Intrinsics;
  /** Pixels of the picture, which becomes the canvas' own size. */
  readonly width: number;
  readonly height: number;
  /** Nothing closer along z is drawn; scene units. */
  readonly near: number;
}

/** Transport of the MLPs' outputs to the drawing pass: fp32 by transform feedback, or half floats by render targets. */
export type MlpPath = "transform-feedback" | "mrt";

export interface RendererOptions {
  /** The sorting worker (`sorter.worker.ts`), or the URL of its module; the renderer terminates it. By default its own file. */
  readonly sorter?: Worker | URL;
  /** Default: the first path that the device supports, transform feedback before render targets. */
  readonly mlpPath?: MlpPath;
}

export interface RenderOptions {
  /** A training camera whose exposure and white balance the picture gets. Default: the mean of all. */
  readonly cameraName?: string;
}

/** The picture of one eye, as a part of a framebuffer. */
export interface EyeView {
  /** Its width and height are those of the part. */
  readonly camera: Camera;
  /** The part's lower left corner, pixels. */
  readonly x: number;
  readonly y: number;
}

/** Pictures of one moment, drawn from one order. */
export interface Views {
  readonly eyes: readonly EyeView[];
  /** A camera that sees what the eyes see: splats are sorted, and MLPs evaluated, for it. */
  readonly middle: Camera;
  /** Null for the canvas. */
  readonly framebuffer: WebGLFramebuffer | null;
  /** Without environment and background: colours times coverage, and coverage as alpha. */
  readonly transparent: boolean;
}

/** Result of one call of `render`. */
export interface RenderStats {
  /** The frame of the picture; undefined until the first order has come. It may be older than the last update. */
  readonly frameIndex: number | undefined;
  readonly ptsSeconds: number | undefined;
  /** False if nothing has changed or the GPU is busy with the last picture; the canvas was not changed then. */
  readonly drawn: boolean;
  /** Whether the canvas shows the last update, sorted for exactly this camera; otherwise `onOrder` will be called. */
  readonly settled: boolean;
  /** Anchors whose MLPs were evaluated. */
  readonly anchors: number;
  /** Splats in the order, before those too faint to show are dropped on the GPU. */
  readonly splats: number;
  /** Time of the sorting worker for the present order. */
  readonly sortMilliseconds: number;
  /** Time of this call on the calling thread; the GPU continues after it. */
  readonly callMilliseconds: number;
}

/** Memory of the renderer on the GPU and on the host; all zero after `destroy`. */
export interface ResourceCounts {
  readonly textures: number;
  readonly buffers: number;
  readonly programs: number;
  readonly framebuffers: number;
  readonly workers: number;
}
