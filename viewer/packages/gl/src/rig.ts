// SPDX-License-Identifier: Apache-2.0
/** Properties of a scene from its rig: the focus point and the up direction. */

import { axes, center } from "./cameraMath.js";
import { eigen, outerSum, type Symmetric } from "./symmetric.js";
import type { Camera } from "./types.js";
import { along, dot, length, mean, scaled, unit, type Vector } from "./vectors.js";

const MIN_PARALLAX = 1e-3;
/** Smallest share of the cameras' right axes in every direction of a plane for which the plane counts as level. */
const MIN_TURN = 0.02;

type View = Pick<Camera, "viewmat">;

/**
 * The point nearest to all optical axes, as in Python's camera paths. For nearly parallel axes it is in front of the
 * cameras' mean, at a distance of the rig's size.
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
  if (pairs[0]!.value > MIN_PARALLAX * cameras.length) {
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
 * The up direction, of length 1. Cameras are more often upright than level: their right axes are in the ground plane at
 * any pitch. If their directions are too similar to determine the plane, it is the mean of their up directions.
 */
export function upAxis(cameras: readonly View[]): Vector {
  const ups = mean(cameras.map((camera) => scaled(axes(camera)[1], -1)));
  const [least, middle] = eigen(outerSum(cameras.map((camera) => axes(camera)[0])));
  const level = middle!.value > MIN_TURN * cameras.length && least!.value < 0.5 * middle!.value;
  if (level) return dot(least!.vector, ups) < 0 ? scaled(least!.vector, -1) : least!.vector;
  if (length(ups) > 1e-6) return unit(ups);
  return scaled(axes(cameras[0]!)[1], -1);
}
