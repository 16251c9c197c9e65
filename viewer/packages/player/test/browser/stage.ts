// SPDX-License-Identifier: Apache-2.0
/** A headless browser with WebGL2 in software, with pages that hold the built player. */

import { readFileSync } from "node:fs";
import type { Browser, BrowserContextOptions, Page } from "playwright-core";
import { afterAll, afterEach, beforeAll, expect } from "vitest";
import { chromiumPath, complaintsOf, launched } from "../../../gl/test/support/chromium.ts";
import { TestServer } from "../../../gl/test/support/server.ts";
import type { StructgstreamPlayer } from "../../src/element.ts";
import { CLIP } from "../served.ts";

declare global {
  /** What `pageWith` gathers in the page. */
  var heard: { reported: [name: string, message: string][]; frames: number[] };
  interface HTMLElementTagNameMap {
    "structgstream-player": StructgstreamPlayer;
  }
}

function builtPlayer(): string {
  return readFileSync(new URL("../../dist/player.js", import.meta.url), "utf8");
}

/** Pages are composited without software GL, which takes twice as long for them; WebGL still has it. */
const FLAGS = [
  "--disable-gpu-compositing",
  "--disable-gpu-rasterization",
  "--autoplay-policy=no-user-gesture-required", // otherwise sound may start only after a click, by chance
];
const VIEWPORT = { width: 320, height: 240 };

interface Opened {
  readonly page: Page;
  /** What the console and the page complained of. */
  readonly complaints: string[];
}

/** One browser and one server for a file of tests; a page is closed after its test. */
export class StagedTests {
  server!: TestServer;
  private browser!: Browser;
  /** The page of all tests that ask for no options of their own. */
  private usual: Opened | undefined;
  private opened: Opened | undefined;
  /** What its pages may complain of. */
  private expected: RegExp | undefined;

  /** Without a browser the tests that use this are to be skipped. */
  static readonly skipped = !chromiumPath();

  constructor() {
    beforeAll(async () => {
      [this.browser, this.server] = await Promise.all([launched(chromiumPath()!, ...FLAGS), TestServer.started()]);
      this.server.put("/player.js", builtPlayer(), { type: "text/javascript" });
      this.server.put("/clip.sgs", CLIP);
    });
    afterAll(async () => {
      await this.browser.close();
      await this.server.stop();
    });
    afterEach(async () => {
      try {
        await this.close();
      } finally {
        this.server.put("/clip.sgs", CLIP);
        this.expected = undefined;
      }
    });
  }

  /**
   * A page with one player.
   *
   * @param attributes of the element, written as in HTML
   * @param options give the page a context of its own
   * @param script runs in that page before its own scripts
   */
  async open(
    attributes = 'src="clip.sgs"',
    query = "",
    options?: BrowserContextOptions,
    script?: string,
  ): Promise<Page> {
    this.server.put("/page.html", pageWith(attributes), { type: "text/html" });
    this.server.requests.length = 0;
    this.opened = options ? await this.newPage(options) : await this.usualPage();
    const { page } = this.opened;
    if (script) await page.addInitScript({ content: script });
    await page.goto(`${this.server.origin}/page.html${query}`);
    return page;
  }

  /** Ends what the page does, which must not have complained, but of what the test expects. */
  async close(): Promise<void> {
    const { opened, expected } = this;
    this.opened = undefined;
    if (!opened) return;
    const left = opened.complaints.filter((text) => !expected?.test(text));
    if (opened === this.usual) await opened.page.goto("about:blank");
    else await opened.page.context().close();
    expect(left).toEqual([]);
  }

  expectComplaints(expected: RegExp): void {
    this.expected = expected;
  }

  private async usualPage(): Promise<Opened> {
    this.usual ??= await this.newPage({});
    this.usual.complaints.length = 0;
    await this.usual.page.setViewportSize(VIEWPORT);
    return this.usual;
  }

  private async newPage(options: BrowserContextOptions): Promise<Opened> {
    const context = await this.browser.newContext({ viewport: VIEWPORT, ...options });
    const page = await context.newPage();
    return { page, complaints: complaintsOf(page) };
  }
}

/** Waits until playback has reached the end. */
export async function ended(page: Page, timeout = 30_000): Promise<void> {
  await page.waitForFunction(() => heard.reported.some(([name]) => name === "ended"), undefined, { timeout });
}

/** The messages of an event that the player has reported. */
export function reported(page: Page, event: "error" | "notice" = "error"): Promise<string[]> {
  return page.evaluate((name) => heard.reported.filter(([one]) => one === name).map(([, message]) => message), event);
}

export function pageWith(attributes: string): string {
  return `<!doctype html><html lang="en"><meta charset="utf-8"><title>player</title><link rel="icon" href="data:,">
<meta name="viewport" content="width=device-width"><style>html,body{margin:0;height:100%}</style>
<structgstream-player ${attributes} style="width:100%;height:100%;aspect-ratio:auto"></structgstream-player>
<script>
  const player = document.querySelector("structgstream-player"); globalThis.heard = { reported: [], frames: [] };
  customElements.whenDefined("structgstream-player").then(() => {
    for (const name of ["error", "notice", "stall", "ended"]) player.on(name, (event) => heard.reported.push([name, event.message ?? ""]));
    player.on("drawn", ({ stats }) => { if (heard.frames.at(-1) !== stats.frameIndex) heard.frames.push(stats.frameIndex); });
  });
</script>
<script type="module" src="/player.js"></script></html>`;
}

/** Runs in the page: gives back what it gives, with the element and what it has reported. */
export function ask<Result>(
  page: Page,
  question: (player: StructgstreamPlayer, reported: [string, string][], frames: number[]) => Result | Promise<Result>,
): Promise<Result> {
  const text = `(${question.toString()})(document.querySelector("structgstream-player"), heard.reported, heard.frames)`;
  return page.evaluate(text) as Promise<Result>;
}

/**
 * Of a stream of 5 frames a second, plays slowly to the end; gives back how dark the darkest picture of these frames was, of 255, and how many there were.
 * Slowly, so that a busy machine draws most frames.
 */
export async function darkest(page: Page, first: number, last: number): Promise<{ light: number; pictures: number }> {
  await page.evaluate(
    ([from, to]) => {
      const least = { light: 1000, pictures: 0 };
      Object.assign(globalThis, { least });
      const player = document.querySelector("structgstream-player") as StructgstreamPlayer;
      const small = document.createElement("canvas").getContext("2d", { willReadFrequently: true })!;
      // Right after it was drawn: a browser clears what it has shown.
      player.on("drawn", ({ stats }) => {
        if (stats.frameIndex! < from || stats.frameIndex! > to) return;
        small.drawImage(player.shadowRoot!.querySelector("canvas")!, 0, 0, 16, 16);
        const { data } = small.getImageData(0, 0, 16, 16);
        const light = data.reduce((sum, value, i) => sum + (i % 4 === 3 ? 0 : value), 0) / 768;
        least.light = Math.min(least.light, light);
        least.pictures++;
      });
      player.seek((from - 1) / 5);
      player.playbackRate = 0.25;
      player.play();
    },
    [first, last] as const,
  );
  await ended(page, 50_000);
  return (await page.evaluate("least")) as { light: number; pictures: number };
}

/** Waits until the picture shows this frame, of this moment's camera. */
export async function shows(page: Page, frame: number): Promise<void> {
  await page.waitForFunction(
    (wanted) => {
      const player = document.querySelector("structgstream-player") as StructgstreamPlayer | null;
      return player?.stats?.frameIndex === wanted && player.stats.settled;
    },
    frame,
    { timeout: 20_000 },
  );
}
