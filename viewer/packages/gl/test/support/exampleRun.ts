// SPDX-License-Identifier: Apache-2.0
/** Plays the example of a package in a browser. */

import { openStage, type Stage } from "./browser.ts";
import { chromiumPath } from "./chromium.ts";
import type { ExampleStage } from "./examplePage.ts";

/** Pixels; software GL takes its time. */
const VIEWPORT = { width: 80, height: 100 };

/** An engine that reads back has a buffer more for a moment. */
const TRANSIENT = 1;

declare const stage: ExampleStage;

/** @param files streams by the names under which the example loads them */
export function openExample(script: URL, files: Readonly<Record<string, string>>): Promise<Stage> {
  const query = Object.keys(files).map((name) => `src=${name}`);
  return openStage(chromiumPath()!, files, script, { viewport: VIEWPORT, query: `?${query.join("&")}` });
}

/** Plays all streams to their end; returns the number of frames shown, fewer than there are where drawing is slow. */
export async function playToEnd({ page }: Stage): Promise<number> {
  const before = await page.evaluate(() => stage.shown);
  await page.getByRole("button", { name: "Play" }).click();
  await page.waitForFunction(() => stage.clips.every(({ playback }) => playback.ended), undefined, { timeout: 0 });
  return (await page.evaluate(() => stage.shown)) - before;
}

/** Numbers of what is on the GPU, after some more pictures. */
export async function settledCounts({ page }: Stage): Promise<Record<string, number>> {
  await page.evaluate(async () => {
    for (let i = 0; i < 5; i++) await new Promise(requestAnimationFrame);
  });
  return page.evaluate(() => stage.glCounts());
}

/** What there is more of than before, transient objects aside. */
export function grown(before: Readonly<Record<string, number>>, after: Readonly<Record<string, number>>): string[] {
  return Object.keys(after).filter((kind) => after[kind]! > before[kind]! + TRANSIENT);
}
