// SPDX-License-Identifier: Apache-2.0
/** What a real browser plays: each clap is heard when its white picture is drawn. Skipped where there is no browser. */

import type { Page } from "playwright-core";
import { beforeAll, describe, expect, test, vi } from "vitest";
import { LiveRun } from "../liveRun.ts";
import { clappingFile, FPS } from "../soundFile.ts";
import { emulatedHeadset } from "./headset.ts";
import { StagedTests } from "./stage.ts";

vi.setConfig({ testTimeout: 120_000, hookTimeout: 60_000 });

const MINUTES = 10;
/** Claps and white pictures are a second apart, so a difference is less than half of that. */
const MOST_MILLISECONDS = 40;

/** Times of claps, as they are heard, and of the first white picture of each, as it is drawn: milliseconds of the page. */
interface Times {
  claps: number[];
  flashes: number[];
}

/** Runs before the page: listens to all that reaches the speakers, and remembers the claps. */
function tap(): void {
  const times: Times = { claps: [], flashes: [] };
  Object.assign(globalThis, { times });
  const worklet = `registerProcessor("tap", class extends AudioWorkletProcessor {
    process([input]) {
      const samples = input[0] ?? [];
      for (let i = 0; i < samples.length; i++) if (Math.abs(samples[i]) > 0.2) {
        const at = currentTime + i / sampleRate;
        if (!(at - this.last < 0.2)) this.port.postMessage(at);
        this.last = at;
      }
      return true;
    }
  })`;
  const url = URL.createObjectURL(new Blob([worklet], { type: "text/javascript" }));
  const { connect } = AudioNode.prototype;
  AudioNode.prototype.connect = function (this: AudioNode, ...given: [never]) {
    const [target] = given as unknown[];
    const { context } = this;
    if (target === context.destination) {
      void context.audioWorklet.addModule(url).then(() => {
        const node = new AudioWorkletNode(context, "tap");
        node.port.onmessage = ({ data }: MessageEvent<number>) => {
          const { contextTime, performanceTime } = (context as AudioContext).getOutputTimestamp();
          times.claps.push(performanceTime! + 1000 * (data - contextTime!));
        };
        connect.call(this, node as never);
      });
    }
    return connect.apply(this, given);
  } as typeof connect;
}

/** Runs in the page: remembers when a picture becomes white. */
function watch(): void {
  const player = document.querySelector("structgstream-player")!;
  const small = document.createElement("canvas").getContext("2d", { willReadFrequently: true })!;
  const { times } = globalThis as unknown as { times: Times };
  const canvas = player.shadowRoot!.querySelector("canvas")!;
  let white = false;
  player.on("drawn", () => {
    const now = performance.now();
    small.drawImage(canvas, 0, 0, 1, 1);
    const light = small.getImageData(0, 0, 1, 1).data[0]! > 100;
    if (light && !white) times.flashes.push(now);
    white = light;
  });
}

/** Forgets what was, and waits for so many claps; by how much later than its picture each was heard, sorted. */
async function differences(page: Page, count: number): Promise<number[]> {
  await page.evaluate("times.claps.length = times.flashes.length = 0");
  await page.waitForFunction(`times.claps.length > ${count}`, undefined, { timeout: 60_000 });
  const { claps, flashes } = (await page.evaluate("times")) as Times;
  return claps
    .map((clap) => clap - flashes.reduce((near, at) => (Math.abs(at - clap) < Math.abs(near - clap) ? at : near), 1e9))
    .filter((difference) => Math.abs(difference) < 500)
    .sort((a, b) => a - b);
}

function expectInStep(found: readonly number[], where: string): void {
  const middle = found[found.length >> 1];
  console.info(
    `${where}: sound is ${middle?.toFixed(1)} ms after the picture, each ${found.map((ms) => ms.toFixed(0))}`,
  );
  expect(Math.abs(middle ?? Number.NaN)).toBeLessThan(MOST_MILLISECONDS);
}

describe.skipIf(StagedTests.skipped)("sound in a browser", () => {
  const stage = new StagedTests();

  beforeAll(() => void stage.server.put("/claps.sgs", clappingFile(60 * MINUTES + 10)));

  async function opened(attributes: string, script = ""): Promise<Page> {
    const options = { viewport: { width: 96, height: 72 } };
    const page = await stage.open(attributes, "", options, `(${tap.toString()})();${script}`);
    await page.waitForFunction(() => heard.frames.length > 0);
    await page.evaluate(watch);
    return page;
  }

  test("is in step at the start, after seeks and after ten minutes", async () => {
    const page = await opened('src="claps.sgs" autoplay');
    expectInStep(await differences(page, 4), "at the start");
    await page.evaluate(() => document.querySelector("structgstream-player")!.seek(303.3));
    expectInStep(await differences(page, 4), "after a seek");
    await page.evaluate((seconds) => document.querySelector("structgstream-player")!.seek(seconds), 60 * MINUTES - 1);
    expectInStep(await differences(page, 4), "after ten minutes");
  });

  test("is in step at the edge of a live stream", async () => {
    const live = new LiveRun(clappingFile(60), { fps: FPS }).write(4 * FPS);
    stage.server.publish("/live/", live.files);
    const writing = setInterval(() => {
      live.write(1);
      stage.server.publish("/live/", live.files);
    }, 1000 / FPS);
    try {
      const page = await opened('src="live/manifest.json" autoplay');
      expect(await page.evaluate(() => document.querySelector("structgstream-player")!.live)).toBe(true);
      expectInStep(await differences(page, 5), "live");
    } finally {
      clearInterval(writing);
    }
  });

  test("goes on in a headset, in step", async () => {
    const page = await opened('src="claps.sgs" autoplay', emulatedHeadset());
    await page.evaluate(() => document.querySelector("structgstream-player")!.enterXr());
    expectInStep(await differences(page, 4), "in a headset");
    await page.evaluate(() => document.querySelector("structgstream-player")!.exitXr());
    expectInStep(await differences(page, 2), "after it");
  });

  test("is muted by attribute, property, button and key, and loud as its volume says", async () => {
    const page = await opened('src="claps.sgs" muted');
    await page.evaluate(() => {
      const changes: string[] = [];
      Object.assign(globalThis, { changes });
      const player = document.querySelector("structgstream-player")!;
      player.on("volumechange", () => changes.push(`${player.muted} ${player.volume}`));
      return player.play();
    });
    await page.waitForFunction(() => document.querySelector("structgstream-player")!.currentTime > 1.2);
    expect(await page.evaluate("[times.claps.length, changes.length]")).toEqual([0, 0]);
    await page.getByRole("button", { name: "Unmute" }).click();
    await differences(page, 1);
    await page.keyboard.press("m");
    const changes = await page.evaluate(() => {
      const player = document.querySelector("structgstream-player")!;
      player.volume = 0.5;
      player.muted = false;
      player.defaultMuted = false;
      let refused = "";
      try {
        player.volume = 2;
      } catch (error) {
        refused = (error as DOMException).name;
      }
      return [...(globalThis as unknown as { changes: string[] }).changes, refused, player.outerHTML.includes("muted")];
    });
    expect(changes).toEqual(["false 1", "true 1", "true 0.5", "false 0.5", "IndexSizeError", false]);
    await page.evaluate(() => {
      document.querySelector("structgstream-player")!.playbackRate = 2;
    });
    await page.getByRole("button", { name: "Mute (off at other speeds)" }).waitFor();
  });
});
