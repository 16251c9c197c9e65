// SPDX-License-Identifier: Apache-2.0
/** The page in which an engine draws exported frames. */

import { readStream } from "@structgstream/core";
import { type EngineCamera, engineCamera, OwnPictures } from "./ownPictures.js";
import { base64, pixelsOf } from "./pixels.js";

/** Between two pictures of an engine, which sorts in the meantime. */
const PAUSE_MILLISECONDS = 1500;

/** Draws a file in an engine. @param yDown whether the file has the axes of the capture instead of y up */
type Draw = (url: string, yDown: boolean, view: EngineCamera, settings: object) => Promise<Uint8ClampedArray>;

export interface ExportedStage {
  /** RGBA as base64 of a file by the engine, and of a frame of the stream by our own renderer. */
  pictures(file: string, frame: number, camera: string, settings: object): Promise<Compared>;
}

export interface Compared {
  readonly engine: string;
  readonly own: string;
  readonly width: number;
  readonly height: number;
}

/** The page's server has the stream as `/stream`. */
export function exportedStage(draw: Draw): ExportedStage {
  return {
    async pictures(file, frame, camera, settings) {
      const reader = readStream(new Uint8Array(await (await fetch("/stream")).arrayBuffer()));
      const view = engineCamera(reader, camera, 1);
      const renderer = new OwnPictures(reader);
      const own = base64(await renderer.picture(frame, view.own));
      renderer.destroy();
      const engine = base64(await draw(file, /\.(ply|splat|sog)$/.test(file), view, settings));
      return { engine, own, width: view.own.width, height: view.own.height };
    },
  };
}

/** RGBA of the first picture that is like the one before, and not black: sorting has ended. */
export async function sortedPicture(draw: () => Promise<Blob>): Promise<Uint8ClampedArray> {
  for (let last: Uint8ClampedArray | undefined; ; ) {
    const next = await pixelsOf(await draw());
    const black = next.every((value, i) => i % 4 === 3 || value === 0);
    if (!black && next.length === last?.length && next.every((value, i) => value === last![i])) return next;
    last = next;
    await new Promise((resolve) => setTimeout(resolve, PAUSE_MILLISECONDS));
  }
}
