// SPDX-License-Identifier: Apache-2.0
/** Frames in a three.js scene against those of our own renderer. */

import { fileURLToPath } from "node:url";
import { afterAll, beforeAll, describe, expect, test } from "vitest";
import { openStage, type Stage } from "../../gl/test/support/browser.ts";
import { chromiumPath } from "../../gl/test/support/chromium.ts";
import { bytesOf, difference } from "../../gl/test/support/compare.ts";
import type { Pair } from "./page.ts";

/** Spark packs centres into half floats and colours into bytes. */
const MIN_DECIBELS = 40;
/** Of the camera's own pictures: software GL takes a quarter of the time, and Spark's blur of smaller pictures is tried too. */
const SIZE = 0.5;
const executable = chromiumPath();
const patch = fileURLToPath(new URL("../../gl/test/fixtures/patch.sgs", import.meta.url));

declare const pair: Pair;

describe.skipIf(!executable)("in a browser", () => {
  let stage: Stage;
  beforeAll(async () => {
    stage = await openStage(executable!, { patch }, new URL("page.ts", import.meta.url));
    await stage.page.evaluate("stage.open('/patch').then((opened) => { globalThis.pair = opened; })");
  }, 60_000);
  afterAll(() => stage?.close());

  const compared = async (index: number, camera: string) => {
    const { spark, own, width, height } = await stage.page.evaluate(
      ([frame, name, of]) => pair.pictures(frame, name, of),
      [index, camera, SIZE] as const,
    );
    return { spark: bytesOf(spark), ...difference(bytesOf(spark), bytesOf(own), width, height), width, height };
  };

  test("what changes with the frame changes in Spark", async () => {
    const seen = [];
    for (const index of [0, 2]) {
      const view = await compared(index, "cam03");
      console.log(`frame ${index}: ${view.psnrDecibels.toFixed(1)} dB`);
      expect(view.psnrDecibels).toBeGreaterThan(MIN_DECIBELS);
      seen.push(view);
    }
    const [before, after] = seen;
    // The frames differ by more than Spark differs from us: it does show another one.
    expect(difference(before!.spark, after!.spark, after!.width, after!.height).pixelLevels).toBeGreaterThan(40);
    const { splats, error } = await stage.page.evaluate(() => pair.state());
    expect(error).toBe("");
    expect(splats).toBeGreaterThan(500);
  }, 120_000);

  test("disposing leaves no splats", async () => {
    await stage.page.evaluate(() => pair.close());
    expect(await stage.page.evaluate(() => pair.state().splats)).toBe(0);
    expect(stage.complaints).toEqual([]);
  });
});
