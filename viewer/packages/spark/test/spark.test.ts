// SPDX-License-Identifier: Apache-2.0
/** Frames in a three.js scene against those of our own renderer. */

import { fileURLToPath } from "node:url";
import { afterAll, beforeAll, describe, expect, test } from "vitest";
import { openStage, type Stage } from "../../gl/test/support/browser.ts";
import { chromiumPath } from "../../gl/test/support/chromium.ts";
import { bytesOf, difference } from "../../gl/test/support/compare.ts";
import type { Beside } from "./page.ts";

/** Spark packs centres into half floats and colours into bytes. */
const MIN_DECIBELS = 40;
const executable = chromiumPath();
const patch = fileURLToPath(new URL("../../gl/test/fixtures/patch.sgs", import.meta.url));

declare const beside: Beside;

describe.skipIf(!executable)("in a browser", () => {
  let stage: Stage;
  beforeAll(async () => {
    stage = await openStage(executable!, { patch }, new URL("page.ts", import.meta.url));
    await stage.page.evaluate("stage.open('/patch').then((opened) => { globalThis.beside = opened; })");
  }, 60_000);
  afterAll(() => stage?.close());

  const compared = async (index: number, camera: string, size = 1) => {
    const { spark, own, width, height } = await stage.page.evaluate(
      ([frame, name, of]) => beside.pictures(frame, name, of),
      [index, camera, size] as const,
    );
    return { spark: bytesOf(spark), ...difference(bytesOf(spark), bytesOf(own), width, height), width, height };
  };

  test("what changes with the frame changes in Spark", async () => {
    const seen = [];
    for (const [index, camera] of [
      [0, "cam03"],
      [2, "cam03"],
    ] as const) {
      const view = await compared(index, camera);
      console.log(`frame ${index}, ${camera}: ${view.psnrDecibels.toFixed(1)} dB`);
      expect(view.psnrDecibels).toBeGreaterThan(MIN_DECIBELS);
      seen.push(view);
    }
    const [before, after] = seen;
    // The frames differ by more than Spark differs from us: it does show another one.
    expect(difference(before!.spark, after!.spark, after!.width, after!.height).pixelLevels).toBeGreaterThan(40);
    const { splats, error } = await stage.page.evaluate(() => beside.state());
    expect(error).toBe("");
    expect(splats).toBeGreaterThan(500);
  }, 120_000);

  // Spark blurs smaller pictures only, so that larger ones are drawn as those of the camera's own size.
  test("smaller pictures of another camera look alike too", async () => {
    const view = await compared(0, "cam00", 0.5);
    console.log(`0.5x: ${view.psnrDecibels.toFixed(1)} dB`);
    expect(view.psnrDecibels).toBeGreaterThan(MIN_DECIBELS);
  }, 120_000);

  test("it is given back", async () => {
    await stage.page.evaluate(() => beside.close());
    expect(await stage.page.evaluate(() => beside.state().splats)).toBe(0);
    expect(stage.complaints).toEqual([]);
  });
});
