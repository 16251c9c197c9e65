// SPDX-License-Identifier: Apache-2.0
/** How far behind the newest frame playing keeps. */

import { expect, test } from "vitest";
import { Edge } from "../src/engine/edge.ts";
import { Timeline } from "../src/engine/timeline.ts";

/** The edge of a stream of 30 frames a second, and a function that reports more of them. */
function made(targetSeconds: number) {
  const timeline = new Timeline();
  const edge = new Edge(timeline);
  const report = (count: number, now: number) => {
    timeline.take({
      first: 0,
      count,
      ptsSeconds: Float64Array.from({ length: count }, (_, i) => i / 30),
      keys: Uint32Array.from({ length: Math.ceil(count / 30) }, (_, i) => 30 * i),
      lost: [],
      complete: false,
      live: { live: true, targetSeconds, frameSeconds: 1 / 30, mediaSeconds: 1 / 30, fps: 30, filmedAtZero: undefined },
    });
    edge.changed(now);
  };
  return { edge, report };
}

test("is the target, or one and a half of the longest step of late", () => {
  const { edge, report } = made(1);
  report(30, 0);
  expect(edge.distance).toBe(1);
  report(60, 1);
  report(120, 3);
  expect(edge.distance).toBe(3.25);
  for (let i = 0; i < 8; i++) report(125 + i, 3.1 + i / 10);
  expect(edge.distance).toBe(1);
});

test("an outage is no step: LIVE does not lead back to before it", () => {
  const { edge, report } = made(1);
  report(30, 0);
  report(60, 1);
  report(30 * 121, 61);
  expect(edge.distance).toBeLessThanOrEqual(15.25);
  expect(edge.start).toBeGreaterThanOrEqual(30 * 105);
});
