// SPDX-License-Identifier: Apache-2.0
/** A canvas on which a stream's scenes are drawn. */

import type { StreamHeader, Tensor } from "@structgstream/core";
import { cameraNamed, sameCamera } from "./cameraMath.js";
import { GlError } from "./errors.js";
import { type Device, deviceOf, openDevice } from "./gpu/device.js";
import { Pace } from "./gpu/pace.js";
import type { Look } from "./gpu/picturePass.js";
import { Pipeline } from "./gpu/pipeline.js";
import { LiveScene } from "./scene.js";
import { Orders, type Sorted, sameWanted, type Wanted } from "./sorting/orders.js";
import type {
  Camera,
  RendererOptions,
  RenderOptions,
  RenderStats,
  ResourceCounts,
  SceneUpdate,
  Views,
} from "./types.js";

const MEAN_LOOK: Look = { gain: [1, 1, 1], bias: [0, 0, 0] };

/** The content of the canvas. */
interface Shown {
  readonly sorted: Sorted | undefined;
  readonly camera: Camera;
  readonly pixelScale: number;
  readonly look: Look;
}

/** A browser that restores a context does so sooner. */
const LOST_MILLISECONDS = 3000;
const LOST =
  "The browser has taken the graphics memory of this picture, as it does from the oldest of more than about 16 in a " +
  "page; it is drawn again when the browser gives it back. Remove other players, or reload the page.";

/** After a lost context, `render` works again once the canvas has had its event `webglcontextrestored`. */
export class SplatRenderer {
  /** The next `render` can draw something new: an order has come, or the GPU is free again. */
  onOrder: (() => void) | undefined;
  /** An error after a call has returned, in the sorting worker or while a context was restored. */
  onError: ((error: Error) => void) | undefined;
  /** Largest number of drawn splats, from the next `render` on; those of anchors with the smallest apparent size are left out. */
  maxSplats = Number.POSITIVE_INFINITY;
  /** Size of the drawn picture relative to the canvas, from the next `render` on; 0.5 draws a quarter of the pixels. */
  pixelScale = 1;
  private device: Device;
  private pipeline: Pipeline | undefined;
  private readonly worker: Worker;
  private readonly orders: Orders;
  private readonly pace: Pace;
  private scene: LiveScene | undefined;
  /** The order in which splats are drawn, and its scene. */
  private sorted: Sorted | undefined;
  private shown: Shown | undefined;
  private settling: { resolve: () => void; reject: (error: Error) => void }[] = [];
  private destroyed = false;
  private lostFor: ReturnType<typeof setTimeout> | undefined;

  /** @throws GlError there is no WebGL2, or the device does not support the requested path */
  constructor(
    private readonly canvas: HTMLCanvasElement | OffscreenCanvas,
    private readonly options: RendererOptions = {},
  ) {
    this.device = openDevice(canvas);
    this.pipeline = this.newPipeline();
    this.worker = workerOf(options.sorter);
    this.orders = this.newOrders();
    this.pace = new Pace(this.device.gl, this.ready);
    canvas.addEventListener("webglcontextlost", this.lost);
    canvas.addEventListener("webglcontextrestored", this.restored);
  }

  get resources(): ResourceCounts {
    const none = { textures: 0, buffers: 0, programs: 0, framebuffers: 0 };
    return { ...(this.pipeline?.counts ?? none), workers: this.destroyed ? 0 : 1 };
  }

  /**
   * Sets the static fields and removes an earlier stream; dynamic fields follow by `update`. If a stream `goesOn` with
   * another header, its picture is shown until there is one of the new scene.
   *
   * @throws GlError the renderer was destroyed
   */
  load(header: StreamHeader, goesOn = false): void {
    this.alive();
    this.scene = new LiveScene(header);
    this.orders.forget();
    if (goesOn) return;
    this.sorted = undefined;
    this.shown = undefined;
    this.pipeline?.forget();
  }

  /**
   * Sets the dynamic fields. The latest scene is shown as soon as its order has come.
   *
   * @throws GlError there was no header, or the first update lacks fields
   */
  update(update: SceneUpdate): void {
    this.alive();
    if (!this.scene) throw new GlError("An update came before a header; call load(header) first.");
    this.scene.apply(update);
  }

  render(camera: Camera, options: RenderOptions = {}): RenderStats {
    this.alive();
    const began = performance.now();
    const wanted = this.want(camera);
    const look = this.lookNamed(options.cameraName);
    const drawn = this.pipeline ? this.drawn(this.pipeline, camera, look) : false;
    const settled = this.pipeline !== undefined && this.hasOrder(wanted) && this.shows(this.sorted, camera, look);
    return this.statsOf(drawn, settled, began);
  }

  /** Draws the pictures of a headset, without waiting for the GPU; the canvas' own picture is not drawn. */
  renderViews({ eyes, middle, framebuffer, transparent }: Views): RenderStats {
    this.alive();
    const began = performance.now();
    const wanted = this.want(middle);
    const { pipeline } = this;
    if (pipeline) {
      this.takeOrder(pipeline);
      this.shown = undefined;
      pipeline.evaluate(middle);
      for (const { camera, x, y } of eyes) {
        pipeline.draw(camera, this.pixelScale);
        pipeline.show(camera, MEAN_LOOK, { framebuffer, x, y, transparent });
      }
    }
    return this.statsOf(pipeline !== undefined, this.hasOrder(wanted), began);
  }

  /** Draws until the picture is exact: of the last update, sorted for its camera. */
  async renderSettled(camera: Camera, options: RenderOptions = {}): Promise<RenderStats> {
    if (!this.scene?.latest) throw new GlError("There is no scene to draw yet; call update(frame) first.");
    for (;;) {
      const stats = this.render(camera, options);
      if (stats.settled) return stats;
      await new Promise<void>((resolve, reject) => this.settling.push({ resolve, reject }));
    }
  }

  /** The last rendered picture as PNG. */
  async screenshot(): Promise<Blob> {
    this.alive();
    if (!this.shown || !this.pipeline) throw new GlError("There is no picture to save yet; call render first.");
    // The canvas is cleared after the browser has shown it, so the picture is rendered again and saved immediately.
    this.pipeline.show(this.shown.camera, this.shown.look);
    const { canvas } = this;
    if ("convertToBlob" in canvas) return canvas.convertToBlob({ type: "image/png" });
    const blob = await new Promise<Blob | null>((resolve) => canvas.toBlob(resolve, "image/png"));
    if (!blob) throw new GlError("The browser could not encode the picture; make it smaller.");
    return blob;
  }

  destroy(): void {
    if (this.destroyed) return;
    this.destroyed = true;
    this.canvas.removeEventListener("webglcontextlost", this.lost);
    this.canvas.removeEventListener("webglcontextrestored", this.restored);
    clearTimeout(this.lostFor);
    this.orders.close();
    this.pace.stop();
    this.pipeline?.delete();
    this.pipeline = undefined;
    this.scene = undefined;
    this.sorted = undefined;
    this.shown = undefined;
    this.settle();
  }

  private alive(): void {
    if (this.destroyed) throw new GlError("This renderer was destroyed; make another one.");
  }

  private newPipeline(): Pipeline {
    return new Pipeline(this.device, this.options.mlpPath);
  }

  private newOrders(): Orders {
    const failed = (error: Error) => {
      for (const waiting of this.settling.splice(0)) waiting.reject(error);
      this.onError?.(error);
    };
    return new Orders(this.worker, this.ready, failed);
  }

  private settle(): void {
    for (const waiting of this.settling.splice(0)) waiting.resolve();
  }

  private readonly ready = (): void => {
    this.onOrder?.();
    this.settle();
  };

  private statsOf(drawn: boolean, settled: boolean, began: number): RenderStats {
    const { sorted } = this;
    return {
      frameIndex: sorted?.snapshot.index,
      ptsSeconds: sorted?.snapshot.ptsSeconds,
      drawn,
      settled,
      anchors: sorted?.order.anchorCount ?? 0,
      splats: sorted?.order.splats ?? 0,
      sortMilliseconds: sorted?.order.milliseconds ?? 0,
      callMilliseconds: performance.now() - began,
    };
  }

  /** Requests the order of the present scene for a camera. */
  private want(camera: Camera): Wanted | undefined {
    const snapshot = this.scene?.latest;
    const wanted = snapshot && { snapshot, camera, maxSplats: this.maxSplats };
    if (wanted) this.orders.want(wanted);
    return wanted;
  }

  /** Whether the order in which splats are drawn is the wanted one. */
  private hasOrder(wanted: Wanted | undefined): boolean {
    return wanted !== undefined && this.sorted !== undefined && sameWanted(this.sorted, wanted);
  }

  /** Takes the newest order, if one has come. */
  private takeOrder(pipeline: Pipeline): void {
    const arrived = this.orders.take();
    if (!arrived || !this.scene) return;
    if (this.sorted) this.orders.release(this.sorted);
    this.sorted = undefined;
    pipeline.adopt(arrived, this.scene.header.distanceInput);
    this.sorted = arrived;
  }

  /** Whether anything had to be drawn, and could be. */
  private drawn(pipeline: Pipeline, camera: Camera, look: Look): boolean {
    if (this.shows(this.sorted, camera, look) && !this.orders.waiting) return false;
    if (this.pace.busy()) return false;
    this.takeOrder(pipeline);
    const { shown, sorted, pixelScale } = this;
    const same = shown && shown.sorted === sorted && sameCamera(shown.camera, camera);
    if (this.canvas.width !== camera.width) this.canvas.width = camera.width;
    if (this.canvas.height !== camera.height) this.canvas.height = camera.height;
    if (sorted && !same) pipeline.evaluate(camera);
    if (!same || shown.pixelScale !== pixelScale) pipeline.draw(camera, pixelScale);
    pipeline.show(camera, look);
    this.pace.mark();
    this.shown = { sorted, camera, pixelScale, look };
    return true;
  }

  private shows(sorted: Sorted | undefined, camera: Camera, look: Look): boolean {
    const { shown, pixelScale } = this;
    if (!shown || shown.sorted !== sorted || shown.pixelScale !== pixelScale) return false;
    return sameCamera(shown.camera, camera) && sameLook(shown.look, look);
  }

  /** Held-out cameras have no correction of their own and get the mean. */
  private lookNamed(name: string | undefined): Look {
    if (name === undefined || !this.scene) return MEAN_LOOK;
    const { header } = this.scene;
    const found = cameraNamed(header, name);
    const color = this.scene.latest?.fields.get("camera_color");
    if (found.heldOut || !color) return MEAN_LOOK;
    return lookOf(color, header.cameras.filter((camera) => !camera.heldOut).indexOf(found));
  }

  private readonly lost = (event: Event): void => {
    event.preventDefault(); // otherwise the context would not be restored
    this.pace.stop();
    this.pipeline = undefined;
    this.shown = undefined;
    this.lostFor = setTimeout(() => this.onError?.(new GlError(LOST)), LOST_MILLISECONDS);
  };

  private readonly restored = (): void => {
    clearTimeout(this.lostFor);
    try {
      this.device = deviceOf(this.device.gl);
      this.pipeline = this.newPipeline();
      if (this.sorted && this.scene) this.pipeline.adopt(this.sorted, this.scene.header.distanceInput);
    } catch (error) {
      this.pipeline = undefined;
      this.onError?.(error instanceof Error ? error : new Error(String(error)));
      return;
    }
    this.settle();
  };
}

function workerOf(sorter: Worker | URL | undefined): Worker {
  if (sorter && !(sorter instanceof URL)) return sorter;
  return new Worker(sorter ?? new URL("./sorter.worker.js", import.meta.url), { type: "module" });
}

function sameLook(a: Look, b: Look): boolean {
  return [0, 1, 2].every((i) => a.gain[i] === b.gain[i] && a.bias[i] === b.bias[i]);
}

function lookOf(color: Tensor, row: number): Look {
  const [r, g, b, dr, dg, db] = (color.data as Float32Array).subarray(6 * row, 6 * row + 6);
  return { gain: [r!, g!, b!], bias: [dr!, dg!, db!] };
}
