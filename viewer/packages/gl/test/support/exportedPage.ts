// SPDX-License-Identifier: Apache-2.0
/** The page in which an engine draws exported frames. */

import { readStream } from "@structgstream/core";
import { type EngineCamera, engineCamera, OwnPictures } from "./ownPictures.js";
import { base64 } from "./pixels.js";

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
