// SPDX-License-Identifier: Apache-2.0
/** What a rig says about its scene: what it looks at, and which way is up. */

import { axes, center } from "./cameraMath.js";
import { eigen, outerSum, type Symmetric } from "./symmetric.js";
import type { Camera } from "./types.js";
import { along, dot, length, mean, scaled, unit, type Vector } from "./vectors.js";

const LEAST_PARALLAX = 1e-3;
/** How much of the cameras' right axes must lie in every direction of a plane before that plane is level. */
const LEAST_TURN = 0.02;

type View = Pick<Camera, "viewmat">;

/**
 * The point nearest to all optical axes, as Python's camera paths have it. A rig whose cameras look the same way has none;
 * it then lies ahead of their mean, at the size of the rig.
 */
export function focusPoint(cameras: readonly View[]): Vector {
  const centers = cameras.map(center);
  const forwards = cameras.map((camera) => axes(camera)[2]);
  const outer = outerSum(forwards);
  const normal = outer.map((row, i) => row.map((value, j) => (i === j ? cameras.length : 0) - value));
  const sum = centers.reduce((total, eye, i) => along(along(total, eye), forwards[i]!, -dot(forwards[i]!, eye)), [
    0, 0, 0,
  ] as Vector);
  const pairs = eigen(normal as unknown as Symmetric);
  if (pairs[0]!.value > LEAST_PARALLAX * cameras.length) {
    const point = pairs.reduce((total, { value, vector }) => along(total, vector, dot(vector, sum) / value), [
      0, 0, 0,
    ] as Vector);
    const ahead = centers.filter((eye, i) => dot(along(point, eye, -1), forwards[i]!) > 0).length;
    if (ahead > 0.5 * cameras.length) return point;
  }
  const middle = mean(centers);
  const spread = Math.max(...centers.map((eye) => length(along(eye, middle, -1))));
  return along(middle, unit(mean(forwards)), 2 * spread);
}

/**
 * Up, of length 1. Cameras stand upright more often than level: their right axes lie in the ground's plane whatever their
 * pitch. Where they look too much the same way to tell, up is the mean of theirs.
 */
export function upAxis(cameras: readonly View[]): Vector {
  const ups = mean(cameras.map((camera) => scaled(axes(camera)[1], -1)));
  const [least, middle] = eigen(outerSum(cameras.map((camera) => axes(camera)[0])));
  const level = middle!.value > LEAST_TURN * cameras.length && least!.value < 0.5 * middle!.value;
  if (level) return dot(least!.vector, ups) < 0 ? scaled(least!.vector, -1) : least!.vector;
  if (length(ups) > 1e-6) return unit(ups);
  return scaled(axes(cameras[0]!)[1], -1);
}
