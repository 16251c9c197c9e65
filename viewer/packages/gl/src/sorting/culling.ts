// SPDX-License-Identifier: Apache-2.0
/** The anchors that may be visible to a camera. */

import type { Camera } from "../types.js";
import type { Placement } from "./placement.js";

/**
 * Share of the picture's size by which the frustum is widened on each side. An order may be used for the next cameras until
 * theirs has come, so it must contain what is visible at their edges.
 */
const MARGIN = 0.2;
/** Smallest margin, pixels, for small pictures: the low-pass reaches 1.3 drawn pixels, which may be three times as large. */
const MIN_MARGIN_PIXELS = 4;
const SIZE_BINS = 1024;
/** Bins per octave of apparent size. */
const OCTAVE_BINS = 32;

/** Writes the ascending indices of the anchors whose ball may reach the picture or its margin to `into`; returns their number. */
export function seenAnchors(placement: Placement, camera: Camera, into: Uint32Array): number {
  const { positions, radii } = placement;
  const planes = sidePlanes(camera);
  const v = camera.viewmat;
  let count = 0;
  for (let m = 0, at = 0; m < placement.anchors; m++, at += 3) {
    const [px, py, pz] = [positions[at]!, positions[at + 1]!, positions[at + 2]!];
    const radius = radii[m]!;
    if (!(v[8]! * px + v[9]! * py + v[10]! * pz + v[11]! + radius > camera.near)) continue;
    let seen = true;
    for (let i = 0; i < 16; i += 4) {
      const distance = planes[i]! * px + planes[i + 1]! * py + planes[i + 2]! * pz + planes[i + 3]!;
      if (distance < -radius) seen = false;
    }
    if (seen) into[count++] = m;
  }
  return count;
}

/** Four planes in the scene, each an inward unit normal and an offset: left, right, top, bottom. */
function sidePlanes(camera: Camera): Float64Array {
  const { K, width, height, viewmat: v } = camera;
  const [across, down] = [width, height].map((size) => Math.max(MARGIN * size, MIN_MARGIN_PIXELS)) as [number, number];
  const slopes = [
    [0, 1, (K.cx + across) / K.fx],
    [0, -1, (width + across - K.cx) / K.fx],
    [4, 1, (K.cy + down) / K.fy],
    [4, -1, (height + down - K.cy) / K.fy],
  ] as const;
  const planes = new Float64Array(16);
  slopes.forEach(([row, sign, slope], i) => {
    const size = Math.hypot(1, slope);
    for (let j = 0; j < 4; j++) planes[4 * i + j] = (sign * v[row + j]! + slope * v[8 + j]!) / size;
  });
  return planes;
}

/**
 * Reduces the first `count` anchors in `seen` to about the `keep` with the largest apparent size, in their order; returns
 * their number, at most `keep`.
 */
export function largestAnchors(
  placement: Placement,
  camera: Camera,
  seen: Uint32Array,
  count: number,
  keep: number,
): number {
  if (count <= keep) return count;
  const { positions, extents } = placement;
  const v = camera.viewmat;
  const histogram = new Uint32Array(SIZE_BINS);
  const bins = new Uint16Array(count);
  for (let i = 0; i < count; i++) {
    const at = 3 * seen[i]!;
    const z = v[8]! * positions[at]! + v[9]! * positions[at + 1]! + v[10]! * positions[at + 2]! + v[11]!;
    const octaves = Math.log2(extents[seen[i]!]! / Math.max(z, camera.near));
    const bin = Math.min(Math.max(Math.floor(SIZE_BINS / 2 + OCTAVE_BINS * octaves) || 0, 0), SIZE_BINS - 1);
    bins[i] = bin;
    histogram[bin]!++;
  }
  let least = SIZE_BINS - 1;
  let larger = 0;
  while (larger + histogram[least]! <= keep && least > 0) larger += histogram[least--]!;
  // The last bin does not fit completely; every n-th of its anchors is selected, so that the loss is evenly distributed.
  const share = (keep - larger) / Math.max(histogram[least]!, 1);
  let [kept, owed] = [0, 0];
  for (let i = 0; i < count; i++) {
    if (bins[i]! < least) continue;
    if (bins[i] === least) {
      owed += share;
      if (owed < 1) continue;
      owed -= 1;
    }
    seen[kept++] = seen[i]!;
  }
  return kept;
}
