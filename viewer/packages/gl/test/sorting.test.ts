// SPDX-License-Identifier: Apache-2.0

import { expect, test } from "vitest";
import { lookAt } from "../src/cameraMath.ts";
import { largestAnchors, seenAnchors } from "../src/sorting/culling.ts";
import { DepthSorter } from "../src/sorting/depthOrder.ts";
import { Placement, type PlacingField } from "../src/sorting/placement.ts";
import { Sorter } from "../src/sorting/sorter.ts";
import type { Camera } from "../src/types.ts";

/** Numbers that look arbitrary, the same on every machine. */
function numbers(count: number, seed: number): Float32Array {
  let state = seed;
  return Float32Array.from({ length: count }, () => {
    state = (Math.imul(state, 1664525) + 1013904223) | 0;
    return (state >>> 8) / 2 ** 24;
  });
}

function sorted(depths: Float32Array): number[] {
  const order = [...depths.keys()].sort((a, b) => depths[a]! - depths[b]! || a - b);
  return order.reverse();
}

const sorter = new DepthSorter();

test.each([
  ["spread evenly", (x: number) => 1 + 9 * x],
  ["nearly all in one place, a few far away", (x: number) => (x < 0.99 ? 1 + x / 1000 : 1e6 * x)],
  ["few different ones", (x: number) => Math.floor(5 * x)],
  ["all the same", () => 3],
  ["over many magnitudes", (x: number) => 10 ** (20 * x - 10)],
])("an order is exact for depths %s", (_, shape) => {
  const depths = numbers(20_000, 7).map(shape);
  const order = new Uint32Array(depths.length);
  sorter.sort(depths, depths.length, order);
  const wanted = sorted(depths);
  expect([...order].filter((place, i) => place !== wanted[i]).length).toBe(0);
});

test("a sorter that has sorted more before sorts fewer", () => {
  const depths = Float32Array.from([2, 5, 1]);
  const order = new Uint32Array(9);
  sorter.sort(depths, 3, order);
  expect([...order.subarray(0, 3)]).toEqual([1, 0, 2]);
});

const CAMERA: Camera = {
  viewmat: lookAt([0.2, -0.3, -3], [0, 0, 0], [0.1, -1, 0]),
  K: { fx: 120, fy: 110, cx: 47, cy: 33 },
  width: 100,
  height: 60,
  near: 0.2,
};
/** Training cameras around (0, 0, -3), of 50 pixels focal length. */
const INTERVAL = { middle: [0, 0, -3], spread: 0.5, slope: 0.02 } as const;
const K = 3;
const ANCHORS = 2000;

function scene(): Map<PlacingField, Float32Array<ArrayBuffer>> {
  const within = (low: number, high: number) => (x: number) => low + (high - low) * x;
  return new Map<PlacingField, Float32Array<ArrayBuffer>>([
    ["anchor_positions", numbers(3 * ANCHORS, 1).map(within(-4, 4))],
    ["offset_scales", numbers(3 * ANCHORS, 2).map(within(-4, -2))],
    ["base_scales", numbers(3 * ANCHORS, 3).map(within(-6, -2))],
    ["anchor_offsets", numbers(3 * K * ANCHORS, 4).map(within(-1, 1))],
    ["free", numbers(14 * 5, 5).map(within(-1, 1))],
  ]);
}

function placed(): Placement {
  const placement = new Placement();
  placement.set(scene(), K, INTERVAL);
  return placement;
}

/** Whether some Gaussian of the anchor could reach the picture: every centre, with the largest extent all around it. */
function reaches(placement: Placement, m: number): boolean {
  const v = CAMERA.viewmat;
  for (let k = 0; k < K; k++) {
    const c = placement.centers.subarray(3 * (m * K + k), 3 * (m * K + k) + 3);
    const [x, y, z] = [0, 4, 8].map(
      (row) => v[row]! * c[0]! + v[row + 1]! * c[1]! + v[row + 2]! * c[2]! + v[row + 3]!,
    ) as [number, number, number];
    if (z < CAMERA.near) continue;
    const [px, py] = [(CAMERA.K.fx * x) / z + CAMERA.K.cx, (CAMERA.K.fy * y) / z + CAMERA.K.cy];
    const reach = (3.33 * placement.extents[m]! * 120) / z;
    if (px > -reach && py > -reach && px < CAMERA.width + reach && py < CAMERA.height + reach) return true;
  }
  return false;
}

test("culling keeps every anchor that can reach the picture, and drops most others", () => {
  const placement = placed();
  const into = new Uint32Array(ANCHORS);
  const count = seenAnchors(placement, CAMERA, into);
  const seen = new Set(into.subarray(0, count));
  const needed = Array.from({ length: ANCHORS }, (_, m) => m).filter((m) => reaches(placement, m));
  expect(needed.filter((m) => !seen.has(m))).toEqual([]);
  expect(needed.length).toBeGreaterThan(100);
  expect(count).toBeLessThan(0.5 * ANCHORS);
});

test("a budget keeps the anchors that look largest, in their order", () => {
  const placement = placed();
  const into = new Uint32Array(ANCHORS);
  const count = seenAnchors(placement, CAMERA, into);
  const before = into.slice(0, count);
  const kept = largestAnchors(placement, CAMERA, into, count, 100);
  expect(kept).toBeGreaterThan(90);
  expect(kept).toBeLessThanOrEqual(100);
  const chosen = [...into.subarray(0, kept)];
  expect(chosen).toEqual([...before].filter((m) => chosen.includes(m)));
  const v = CAMERA.viewmat;
  const size = (m: number) => {
    const [x, y, z] = placement.positions.subarray(3 * m, 3 * m + 3);
    return placement.extents[m]! / Math.max(v[8]! * x! + v[9]! * y! + v[10]! * z! + v[11]!, CAMERA.near);
  };
  const left = [...before].filter((m) => !chosen.includes(m));
  // Sizes are compared in bins of a 32nd of an octave.
  expect(Math.max(...left.map(size))).toBeLessThan(Math.min(...chosen.map(size)) * 2 ** (1 / 16));
});

test("an order names slots from far to near, each once, and none behind the near plane", () => {
  const found = new Sorter().order({
    id: 1,
    changed: scene(),
    offsetsPerAnchor: K,
    interval: INTERVAL,
    camera: CAMERA,
    maxSplats: Number.POSITIVE_INFINITY,
    buffers: [],
  });
  const { centers } = placed();
  const slots = [...found.slots.subarray(0, found.splats)];
  expect(new Set(slots).size).toBe(slots.length);
  const depth = (slot: number) => {
    const anchor = Math.floor(slot / K);
    const splat =
      anchor < found.anchorCount ? found.anchors[anchor]! * K + (slot % K) : (ANCHORS - found.anchorCount) * K + slot;
    const v = CAMERA.viewmat;
    const c = centers.subarray(3 * splat, 3 * splat + 3);
    return Math.fround(v[8]! * c[0]! + v[9]! * c[1]! + v[10]! * c[2]! + v[11]!);
  };
  const depths = slots.map(depth);
  expect(depths).toEqual([...depths].sort((a, b) => b - a));
  expect(depths.at(-1)).toBeGreaterThanOrEqual(CAMERA.near);
  expect(slots.some((slot) => slot >= found.anchorCount * K)).toBe(true);
});

test("a budget of free Gaussians alone draws no anchor", () => {
  const sizes = { offsetsPerAnchor: K, interval: INTERVAL };
  const request = { id: 1, changed: scene(), ...sizes, camera: CAMERA, buffers: [], maxSplats: 3 };
  const found = new Sorter().order(request);
  expect(found.anchorCount).toBe(0);
  expect(found.splats).toBeLessThanOrEqual(3);
});
