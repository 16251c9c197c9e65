// SPDX-License-Identifier: Apache-2.0
/** What runs in the browser: a stream, a renderer, and what tests ask of both. */

import { readStream, type StreamReader } from "@structgstream/core";
import {
  type Camera,
  type RendererOptions,
  type RenderOptions,
  type RenderStats,
  SplatRenderer,
} from "../../src/index.js";
import { HeldWorker } from "./heldWorker.js";
import { mlpOutputs } from "./mlpOutputs.js";
import { base64, pixelsOf } from "./pixels.js";
import { type ReadBack, readBack } from "./readBack.js";

/** A camera as JSON has it. */
export type PlainCamera = Omit<Camera, "viewmat"> & { readonly viewmat: readonly number[] };
type PlainOptions = Omit<RendererOptions, "sorter"> & {
  readonly device?: Lesser;
  readonly sorterPath?: string;
  readonly ownSorter?: boolean;
};

/** A device that can do less than this one. */
export interface Lesser {
  /** By the names of `getParameter`'s constants. */
  readonly limits?: Readonly<Record<string, number>>;
  readonly withoutExtensions?: readonly string[];
  readonly withoutWebGL2?: boolean;
}

function cameraOf(plain: PlainCamera): Camera {
  return { ...plain, viewmat: Float64Array.from(plain.viewmat) };
}

/** A renderer on a canvas of its own, with one stream. */
export class Play {
  readonly canvas = document.createElement("canvas");
  readonly renderer: SplatRenderer;
  readonly sorter: HeldWorker;
  readonly errors: string[] = [];
  private given = new Map<string, unknown>();

  constructor(
    readonly reader: StreamReader,
    options: PlainOptions,
  ) {
    document.body.append(this.canvas);
    if (options.device) lessen(this.canvas, options.device);
    this.sorter = new HeldWorker(new Worker(options.sorterPath ?? "/sorter.js", { type: "module" }));
    // Without one, the renderer starts the file next to its own.
    const sorter = options.ownSorter ? {} : { sorter: this.sorter as unknown as Worker };
    this.renderer = new SplatRenderer(this.canvas, { ...options, ...sorter });
    this.renderer.onError = (error) => this.errors.push(error.message);
    this.renderer.load(reader.header!);
  }

  /** Gives the renderer what has changed, as a decode worker would: in arrays of their own. */
  frame(index: number): void {
    const { ptsSeconds, fields } = this.reader.frame(index);
    const changed = new Map(
      [...fields]
        .filter(([name, tensor]) => this.reader.header!.dynamic.has(name) && this.given.get(name) !== tensor)
        .map(([name, tensor]) => {
          this.given.set(name, tensor);
          return [name, { shape: tensor.shape, data: tensor.data.slice() }] as const;
        }),
    );
    this.renderer.update({ index, ptsSeconds, fields: changed });
  }

  async picture(plain: PlainCamera, options?: RenderOptions): Promise<{ stats: RenderStats; rgba: string }> {
    const stats = await this.renderer.renderSettled(cameraOf(plain), options);
    return { stats, rgba: await this.pixels() };
  }

  /** A picture in the order there is, whatever it is the order for. */
  async unsorted(plain: PlainCamera): Promise<{ stats: RenderStats; rgba: string }> {
    for (;;) {
      const stats = this.renderer.render(cameraOf(plain));
      if (stats.drawn) return { stats, rgba: await this.pixels() };
      await new Promise((resolve) => setTimeout(resolve, 5)); // the GPU is still at the one before
    }
  }

  /** The picture shown last, RGBA, as base64. */
  async pixels(): Promise<string> {
    return base64(await pixelsOf(await this.renderer.screenshot()));
  }

  /** What the MLPs say, and of which anchors, as base64 of numbers. */
  outputs(): { anchors: string; outputs: string } {
    const { anchors, outputs } = mlpOutputs(this.renderer);
    return { anchors: base64(anchors), outputs: base64(outputs) };
  }

  /** What the passes before blending wrote, as base64 of numbers. */
  readBack(): Record<keyof ReadBack, string> {
    const { intervals, projected, blended } = readBack(this.renderer);
    return { intervals: base64(intervals), projected: base64(projected), blended: base64(blended) };
  }

  close(): void {
    this.renderer.destroy();
    this.canvas.remove();
  }
}

async function open(url: string, options: PlainOptions = {}): Promise<Play> {
  const answer = await fetch(url);
  const play = new Play(readStream(new Uint8Array(await answer.arrayBuffer())), options);
  api.plays.push(play);
  return play;
}

function lessen(canvas: HTMLCanvasElement, device: Lesser): void {
  const open = canvas.getContext.bind(canvas) as (kind: string, attributes?: unknown) => WebGL2RenderingContext | null;
  const lesser = (kind: string, attributes?: unknown) => {
    if (device.withoutWebGL2) return null;
    const gl = open(kind, attributes)!;
    const getParameter = gl.getParameter.bind(gl);
    const getExtension = gl.getExtension.bind(gl) as (name: string) => unknown;
    const limits = new Map(
      Object.entries(device.limits ?? {}).map(([name, limit]) => [gl[name as keyof WebGL2RenderingContext], limit]),
    );
    gl.getParameter = (name: number) => limits.get(name) ?? getParameter(name);
    gl.getExtension = ((name: string) =>
      device.withoutExtensions?.includes(name) ? null : getExtension(name)) as typeof gl.getExtension;
    return gl;
  };
  canvas.getContext = lesser as unknown as typeof canvas.getContext;
}

async function pngPixels(url: string): Promise<string> {
  return base64(await pixelsOf(await (await fetch(url)).blob()));
}

/** `plays` are all that were opened. */
const api = { open, cameraOf, pngPixels, plays: [] as Play[] };
declare global {
  var stage: typeof api;
}
globalThis.stage = api;
