// SPDX-License-Identifier: Apache-2.0
/** Frames in a PlayCanvas scene against those of our own renderer. */

import { fileURLToPath } from "node:url";
import { afterAll, beforeAll, describe, expect, test } from "vitest";
import { openStage, type Stage } from "../../gl/test/support/browser.ts";
import { chromiumPath } from "../../gl/test/support/chromium.ts";
import { bytesOf, difference } from "../../gl/test/support/compare.ts";
import type { Pair } from "./page.ts";

/** The engine draws a Gaussian less opaque towards its rim, and none of the rim. */
const MIN_DECIBELS = 32;
/** Of the camera's own pictures. */
const SIZE = 0.5;
const executable = chromiumPath();
const clip = fileURLToPath(new URL("../../player/test/fixtures/clip.sgs", import.meta.url));

declare const pair: Pair;

describe.skipIf(!executable)("in a browser", () => {
  let stage: Stage;
  beforeAll(async () => {
    stage = await openStage(executable!, { clip }, new URL("page.ts", import.meta.url));
    await stage.page.evaluate("stage.open('/clip').then((opened) => { globalThis.pair = opened; })");
  }, 60_000);
  afterAll(() => stage?.close());

  test("what changes with the frame changes in PlayCanvas", async () => {
    const seen = [];
    for (const index of [0, 8]) {
      const { engine, own, width, height } = await stage.page.evaluate(
        ([frame, size]) => pair.pictures(frame, "cam03", size),
        [index, SIZE] as const,
      );
      const view = { engine: bytesOf(engine), width, height };
      const { psnrDecibels } = difference(view.engine, bytesOf(own), width, height);
      console.log(`frame ${index}: ${psnrDecibels.toFixed(1)} dB`);
      expect(psnrDecibels).toBeGreaterThan(MIN_DECIBELS);
      seen.push(view);
    }
    const [before, after] = seen;
    expect(difference(before!.engine, after!.engine, after!.width, after!.height).pixelLevels).toBeGreaterThan(40);
  }, 120_000);

  test("a destroyed one refuses frames", async () => {
    await stage.page.evaluate(() => pair.close());
    const message = await stage.page.evaluate(() => {
      try {
        pair.splats.show(new Map());
      } catch (error) {
        return String(error);
      }
      return "no error";
    });
    expect(message).toContain("These splats were destroyed");
    expect(stage.complaints).toEqual([]);
  });
});
