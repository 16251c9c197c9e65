// SPDX-License-Identifier: Apache-2.0
/** The built player at the edge of a live stream that a plain web server has. Skipped where there is no browser. */

import { readFileSync } from "node:fs";
import { afterEach, describe, expect, test, vi } from "vitest";
import { TestServer } from "../../../gl/test/support/server.ts";
import { LiveRun, type RunOptions } from "../liveRun.ts";
import { periodFile } from "../periodFile.ts";
import { CLIP } from "../served.ts";
import { ask, darkest, ended, reported, StagedTests, shows } from "./stage.ts";

vi.setConfig({ testTimeout: 60_000, hookTimeout: 60_000 });

const fixture = (name: string) =>
  new Uint8Array(readFileSync(new URL(`../../../core/test/fixtures/${name}.sgs`, import.meta.url)));
/** Few anchors: software GL shows many pictures of them in a second. */
const FEW = fixture("paper");

describe.skipIf(StagedTests.skipped)("a live stream in a browser", () => {
  const stage = new StagedTests();
  let writing: ReturnType<typeof setInterval> | undefined;

  afterEach(() => clearInterval(writing));

  function run(stream: Uint8Array, frames: number, options: RunOptions = {}): LiveRun {
    const made = new LiveRun(stream, options).write(frames);
    stage.server.publish("/live/", made.files);
    return made;
  }

  function write(live: LiveRun, frames: number): void {
    live.write(frames);
    stage.server.publish("/live/", live.files);
  }

  test("a late viewer begins at the edge, holds the last frame, and knows when the next one comes", async () => {
    const live = run(CLIP, 20, { frameSeconds: 4, pageSegments: 2 });
    const page = await stage.open('src="live/manifest.json" autoplay');
    await shows(page, 19);
    expect(await ask(page, (_, __, frames) => frames[0])).toBeGreaterThanOrEqual(18);
    expect(await ask(page, (player) => [player.live, player.paused, player.behindSeconds])).toEqual([true, false, 0]);
    write(live, 1);
    await shows(page, 20);
    await page.getByText(/Frame 20, next in about [1-4] s/).waitFor();
    await page.getByRole("button", { name: "Live. At the newest frame" }).waitFor();
    const asked = stage.server.requests.map(({ path }) => path);
    expect(asked.filter((path) => path.includes("history"))).toEqual([]);
    expect(asked.filter((path) => path.includes("segment")).length).toBeLessThanOrEqual(1);
    expect(await reported(page)).toEqual([]);
  });

  test("scrubs over the window and goes back to LIVE", async () => {
    const live = run(FEW, 120, { pageSegments: 3, fps: 10 });
    const page = await stage.open('src="live/manifest.json" autoplay');
    writing = setInterval(() => write(live, 1), 100);
    await page.waitForFunction(() => heard.frames.length > 5);
    const slider = page.getByRole("slider", { name: "Time" });
    const box = (await slider.boundingBox())!;
    // How many frames there are by now depends on how long the page took to open.
    const newest = await page.evaluate(() => heard.frames.at(-1)!);
    await page.mouse.click(box.x + box.width * 0.25, box.y + box.height / 2);
    await page.waitForFunction((before) => heard.frames.at(-1)! < before / 2, newest);
    await page.getByRole("button", { name: /Live\. Go to the newest frames: \d+ s behind/ }).click();
    await page.waitForFunction((before) => heard.frames.at(-1)! > before, newest);
    live.finish();
    stage.server.publish("/live/", live.files);
    clearInterval(writing);
    await page.getByText("The stream has ended; it is a recording now.").waitFor();
    await ended(page);
    expect(await reported(page)).toEqual([]);
  });

  test("no frame between two periods of a file is blank, and frames are drawn in their order", async () => {
    const { bytes, inits } = periodFile([FEW, FEW, FEW], 5, 5);
    stage.server.put("/periods.sgs", bytes);
    const page = await stage.open('src="periods.sgs" controls="off"');
    await shows(page, 0);
    const { light, pictures } = await darkest(page, 4, 11);
    expect(pictures).toBeGreaterThan(4);
    expect(light).toBeGreaterThan(5);
    const drawn = await ask(page, (_, __, frames) => frames);
    expect(drawn).toEqual([...drawn].sort((a, b) => a - b));
    expect(drawn.at(-1)).toBe(14);
    await ask(page, (player) => player.seek(6 / 5));
    await shows(page, 6);
    expect(inits.length).toBe(2);
    expect(await reported(page)).toEqual([]);
  });

  test("a period may have other cameras and another scene", async () => {
    const live = run(FEW, 3, { fps: 5 });
    live.begin(CLIP);
    live.write(3).finish();
    stage.server.publish("/live/", live.files);
    const page = await stage.open('src="live/manifest.json"');
    await shows(page, 0);
    const before = await ask(page, (player) => player.cameras);
    await ask(page, (player) => player.seek(1));
    await shows(page, 5);
    const after = await ask(page, (player) => player.cameras);
    expect(after.length).toBe(10);
    expect(after).not.toEqual(before);
    await ask(page, (player) => player.seek(0.2));
    await shows(page, 1);
    expect(await ask(page, (player) => player.cameras)).toEqual(before);
    expect(await reported(page)).toEqual([]);
  });

  test("the page's token opens its streams, and is sent to no other host", async () => {
    run(FEW, 5, { frameSeconds: 1 });
    const elsewhere = await TestServer.started();
    try {
      elsewhere.publish("/live/", new LiveRun(FEW).write(5).files, { cors: true });
      const page = await stage.open('src="live/manifest.json" autoplay', "?token=v1.a-b_c");
      await shows(page, 4);
      const ours = stage.server.requests.filter(({ path }) => path.startsWith("/live/"));
      expect(ours.every(({ query }) => new URLSearchParams(query).get("token") === "v1.a-b_c")).toBe(true);
      await ask(
        page,
        new Function("player", `player.load(${JSON.stringify(`${elsewhere.origin}/live/manifest.json`)})`) as never,
      );
      await expect.poll(() => elsewhere.requests.length, { timeout: 15_000 }).toBeGreaterThan(3);
      expect(elsewhere.requests.every(({ query }) => !query.includes("token"))).toBe(true);
      expect(await reported(page)).toEqual([]);
    } finally {
      await elsewhere.stop();
    }
  });
});
