// SPDX-License-Identifier: Apache-2.0
/** Stages of a picture, each waited for: what the worker and the GPU do while the page's thread goes on. */

import { readStream } from "@structgstream/core";
import { deviceOf } from "../../src/gpu/device.js";
import { Pipeline } from "../../src/gpu/pipeline.js";
import { type Camera, type MlpPath, rigCamera } from "../../src/index.js";
import { trainingCamerasOf } from "../../src/sampling.js";
import { Placement } from "../../src/sorting/placement.js";
import { Sorter } from "../../src/sorting/sorter.js";

export interface Timing {
  readonly anchors: number;
  readonly splats: number;
  /** Medians in milliseconds. */
  readonly place: number;
  readonly sort: number;
  readonly upload: number;
  readonly mlp: number;
  readonly draw: number;
  readonly show: number;
}

/** Medians over `repeats` cameras around one of the rig. */
export async function timed(url: string, cameraName: string, path: MlpPath, repeats: number): Promise<Timing> {
  const bytes = new Uint8Array(await (await fetch(url)).arrayBuffer());
  const reader = readStream(bytes);
  const header = reader.header!;
  const training = trainingCamerasOf(header);
  const { fields, index, ptsSeconds } = reader.frame(0);
  const canvas = document.createElement("canvas");
  const camera = rigCamera(header, cameraName);
  [canvas.width, canvas.height] = [camera.width, camera.height];
  const gl = canvas.getContext("webgl2")!;
  const pipeline = new Pipeline(deviceOf(gl), path, [0, 0, 0]);
  const sorter = new Sorter();
  const placement = new Placement();
  const pixel = new Uint8Array(4);
  const finish = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  const found: Record<"place" | "sort" | "upload" | "mlp" | "draw" | "show", number[]> = {
    place: [],
    sort: [],
    upload: [],
    mlp: [],
    draw: [],
    show: [],
  };
  const floats = (name: "anchor_positions" | "offset_scales" | "base_scales" | "anchor_offsets" | "free") =>
    [name, fields.get(name)!.data as Float32Array<ArrayBuffer>] as const;
  const changed = new Map(
    (["anchor_positions", "offset_scales", "base_scales", "anchor_offsets", "free"] as const).map(floats),
  );
  const look = { gain: [1, 1, 1], bias: [0, 0, 0] } as const;
  let [anchors, splats] = [0, 0];
  for (let i = 0; i < repeats; i++) {
    const viewmat = camera.viewmat.map((value, at) => (at === 3 ? value + 0.002 * i : value));
    const moved: Camera = { ...camera, viewmat };
    const request = {
      id: i,
      offsetsPerAnchor: fields.get("anchor_offsets")!.shape[1]!,
      freeColumns: 14,
      interval: training.bound,
      camera: moved,
    };
    const rest = { maxSplats: Number.POSITIVE_INFINITY, buffers: [] };
    const beganPlacing = performance.now();
    placement.set({ ...request, arrays: changed });
    found.place.push(performance.now() - beganPlacing);
    const order = sorter.order({ ...request, ...rest, changed: i ? new Map() : changed });
    if (i === 0) continue; // compiles
    found.sort.push(order.milliseconds);
    // New arrays, as decoded frames are: what moves is written anew.
    const snapshotFields = new Map(fields);
    for (const name of header.dynamic) snapshotFields.set(name, { ...fields.get(name)! });
    const take = (stage: keyof typeof found, work: () => void) => {
      const began = performance.now();
      work();
      finish();
      found[stage].push(performance.now() - began);
    };
    const wanted = {
      snapshot: { index, ptsSeconds, fields: snapshotFields, training },
      camera: moved,
      maxSplats: 0,
      order,
    };
    take("upload", () => pipeline.adopt(wanted, header.distanceInput));
    take("mlp", () => pipeline.evaluate(moved));
    take("draw", () => pipeline.draw(moved, 1));
    take("show", () => pipeline.show(moved, look));
    [anchors, splats] = [order.anchorCount, order.splats];
  }
  pipeline.delete();
  const median = (values: number[]) => values.sort((a, b) => a - b)[values.length >> 1]!;
  const medians = Object.fromEntries(Object.entries(found).map(([name, values]) => [name, median(values)]));
  return { anchors, splats, ...(medians as Record<keyof typeof found, number>) };
}
