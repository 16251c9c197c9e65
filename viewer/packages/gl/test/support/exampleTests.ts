// SPDX-License-Identifier: Apache-2.0
/** Tests of the example of a package: played to the end, sought, and removed, with what is on the GPU counted. */

import { fileURLToPath } from "node:url";
import { afterAll, beforeAll, describe, expect, test } from "vitest";
import type { Stage } from "./browser.ts";
import { chromiumPath } from "./chromium.ts";
import type { ExampleStage } from "./examplePage.ts";
import { grown, openExample, playToEnd, settledCounts } from "./exampleRun.ts";

const STREAM = fileURLToPath(new URL("../../../core/test/fixtures/paper.sgs", import.meta.url));

declare const stage: ExampleStage;

export function testExample(script: URL): void {
  describe.skipIf(!chromiumPath())("the example", () => {
    let opened: Stage;
    beforeAll(async () => {
      opened = await openExample(script, { "left.sgs": STREAM, "right.sgs": STREAM });
      await opened.page.evaluate(() => {
        for (const { playback } of stage.clips) playback.playbackRate = 0.1;
      });
    });
    afterAll(() => opened?.close());

    test("plays two streams to their end and again, and the GPU holds no more", async () => {
      await opened.page.waitForFunction(() => stage.shown === 2);
      expect(await playToEnd(opened)).toBeGreaterThanOrEqual(2);
      const before = await settledCounts(opened);
      expect(await playToEnd(opened)).toBeGreaterThanOrEqual(2 * 2);
      expect(grown(before, await settledCounts(opened))).toEqual([]);
    });

    test("is sought by its slider", async () => {
      const { page } = opened;
      const before = await page.evaluate(() => stage.shown);
      await page.getByRole("slider").fill("0.04");
      await page.waitForFunction((shown) => stage.shown === shown + 2, before);
      for (const time of await page.evaluate(() => stage.clips.map(({ playback }) => playback.currentTime))) {
        expect(time).toBeCloseTo(0.04, 2); // a slider has steps
      }
      expect(await page.evaluate(() => stage.clips.some(({ playback }) => playback.ended))).toBe(false);
    });

    test("releases the streams' textures, and no message came", async () => {
      const before = await settledCounts(opened);
      await opened.page.evaluate(() => stage.removeStreams());
      const after = await settledCounts(opened);
      expect(before.Texture! - after.Texture!).toBeGreaterThanOrEqual(2 * 9);
      expect(opened.complaints).toEqual([]);
    });
  });
}
