// SPDX-License-Identifier: Apache-2.0
/** Frames and times where only some times are known. */

import { expect, test } from "vitest";
import { SegmentCatalog } from "../src/decode/segmentCatalog.ts";
import { Timeline } from "../src/engine/timeline.ts";
import { type Manifest, manifestIn, type PageEntry, pageIn } from "../src/source/manifest.ts";
import { LiveRun, type RunOptions } from "./liveRun.ts";
import { CLIP } from "./served.ts";

function made(frames: number, options: RunOptions) {
  const live = new LiveRun(CLIP, options).write(frames);
  const catalog = new SegmentCatalog();
  catalog.take(manifestIn(live.files.get("manifest.json")!, "m.json") as Manifest);
  const timeline = new Timeline();
  timeline.take(catalog.facts());
  return { live, catalog, timeline };
}

test.each([{}, { pageSegments: 2 }, { pageSegments: 3, windowSegments: 5 }, { fps: 29.97, pageSegments: 4 }])(
  "times lead to frames and back: %j",
  (options) => {
    const { timeline } = made(130, options);
    const fps = (options as RunOptions).fps ?? 30;
    expect(timeline.count).toBe(130);
    expect(timeline.duration).toBeCloseTo(130 / fps);
    for (let frame = timeline.first; frame < 130; frame++) {
      expect(timeline.ptsOf(frame)).toBeCloseTo(frame / fps, 9);
      expect(timeline.frameAt(timeline.ptsOf(frame))).toBe(frame);
      expect(timeline.frameAt(timeline.endOf(frame) - 1e-4)).toBe(frame);
    }
    expect(timeline.frameAt(-5)).toBe(timeline.first);
    expect(timeline.frameAt(1e9)).toBe(129);
  },
);

test("what is known grows with the number of pages, and not of frames", () => {
  const { catalog, live } = made(400, { pageSegments: 4 });
  const few = catalog.facts().frames!.length;
  expect(few).toBeLessThan(60);
  const read = new Set<string>();
  for (let page = catalog.missingPage(5); page; page = catalog.missingPage(5)) {
    const entry: PageEntry = page;
    expect(read.has(entry.file)).toBe(false);
    read.add(entry.file);
    catalog.takePage(entry, pageIn(live.files.get(entry.file)!, entry));
  }
  expect(read.size).toBe(2);
  expect(catalog.groupStart(5)).toBe(3);
  expect(catalog.groupEnd(4)).toBe(6);
  expect(catalog.isKey(3)).toBe(true);
  expect(catalog.place(4)!.start).toBe(catalog.place(3)!.end);
  expect(catalog.facts().frames!.length).toBeGreaterThan(few);
  // However many are read, few are kept.
  for (let frame = 0; frame < 390; frame += 6) {
    for (let page = catalog.missingPage(frame); page; page = catalog.missingPage(frame)) {
      catalog.takePage(page, pageIn(live.files.get(page.file)!, page));
    }
  }
  expect(catalog.facts().frames!.length).toBeLessThan(150);
});

test("the pace of the media is that of the last frames, whether in parts or in segments", () => {
  for (const frames of [1, 2, 3, 8, 9, 10, 40, 41]) {
    const { catalog } = made(frames, { fps: 12.5 });
    expect(catalog.facts().live!.mediaSeconds).toBeCloseTo(0.08, 9);
  }
});

test("times of a hostile manifest rise all the same", () => {
  const live = new LiveRun(CLIP).write(20);
  const value = JSON.parse(new TextDecoder().decode(live.files.get("manifest.json")!));
  value.segments[2].pts_seconds = [-50, -50];
  value.segments[3].pts_seconds = [1e15, 1e15];
  const catalog = new SegmentCatalog();
  catalog.take(manifestIn(new TextEncoder().encode(JSON.stringify(value)), "m.json") as Manifest);
  const { ptsSeconds } = catalog.facts();
  expect([...ptsSeconds].every((seconds, i) => !i || seconds >= ptsSeconds[i - 1]!)).toBe(true);
});
