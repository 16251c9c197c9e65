// SPDX-License-Identifier: Apache-2.0
/** What `make_references.py` wrote of a stream, and how a browser's pictures compare. */

import { readFileSync } from "node:fs";
import { join } from "node:path";
import type { MlpPath, RenderStats } from "../../src/index.js";
import type { Stage } from "./browser.js";
import { bytesOf, type Difference, difference } from "./compare.js";
import type { Lesser, PlainCamera } from "./page.js";

export interface View {
  readonly name: string;
  readonly frame: number;
  readonly camera: PlainCamera;
  readonly outputs: number;
  readonly offset: number;
}

/** Numbers of a Gaussian in the references, and in what the renderer's passes give (one more, unused). */
const COLUMNS = 11;
const STRIDE = 12;

export function viewsOf(folder: string): View[] {
  return (JSON.parse(readFileSync(join(folder, "views.json"), "utf8")) as { views: View[] }).views;
}

export interface Compared extends Difference {
  readonly name: string;
  /** Largest difference of what the MLPs say. */
  readonly mlp: number;
  /** Gaussians whose outputs were compared. */
  readonly gaussians: number;
  readonly stats: RenderStats;
  readonly rgba: Uint8Array;
  readonly truth: Uint8Array;
}

/**
 * Every view of a stream in the browser against its reference.
 *
 * @param stream what the page fetches it as; references are under `STREAM/`
 */
export async function* compared(
  stage: Stage,
  stream: string,
  folder: string,
  mlpPath: MlpPath,
  offsetsPerAnchor: number,
  device: Lesser = {},
): AsyncGenerator<Compared> {
  const { page } = stage;
  const outputs = readFileSync(join(folder, "outputs.bin"));
  await page.evaluate(
    async ([url, path, lesser]) => {
      await globalThis.stage.open(url, { mlpPath: path, device: lesser });
    },
    [stream, mlpPath, device] as const,
  );
  for (const view of viewsOf(folder)) {
    const { camera } = view;
    const found = await page.evaluate(
      async ([index, plain, png]) => {
        const [play] = globalThis.stage.plays;
        play!.frame(index);
        const { stats, rgba } = await play!.picture(plain);
        return { stats, rgba, truth: await globalThis.stage.pngPixels(png), ...play!.outputs() };
      },
      [view.frame, camera, `${stream}/${view.name}.png`] as const,
    );
    const [rgba, truth] = [bytesOf(found.rgba), bytesOf(found.truth)];
    yield {
      name: view.name,
      ...difference(rgba, truth, camera.width, camera.height),
      ...mlpDifference(outputs, view, found, offsetsPerAnchor),
      stats: found.stats,
      rgba,
      truth,
    };
  }
  await page.evaluate(() => {
    for (const play of globalThis.stage.plays.splice(0)) play.close();
  });
}

/** Scales' shares, opacities and colours as they are; of quaternions the sign does not count. */
function mlpDifference(
  file: Buffer,
  view: View,
  found: { anchors: string; outputs: string },
  offsetsPerAnchor: number,
): { mlp: number; gaussians: number } {
  const ids = new Uint32Array(slice(file, view.offset, 4 * view.outputs));
  const truth = new Float32Array(slice(file, view.offset + 4 * view.outputs, 4 * COLUMNS * view.outputs));
  const anchors = new Uint32Array(bytesOf(found.anchors).buffer as ArrayBuffer);
  const values = new Float32Array(bytesOf(found.outputs).buffer as ArrayBuffer);
  const places = new Map([...anchors].map((anchor, place) => [anchor, place]));
  let [mlp, gaussians] = [0, 0];
  for (const [row, id] of ids.entries()) {
    const place = places.get(Math.floor(id / offsetsPerAnchor));
    if (place === undefined) throw new Error(`anchor of Gaussian ${id} was culled, and Python draws it`);
    const at = (place * offsetsPerAnchor + (id % offsetsPerAnchor)) * STRIDE;
    for (let i = 0; i < COLUMNS; i++) {
      const off = Math.abs(values[at + i]! - truth[row * COLUMNS + i]!);
      mlp = Math.max(mlp, Number.isNaN(off) ? Number.POSITIVE_INFINITY : off);
    }
    gaussians++;
  }
  return { mlp, gaussians };
}

function slice(file: Buffer, offset: number, bytes: number): ArrayBuffer {
  return file.buffer.slice(file.byteOffset + offset, file.byteOffset + offset + bytes) as ArrayBuffer;
}
