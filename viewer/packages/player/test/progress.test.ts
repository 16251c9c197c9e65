// SPDX-License-Identifier: Apache-2.0
/** What was sought, what has come, and when a key frame on the way is a step back. */

import { expect, test } from "vitest";
import { Progress } from "../src/engine/progress.ts";

/** Frame `at` is shown and was sought. */
function at(frame: number): Progress {
  const progress = new Progress();
  progress.seek(frame);
  progress.arrive();
  progress.shown = frame;
  return progress;
}

test("on the way forward no key frame before the one that is shown is", () => {
  const progress = at(21);
  progress.seek(26);
  expect(progress.isBack(20, false)).toBe(true);
  expect(progress.isBack(21, false)).toBe(false);
  expect(progress.isBack(25, false)).toBe(false);
  expect(progress.isBack(26, true)).toBe(false);
});

test("who seeks back sees the key frame there at once, and all frames after it", () => {
  const progress = at(21);
  progress.seek(12);
  expect(progress.isBack(10, false)).toBe(false);
  expect(progress.isBack(12, true)).toBe(false);
  progress.arrive();
  expect(progress.isBack(13, true)).toBe(false); // also when nothing was drawn since
});

test("a seek that is overtaken by one forward leaves what is shown as it is", () => {
  const progress = at(21);
  progress.seek(12);
  progress.seek(30);
  expect(progress.isBack(20, false)).toBe(true);
  expect(progress.isBack(29, false)).toBe(false);
});

test("what stands for a frame that is lost is shown when it was sought, and not on the way", () => {
  const progress = at(8);
  progress.seek(10);
  expect(progress.isBack(6, true)).toBe(false);
  progress.arrive();
  expect(progress.isBack(6, true)).toBe(true);
});

test("frames are reached one after the other, and by seeking also back", () => {
  const progress = at(5);
  progress.reach(8);
  progress.reach(7);
  expect(progress.reached).toBe(8);
  progress.seek(3);
  expect([progress.reached, progress.seeking, progress.target, progress.serial]).toEqual([2, true, 3, 2]);
  progress.arrive();
  expect([progress.reached, progress.seeking]).toEqual([3, false]);
});
