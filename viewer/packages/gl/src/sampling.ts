// SPDX-License-Identifier: Apache-2.0
/** Sampling intervals: size of a training camera's pixel at a point of the scene (docs/bitstream.md). */

import type { StreamHeader } from "@structgstream/core";
import { center, rigCamera } from "./cameraMath.js";
import { along, length, mean, type Vector } from "./vectors.js";

/** Low-pass of the trainer's rasterizer: square training pixels. */
export const TRAINING_LOW_PASS = 0.3;

/** `interval(p) <= slope * (|p - middle| + spread)` for every point `p`. */
export interface IntervalBound {
  readonly middle: Vector;
  readonly spread: number;
  readonly slope: number;
}

export interface TrainingCameras {
  /**
   * Rows of diag(1 / width, 1 / height, 1) K [R | t] / sqrt(fx fy) of each camera, in scene units. They map a point to
   * (u, v, 1) z / f, with (u, v) in [0, 1] inside the picture and z / f the side of a pixel at that depth.
   */
  readonly rows: Float32Array;
  readonly count: number;
  readonly bound: IntervalBound;
}

export function trainingCamerasOf(header: StreamHeader): TrainingCameras {
  const cameras = header.cameras.filter(({ heldOut }) => !heldOut).map(({ name }) => rigCamera(header, name));
  const focals = cameras.map(({ K }) => Math.sqrt(K.fx * K.fy));
  const rows = cameras.flatMap((camera, i) => {
    const { K, width, height } = camera;
    const { fx, fy, cx, cy } = K;
    const [right, down, forward] = [0, 4, 8].map((at) => camera.viewmat.subarray(at, at + 4));
    const row = (values: (j: number) => number) => [0, 1, 2, 3].map((j) => values(j) / focals[i]!);
    return [
      ...row((j) => (fx * right![j]! + cx * forward![j]!) / width),
      ...row((j) => (fy * down![j]! + cy * forward![j]!) / height),
      ...row((j) => forward![j]!),
    ];
  });
  const centers = cameras.map(center);
  const middle = mean(centers);
  return {
    rows: Float32Array.from(rows),
    count: cameras.length,
    // Bound of a weighted mean: the depth is at most the distance, and the focal length at least the shortest.
    bound: {
      middle,
      spread: Math.max(0, ...centers.map((eye) => length(along(eye, middle, -1)))),
      slope: 1 / Math.min(...focals),
    },
  };
}
