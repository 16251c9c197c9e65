// SPDX-License-Identifier: Apache-2.0
/** What goes into the renderer and what comes out: the contract with the player above. */

import type { FieldName, StreamHeader, Tensor } from "@structgstream/core";

/**
 * What a decode worker posts for each frame. The arrays were transferred, never shared: the renderer keeps them, because a lost
 * context has to be rebuilt, and nobody else may write to them.
 */
export interface SceneUpdate {
  /** Frame number in the stream. */
  readonly index: number;
  readonly ptsSeconds: number;
  /** Whole tensors of the fields that changed since the last update given; the header brought the static ones. */
  readonly fields: ReadonlyMap<FieldName, Tensor>;
}

export interface Intrinsics {
  readonly fx: number;
  readonly fy: number;
  /** The centre of the top-left pixel is at (0.5, 0.5). */
  readonly cx: number;
  readonly cy: number;
}

/** A pinhole camera in SCENE units (`scene = (capture - center) * scale`); `rigCamera` makes one of a header's camera. */
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

/** How the MLPs' outputs reach the drawing pass: in fp32 by transform feedback, or in half floats by render targets. */
export type MlpPath = "transform-feedback" | "mrt";

export interface RendererOptions {
  /** The sorting worker (`sorter.worker.ts`), or where its module is; the renderer ends it. By default its own file. */
  readonly sorter?: Worker | URL;
  /** No more splats are drawn; those left out are of the anchors that look smallest. Unlimited by default. */
  readonly maxSplats?: number;
  /** Size of what is drawn in pixels of the canvas, e.g. 0.5: a quarter of the pixels. 1 by default. */
  readonly pixelScale?: number;
  /** By default the path that this device's limits allow, transform feedback first. */
  readonly mlpPath?: MlpPath;
  /** sRGB in [0, 1] behind everything where the scene has no environment. Black by default, as in Python. */
  readonly background?: readonly [number, number, number];
}

export interface RenderOptions {
  /** A training camera of the rig whose exposure and white balance the picture gets; by default the mean of all. */
  readonly cameraName?: string;
}

/** What one call of `render` did. */
export interface RenderStats {
  /** The frame that the picture shows; undefined until the first order has come. It may lag behind the last update. */
  readonly frameIndex: number | undefined;
  readonly ptsSeconds: number | undefined;
  /** False when nothing had changed, or the GPU is still at the picture before: the canvas was left as it is. */
  readonly drawn: boolean;
  /** Whether the canvas shows the last update, seen and sorted from this very camera; otherwise `onOrder` will follow. */
  readonly settled: boolean;
  /** Anchors whose MLPs were evaluated. */
  readonly anchors: number;
  /** Splats in the order, before those too faint to show are dropped on the GPU. */
  readonly splats: number;
  /** What the sorting worker took for the order shown. */
  readonly sortMilliseconds: number;
  /** What this call took on the calling thread; the GPU goes on after it. */
  readonly callMilliseconds: number;
}

/** What the renderer holds on the GPU and beside it; all zero after `destroy`. */
export interface ResourceCounts {
  readonly textures: number;
  readonly buffers: number;
  readonly programs: number;
  readonly framebuffers: number;
  readonly workers: number;
}

/** What `SplatRenderer` is to a player. */
export interface Renderer {
  /** The next `render` can show something new: an order has come, or the GPU has time again. */
  onOrder: (() => void) | undefined;
  onContextLost: (() => void) | undefined;
  /** Everything is on the GPU again: `render` as before. */
  onContextRestored: (() => void) | undefined;
  /** Something went wrong after a call had returned, in the sorting worker or while a context was restored. */
  onError: ((error: Error) => void) | undefined;
  /** Settable at any time; applies from the next `render` on. */
  maxSplats: number;
  pixelScale: number;
  /**
   * The static fields; forgets a stream loaded before. Dynamic fields come by `update`. A stream that `goesOn` with another
   * header keeps its picture until there is one of the new scene. Throws GlError.
   */
  load(header: StreamHeader, goesOn?: boolean): void;
  /** The scene as it is now; shown as soon as the order for it has come, the latest winning. Throws GlError. */
  update(update: SceneUpdate): void;
  render(camera: Camera, options?: RenderOptions): RenderStats;
  /** Draws until the picture is settled, for pictures that must be exact. */
  renderSettled(camera: Camera, options?: RenderOptions): Promise<RenderStats>;
  /** The last picture rendered, as PNG. */
  screenshot(): Promise<Blob>;
  readonly resources: ResourceCounts;
  /** Sentences about what this device draws worse than others; empty on most. */
  readonly limitations: readonly string[];
  destroy(): void;
}
