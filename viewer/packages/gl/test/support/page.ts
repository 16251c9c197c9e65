// SPDX-License-Identifier: Apache-2.0
/** What runs in the browser: a stream, a renderer, and what tests ask of both. */

import { readStream, type StreamReader } from "@structgstream/core";
import {
  type Camera,
  type RendererOptions,
  type RenderOptions,
  type RenderStats,
  rigCamera,
  SplatRenderer,
} from "../../src/main.js";

/** A camera as JSON has it. */
export type PlainCamera = Omit<Camera, "viewmat"> & { readonly viewmat: readonly number[] };
type PlainOptions = Omit<RendererOptions, "sorter">;

export function cameraOf(plain: PlainCamera): Camera {
  return { ...plain, viewmat: Float64Array.from(plain.viewmat) };
}

/** A renderer on a canvas of its own, with one stream. */
export class Play {
  readonly canvas = document.createElement("canvas");
  readonly renderer: SplatRenderer;
  readonly events: string[] = [];
  private given = new Map<string, unknown>();

  constructor(
    readonly reader: StreamReader,
    options: PlainOptions,
  ) {
    document.body.append(this.canvas);
    this.renderer = new SplatRenderer(this.canvas, { ...options, sorter: new URL("/sorter.js", location.href) });
    this.renderer.onContextLost = () => this.events.push("lost");
    this.renderer.onContextRestored = () => this.events.push("restored");
    this.renderer.onError = (error) => this.events.push(`error: ${error.message}`);
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

  rig(name: string): Camera {
    return rigCamera(this.reader.header!, name);
  }

  async picture(plain: PlainCamera, options?: RenderOptions): Promise<{ stats: RenderStats; rgba: string }> {
    const stats = await this.renderer.renderSettled(cameraOf(plain), options);
    return { stats, rgba: await this.pixels() };
  }

  /** The picture shown last, RGBA, as base64. */
  async pixels(): Promise<string> {
    return base64(await pixelsOf(await this.renderer.screenshot()));
  }

  /** What the MLPs say, and of which anchors, as base64 of numbers. */
  outputs(): { anchors: string; outputs: string } {
    const { anchors, outputs } = this.renderer.mlpOutputs();
    return { anchors: base64(anchors), outputs: base64(outputs) };
  }

  close(): void {
    this.renderer.destroy();
    this.canvas.remove();
  }
}

export async function open(url: string, options: PlainOptions = {}): Promise<Play> {
  const answer = await fetch(url);
  return new Play(readStream(new Uint8Array(await answer.arrayBuffer())), options);
}

/** RGBA of a PNG. */
export async function pixelsOf(png: Blob): Promise<Uint8ClampedArray> {
  const bitmap = await createImageBitmap(png, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
  const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
  const context = canvas.getContext("2d")!;
  context.drawImage(bitmap, 0, 0);
  return context.getImageData(0, 0, bitmap.width, bitmap.height).data;
}

export async function pngPixels(url: string): Promise<string> {
  return base64(await pixelsOf(await (await fetch(url)).blob()));
}

function base64(array: ArrayBufferView): string {
  const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
  let text = "";
  for (let i = 0; i < bytes.length; i += 0x8000) text += String.fromCharCode(...bytes.subarray(i, i + 0x8000));
  return btoa(text);
}

const api = { open, pngPixels, plays: [] as Play[] };
declare global {
  var stage: typeof api;
}
globalThis.stage = api;
