// SPDX-License-Identifier: Apache-2.0
/** How Gaussians are drawn, in doubles and straight from docs/bitstream.md: what the shaders are held to. */

import type { StreamHeader } from "@structgstream/core";
import type { PlainCamera } from "./page.js";

type Numbers = ArrayLike<number>;

/** Sampling interval of a point, in scene units. */
export function samplingInterval(header: StreamHeader, point: Numbers): number {
  const { center, scale } = header.similarity;
  const [x, y, z] = [0, 1, 2].map((i) => point[i]! / scale + center[i]!) as [number, number, number];
  let [weights, sum] = [0, 0];
  for (const { viewmat: v, K, width, height, heldOut } of header.cameras) {
    const [a, b, depth] = [0, 4, 8].map((i) => v[i]! * x + v[i + 1]! * y + v[i + 2]! * z + v[i + 3]!) as [
      number,
      number,
      number,
    ];
    if (heldOut || !(depth > 0)) continue;
    const inside = (pixel: number, size: number) =>
      Math.min(Math.max((0.65 - Math.abs(pixel / size - 0.5)) / 0.1, 0), 1);
    const weight = inside((K[0]! * a) / depth + K[2]!, width) * inside((K[4]! * b) / depth + K[5]!, height) + 1e-4;
    weights += weight;
    sum += (weight * depth * scale) / Math.sqrt(K[0]! * K[4]!);
  }
  return weights > 0 ? sum / weights : 0;
}

export interface Drawn {
  readonly x: number;
  readonly y: number;
  readonly depth: number;
  readonly xx: number;
  readonly xy: number;
  readonly yy: number;
  readonly opacity: number;
}

/** Ellipse and opacity of a free Gaussian whose fields are `row`. */
export function drawnFree(row: Numbers, interval: number, camera: PlainCamera): Drawn {
  const { viewmat: v, K, width, height } = camera;
  const axis = (i: number) => v[i]! * row[0]! + v[i + 1]! * row[1]! + v[i + 2]! * row[2]! + v[i + 3]!;
  const [a, b, depth] = [axis(0), axis(4), axis(8)];
  const limited = (tangent: number, focal: number, middle: number, size: number) =>
    Math.min(Math.max(tangent, -(middle + 0.15 * size) / focal), (1.15 * size - middle) / focal);
  const [tx, ty] = [limited(a / depth, K.fx, K.cx, width), limited(b / depth, K.fy, K.cy, height)];
  const jacobian = [
    [K.fx / depth, 0, (-K.fx * tx) / depth],
    [0, K.fy / depth, (-K.fy * ty) / depth],
  ];
  const size = Math.hypot(row[6]!, row[7]!, row[8]!, row[9]!);
  const [w, x, y, z] = [6, 7, 8, 9].map((i) => row[i]! / size) as [number, number, number, number];
  const rotation = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
  const view = [0, 4, 8].map((i) => [v[i]!, v[i + 1]!, v[i + 2]!]);
  const scales = [3, 4, 5].map((i) => Math.exp(row[i]!));
  const product = (p: number[][], q: number[][]) =>
    p.map((line) => q[0]!.map((_, j) => line.reduce((sum, value, i) => sum + value * q[i]![j]!, 0)));
  const axes = product(product(jacobian, view), rotation).map((line) => line.map((value, i) => value * scales[i]!));
  const entry = (i: number, j: number) => axes[i]!.reduce((sum, value, at) => sum + value * axes[j]![at]!, 0);
  const kept = (0.3 * interval * interval * K.fx * K.fy) / (depth * depth);
  const more = Math.max(0.15 - kept, 0);
  const [xx, xy, yy] = [entry(0, 0) + kept, entry(0, 1), entry(1, 1) + kept];
  const after = (xx + more) * (yy + more) - xy * xy;
  const opacity = Math.sqrt(Math.max((xx * yy - xy * xy) / after, 0)) / (1 + Math.exp(-row[10]!));
  const [px, py] = [(K.fx * a) / depth + K.cx, (K.fy * b) / depth + K.cy];
  return { x: px, y: py, depth, xx: xx + more, xy, yy: yy + more, opacity };
}
