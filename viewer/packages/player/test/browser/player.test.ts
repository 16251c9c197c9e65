// SPDX-License-Identifier: Apache-2.0
/** The built player in a real browser. Skipped, with the reason, where there is none. */

import { readFileSync } from "node:fs";
import { readStream } from "@structgstream/core";
import type { Page } from "playwright-core";
import { afterAll, afterEach, beforeAll, describe, expect, test, vi } from "vitest";
import { chromiumPath } from "../../../gl/test/support/chromium.ts";
import { CLIP } from "../served.ts";
import { TestServer } from "./server.ts";
import { ask, type Opened, pageWith, Stage, shows } from "./stage.ts";

vi.setConfig({ testTimeout: 60_000, hookTimeout: 60_000 });

const executable = chromiumPath();
const PACKETS = readStream(CLIP).packets;
const LAST = PACKETS.length - 1;

describe.skipIf(!executable)("the player in a browser", () => {
  let stage: Stage;
  let opened: Opened | undefined;

  beforeAll(async () => {
    stage = await Stage.opened(executable!);
  });

  afterAll(() => stage?.close());

  afterEach(async () => {
    await opened?.page.context().close();
    opened = undefined;
    stage.server.put("/clip.sgs", CLIP);
  });

  async function open(...given: Parameters<Stage["open"]>): Promise<Page> {
    opened = await stage.open(...given);
    return opened.page;
  }

  /** Everything went without a complaint, but for those that a test expects. */
  function expectQuiet(...expected: RegExp[]): void {
    const left = opened!.complaints.filter((text) => !expected.some((one) => one.test(text)));
    expect(left).toEqual([]);
  }

  async function told(page: Page): Promise<string[]> {
    return ask(page, (_, events) => events.filter(([name]) => name === "error").map(([, message]) => message));
  }

  test("shows the first frame, plays to the end and again", async () => {
    const page = await open();
    await shows(page, 0);
    expect(stage.server.rangesOf("/clip.sgs")).toEqual([
      [0, 4096],
      [CLIP.length - 4096, CLIP.length],
      [4096, PACKETS[0]!.offset + PACKETS[0]!.bytes],
    ]);
    expect(await ask(page, (player) => [player.duration.toFixed(3), player.paused, player.cameras.length])).toEqual([
      "0.400",
      true,
      10,
    ]);
    // Software GL may be slower than the clip: at a tenth of its speed every frame has its time.
    await ask(page, (player) => {
      player.playbackRate = 0.1;
      player.play();
    });
    await page.waitForFunction(() => heard.told.some(([name]) => name === "ended"), undefined, { timeout: 30_000 });
    await shows(page, LAST);
    const frames = await ask(page, (_, __, shown) => shown);
    expect(frames).toEqual([...frames].sort((a, b) => a - b));
    expect(frames.length).toBeGreaterThan(LAST / 2);
    await page.getByRole("button", { name: "Play again" }).first().click();
    await page.waitForFunction(() => heard.frames.at(-1)! < 4);
    expectQuiet();
  });

  test("has the events, properties, poster, slots and parts of a video", async () => {
    stage.server.put("/poster.svg", new TextEncoder().encode('<svg xmlns="http://www.w3.org/2000/svg"/>'), {
      type: "image/svg+xml",
    });
    const page = await open('src="clip.sgs" poster="poster.svg"');
    await page.addStyleTag({ content: "structgstream-player::part(controls) { opacity: 0.5; transition: none }" });
    await page.evaluate(() => {
      const names =
        "loadstart durationchange loadedmetadata loadeddata canplay play playing pause seeking seeked ratechange ended";
      const player = document.querySelector("structgstream-player")!;
      const media: string[] = [];
      Object.assign(window, { media });
      for (const name of names.split(" ")) player.addEventListener(name, () => media.push(name));
      player.insertAdjacentHTML("beforeend", '<p id="own">Own</p><button slot="controls" id="mine">Mine</button>');
      player.src = "clip.sgs?again";
    });
    const media = () => page.evaluate(() => (window as unknown as { media: string[] }).media.splice(0));
    const happened = (name: string) =>
      page.waitForFunction((wanted) => (window as unknown as { media: string[] }).media.includes(wanted), name);
    await happened("canplay");
    expect(await media()).toEqual(["loadstart", "durationchange", "loadedmetadata", "loadeddata", "canplay"]);
    expect(
      await ask(page, (player) => [
        player.readyState,
        player.seekable.length,
        player.seekable.end(0).toFixed(1),
        player.ended,
        player.error,
        player.currentSrc.split("/").at(-1)!,
        (player.shadowRoot!.querySelector(".poster") as HTMLElement).hidden,
      ]),
    ).toEqual([4, 1, "0.4", false, null, "clip.sgs?again", true]);
    await ask(page, (player) => {
      player.currentTime = 0.2;
    });
    await happened("seeked");
    expect(await media()).toEqual(["seeking", "seeked"]);
    await ask(page, async (player) => {
      player.playbackRate = 0.5;
      await player.play();
    });
    await happened("ended");
    const ending = await media();
    expect(ending.slice(0, 3)).toEqual(["ratechange", "play", "playing"]);
    expect(ending.slice(-2)).toEqual(["pause", "ended"]);
    for (const own of ["#own", "#mine"]) expect(await page.locator(own).isVisible()).toBe(true);
    expect(await ask(page, (player) => getComputedStyle(player.shadowRoot!.querySelector(".bar")!).opacity)).toBe(
      "0.5",
    );
    expectQuiet();
  });

  test("seeks back and forth over groups, asking for what is missing only", async () => {
    const page = await open();
    await shows(page, 0);
    stage.server.requests.length = 0;
    for (const index of [7, 1, 11, 7, 0]) {
      await ask(page, new Function("player", `player.seek(${PACKETS[index]!.ptsSeconds})`) as never);
      await shows(page, index);
    }
    expect(stage.server.rangesOf("/clip.sgs")).toEqual([
      [PACKETS[6]!.offset, PACKETS[8]!.offset],
      [PACKETS[1]!.offset, PACKETS[2]!.offset],
      [PACKETS[9]!.offset, PACKETS[LAST]!.offset + PACKETS[LAST]!.bytes],
    ]);
    expectQuiet();
  });

  test("follows a growing file and says when the next frame may come", async () => {
    const cut = (frames: number) => CLIP.subarray(0, PACKETS[frames - 1]!.offset + PACKETS[frames - 1]!.bytes);
    stage.server.put("/clip.sgs", cut(1), { changed: new Date() });
    const page = await open('src="clip.sgs" autoplay');
    await shows(page, 0);
    await page.getByText("Frame 0, the next is awaited").waitFor();
    for (const frames of [2, 3, 4]) {
      stage.server.put("/clip.sgs", cut(frames), { changed: new Date() });
      await shows(page, frames - 1);
    }
    await page.getByText(/Frame 3, next in about \d+ s/).waitFor();
    stage.server.put("/clip.sgs", CLIP, { changed: new Date() });
    await page.waitForFunction(() => heard.told.some(([name]) => name === "ended"), undefined, { timeout: 30_000 });
    await shows(page, LAST);
    expect(await told(page)).toEqual([]);
    expectQuiet();
  });

  test("says that a stream ends within its header, and begins when the rest has come", async () => {
    const header = CLIP.subarray(0, Math.floor(PACKETS[0]!.offset / 2));
    stage.server.put("/clip.sgs", header, { changed: new Date() });
    const page = await open();
    await page.getByText("the stream ends within its header").waitFor();
    stage.server.put("/clip.sgs", CLIP, { changed: new Date() });
    await shows(page, 0);
    stage.server.put("/old.sgs", header);
    await ask(page, (player) => player.load("old.sgs"));
    await page.getByRole("alert").getByText("old.sgs").waitFor();
    expectQuiet();
  });

  test("says one thing after the other: what a link wanted, and that there are no ranges", async () => {
    stage.server.put("/clip.sgs", CLIP, { ranges: false });
    const page = await open('src="clip.sgs"', "?t=never");
    await page.getByText('The link\'s "t" was not taken').waitFor();
    await page.getByText("does not support range requests").waitFor();
    await page.getByRole("button", { name: "Close" }).click();
    await shows(page, 0);
    expectQuiet();
  });

  test("plays a cut stream up to the cut, and a damaged one around the damage", async () => {
    stage.server.put("/clip.sgs", CLIP.subarray(0, PACKETS[5]!.offset + 9));
    const page = await open('src="clip.sgs" autoplay');
    await page.waitForFunction(() => heard.told.some(([name]) => name === "ended"));
    await shows(page, 4);
    const flipped = CLIP.slice();
    flipped[PACKETS[4]!.offset + 40]! ^= 16;
    stage.server.put("/flipped.sgs", flipped);
    await ask(page, (player) => {
      heard.told.length = 0;
      player.setAttribute("src", "flipped.sgs");
    });
    await page.waitForFunction(() => heard.told.some(([name]) => name === "ended"));
    await shows(page, LAST);
    expect(await told(page)).toEqual([`Frames 4 to 5 are lost: its record at byte ${PACKETS[4]!.offset} is damaged.`]);
    expectQuiet();
  });

  test("reads whole from a server without ranges, and says so", async () => {
    stage.server.put("/clip.sgs", CLIP, { ranges: false });
    const page = await open();
    await shows(page, 0);
    await page.getByText("does not support range requests").waitFor();
    await ask(page, (player) => player.seek(0.3));
    await shows(page, 9);
    expect(stage.server.rangesOf("/clip.sgs").length).toBe(1);
    expectQuiet();
  });

  // The server is what is slow: Chromium refuses to throttle what workers fetch ("Not supported"). What follows the first
  // picture takes it 1.5 s, of which 0.4 s are played.
  test("waits on a slow network, and goes on", async () => {
    stage.server.put("/clip.sgs", CLIP, { bytesPerSecond: 5_000 });
    const page = await open('src="clip.sgs" autoplay');
    await page.getByRole("progressbar").waitFor();
    await page.waitForFunction(() => heard.told.some(([name]) => name === "ended"), undefined, { timeout: 40_000 });
    await shows(page, LAST);
    expect(await ask(page, (_, events) => events.filter(([name]) => name === "stall").length)).toBeGreaterThan(0);
    expect(await told(page)).toEqual([]);
    expectQuiet();
  });

  test("what it tells is dispatched as events of the DOM, as a video's are", async () => {
    const page = await open("isolated");
    const heard = await ask(
      page,
      (player) =>
        new Promise<unknown>((resolve) => {
          const listen = (event: Event) =>
            resolve([event.type, event.bubbles, event.target === player, (event as CustomEvent).detail]);
          player.addEventListener("error", listen, { once: true });
          player.load(new Blob(["no stream"]));
        }),
    );
    expect(heard).toEqual(["error", false, true, { message: expect.stringMatching(/\.$/), fatal: true }]);
    expectQuiet();
  });

  test("damaged streams come to an end: a picture or a sentence", async () => {
    const page = await open("isolated");
    const vector = readFileSync(new URL("../../../../../tests/vectors/version-2-compact.sgs", import.meta.url));
    const outcomes = await ask(
      page,
      new Function(
        "player",
        `return (async () => {
          const whole = Uint8Array.from(atob("${vector.toString("base64")}"), (letter) => letter.charCodeAt(0));
          const found = { pictures: 0, sentences: 0, neither: 0 };
          const played = async (bytes) => {
            let fatal = false;
            const off = player.on("error", (error) => { fatal ||= error.fatal; });
            let ended = false;
            const offEnd = player.on("ended", () => { ended = true; });
            player.load(new Blob([bytes]));
            player.play();
            for (let i = 0; i < 400 && !fatal && !ended; i++) await new Promise((resolve) => setTimeout(resolve, 10));
            off(); offEnd();
            found[ended ? "pictures" : fatal ? "sentences" : "neither"]++;
          };
          for (let at = 3; at < whole.length; at += 787) {
            const flipped = whole.slice();
            flipped[at] ^= 1 << (at & 7);
            await played(flipped);
            await played(whole.slice(0, at));
          }
          return found;
        })()`,
      ) as never,
    );
    const { pictures, sentences, neither } = outcomes as unknown as Record<string, number>;
    expect(pictures).toBeGreaterThan(0);
    expect(sentences).toBeGreaterThan(0);
    expect(neither).toBe(0);
    expectQuiet();
  });

  test.each([
    [404, "clip.sgs was not found on the server (404). Check the address."],
    [403, "The server refuses clip.sgs to this page (403)."],
  ])("says what status %i means", async (status, sentence) => {
    stage.server.put("/clip.sgs", "", { status });
    const page = await open();
    await page.getByRole("alert").getByText(sentence).waitFor();
    expectQuiet(new RegExp(`${status}`));
  });

  test("says what is wrong with another version, another file, and another origin", async () => {
    const newer = CLIP.slice();
    newer[8] = 7;
    stage.server.put("/newer.sgs", newer);
    stage.server.put("/page.sgs", "<html>");
    const elsewhere = await TestServer.started();
    try {
      elsewhere.put("/clip.sgs", CLIP);
      elsewhere.put("/open.sgs", CLIP, { cors: true });
      const page = await open('src="newer.sgs"');
      await page.getByText("has format version 7.0; this program reads 2.x. Use a newer one.").waitFor();
      const load = (address: string) =>
        ask(page, new Function("player", `player.load(${JSON.stringify(address)})`) as never);
      await load("page.sgs");
      await page.getByText("its first bytes are not the format's signature").waitFor();
      await load(`${elsewhere.origin}/clip.sgs`);
      await page.getByText("does not allow this page to read it").waitFor();
      await load(`${elsewhere.origin}/open.sgs`);
      await shows(page, 0);
      expectQuiet(/CORS|ERR_FAILED/);
    } finally {
      await elsewhere.stop();
    }
  });

  test("says that there is no WebGL2", async () => {
    opened = await stage.open('src="clip.sgs"');
    const { page } = opened;
    await page.addInitScript(() => {
      HTMLCanvasElement.prototype.getContext = () => null;
    });
    await page.reload();
    await page.getByRole("alert").getByText(/WebGL/).waitFor();
    expectQuiet();
  });

  test("survives a lost context", async () => {
    const page = await open();
    await shows(page, 0);
    const picture = () =>
      ask(page, async (player) => [...new Uint8Array(await (await player.screenshot()).arrayBuffer())]);
    const before = await picture();
    await ask(page, async (player) => {
      const gl = player.shadowRoot!.querySelector("canvas")!.getContext("webgl2")!;
      const loss = gl.getExtension("WEBGL_lose_context")!;
      loss.loseContext();
      await new Promise((resolve) => setTimeout(resolve, 300));
      loss.restoreContext();
      await new Promise((resolve) => setTimeout(resolve, 500));
    });
    await ask(page, (player) => player.seek(0.2));
    await shows(page, 6);
    await ask(page, (player) => player.seek(0));
    await shows(page, 0);
    expect(await picture()).toEqual(before);
    expect(await told(page)).toEqual([]);
    expectQuiet(/CONTEXT_LOST/);
  });

  test("follows the size of its element", async () => {
    const page = await open();
    await shows(page, 0);
    const size = () => ask(page, (player) => [player.camera!.width, player.camera!.height]);
    expect(await size()).toEqual([320, 240]);
    await page.setViewportSize({ width: 180, height: 300 });
    await page.waitForFunction(
      () => document.querySelector("structgstream-player")!.shadowRoot!.querySelector("canvas")!.width === 180,
    );
    expect(await size()).toEqual([180, 300]);
    expectQuiet();
  });

  test("keyboard, mouse and wheel", async () => {
    const page = await open();
    await shows(page, 0);
    const eye = () => ask(page, (player) => [...player.camera!.viewmat]);
    const still = await eye();
    await page.locator(".stage").focus();
    await page.keyboard.press(".");
    await shows(page, 1);
    await page.keyboard.press("End");
    await shows(page, LAST);
    await page.keyboard.press("Home");
    await shows(page, 0);
    await page.keyboard.press("Space");
    expect(await ask(page, (player) => player.paused)).toBe(false);
    await page.keyboard.press("k");
    expect(await ask(page, (player) => player.paused)).toBe(true);
    expect(await eye()).toEqual(still);
    const places: number[][] = [still];
    const moved = async (act: () => Promise<void>) => {
      await act();
      await expect.poll(async () => places.map(String).includes(String(await eye()))).toBe(false);
      await page.waitForTimeout(100);
      places.push(await eye());
    };
    await moved(() => page.keyboard.press("Shift+ArrowLeft"));
    await moved(() => page.keyboard.press("+"));
    await moved(() => page.keyboard.down("w")); // a picture may take longer than any press
    await page.keyboard.up("w");
    await page.waitForTimeout(100);
    places.push(await eye());
    await moved(async () => {
      await page.mouse.move(100, 100);
      await page.mouse.down();
      await page.mouse.move(140, 110, { steps: 4 });
      await page.mouse.up();
    });
    await moved(async () => {
      await page.mouse.move(100, 100);
      await page.mouse.down({ button: "right" });
      await page.mouse.move(120, 130, { steps: 4 });
      await page.mouse.up({ button: "right" });
    });
    await moved(() => page.mouse.wheel(0, 200));
    expect(await ask(page, (player) => player.paused)).toBe(true);
    expectQuiet();
  });

  test("who comes closer does not push the capture's near plane along", async () => {
    const page = await open();
    await shows(page, 0);
    const near = () => ask(page, (player) => player.camera!.near);
    const header = readStream(CLIP).header!;
    const capture = header.cameras[0]!.near * header.similarity.scale;
    expect(await near()).toBeCloseTo(capture, 6);
    await page.locator(".stage").focus();
    for (let i = 0; i < 12; i++) await page.keyboard.press("+");
    await expect.poll(near).toBeLessThan(0.02 * capture);
    await shows(page, 0);
    expectQuiet();
  });

  test("touch: one finger turns, two come closer, a tap plays", async () => {
    const page = await open('src="clip.sgs"', "", { hasTouch: true, isMobile: true });
    await shows(page, 0);
    const eye = () => ask(page, (player) => [...player.camera!.viewmat]);
    const client = await page.context().newCDPSession(page);
    const touch = (type: string, ...points: [number, number][]) =>
      client.send("Input.dispatchTouchEvent", {
        type: type as "touchStart",
        touchPoints: points.map(([x, y], id) => ({ x, y, id })),
      });
    const first = await eye();
    await touch("touchStart", [100, 80]);
    for (const x of [110, 125, 140]) await touch("touchMove", [x, 85]);
    await touch("touchEnd");
    await page.waitForTimeout(100);
    const turned = await eye();
    expect(turned).not.toEqual(first);
    await touch("touchStart", [140, 80], [180, 80]);
    for (const apart of [30, 45, 60]) await touch("touchMove", [160 - apart, 80], [160 + apart, 80]);
    await touch("touchEnd");
    await page.waitForTimeout(100);
    expect(await eye()).not.toEqual(turned);
    await touch("touchStart", [150, 40]);
    await touch("touchEnd");
    await page.waitForFunction(() => !document.querySelector("structgstream-player")!.paused);
    expectQuiet();
  });

  test("the rig's cameras: list, keys, frusta", async () => {
    const page = await open('src="clip.sgs"', "", { viewport: { width: 640, height: 400 }, reducedMotion: "reduce" });
    await shows(page, 0);
    await page.getByRole("button", { name: "Cameras" }).click();
    await page.getByRole("button", { name: "cam03", exact: true }).click();
    const matrices = readStream(CLIP).header!.cameras.map(({ viewmat }) => viewmat);
    const expectAt = async (index: number) => {
      const found = await ask(page, (player) => [...player.camera!.viewmat]);
      for (const at of [0, 1, 2, 4, 5, 6, 8, 9, 10]) expect(found[at]).toBeCloseTo(matrices[index]![at]!, 5);
    };
    await expectAt(3);
    await page.getByRole("button", { name: "Close" }).first().click();
    await page.locator(".stage").focus();
    await page.keyboard.press("c");
    await expectAt(4);
    await page.keyboard.press("g");
    await page.keyboard.press("-");
    await page.keyboard.press("-");
    await page.waitForTimeout(300);
    const frusta = page.locator(".frustum:not([hidden])");
    expect(await frusta.count()).toBeGreaterThan(0);
    await page.keyboard.press("r");
    await page.getByRole("button", { name: "Cameras" }).click();
    expect(await page.locator(".list [aria-current]").count()).toBe(1);
    expectQuiet();
  });

  test("flies smoothly unless motion is to be reduced", async () => {
    const page = await open();
    await shows(page, 0);
    const places = await ask(page, async (player) => {
      player.show("cam07", 6); // Seconds: a browser that draws in software shows few pictures of a short flight.
      const found: number[] = [];
      for (let i = 0; i < 90; i++) {
        await new Promise((resolve) => setTimeout(resolve, 200));
        found.push(player.camera!.viewmat[3]!);
        const [place, ...before] = found.slice(-6).reverse();
        if (i >= 30 && before.every((other) => other === place)) break;
      }
      return found;
    });
    expect(new Set(places).size).toBeGreaterThan(2);
    expect(places.at(-1)).toBe(places.at(-2));
    expectQuiet();
  });

  describe("links", () => {
    test("lead to the very view and time", async () => {
      const page = await open('src="clip.sgs"', "", {
        permissions: ["clipboard-read", "clipboard-write"],
        viewport: { width: 800, height: 400 },
      });
      await shows(page, 0);
      await page.locator(".stage").focus();
      await page.keyboard.press("Shift+ArrowLeft");
      await ask(page, (player) => player.seek(0.2));
      await shows(page, 6);
      const first = await page.locator("canvas").first().screenshot();
      await page.getByRole("button", { name: /Copy a link/ }).click();
      await page.getByText("is copied").waitFor();
      const link = await page.evaluate(() => navigator.clipboard.readText());
      expect(new URL(link).searchParams.get("t")).toBe("0.2");
      const query = new URL(link).search;
      await opened!.page.context().close();
      const again = await open('src="other.sgs"', query, { viewport: { width: 800, height: 400 } });
      await shows(again, 6);
      await again.waitForTimeout(300);
      const second = await again.locator("canvas").first().screenshot();
      expect(Math.abs(first.length - second.length) / first.length).toBeLessThan(0.02);
      const near = await ask(again, (player) => [...player.camera!.viewmat]);
      expect(near.every(Number.isFinite)).toBe(true);
      expectQuiet();
    });

    // Which addresses and numbers are refused: view.test.ts. Here, that what is refused has no effect on a page.
    test.each([["src=https://example.org/x.sgs"], ["view=<img src=x onerror=alert(1)>&t=0x10&embed=2&__proto__=1"]])(
      "that are hostile do nothing: %s",
      async (query) => {
        const page = await open('src="clip.sgs"', `?${query.replaceAll("<", "%3C")}`);
        const others: string[] = [];
        page.on("request", (request) => {
          if (!request.url().startsWith(stage.server.origin) && /^https?:/.test(request.url()))
            others.push(request.url());
        });
        await shows(page, 0);
        const matrix = await ask(page, (player) => [...player.camera!.viewmat]);
        expect(matrix.every(Number.isFinite)).toBe(true);
        expect(others).toEqual([]);
        await page
          .getByText(/was not taken/)
          .first()
          .waitFor();
        expectQuiet();
      },
    );

    test("cannot be led away by a redirection", async () => {
      const elsewhere = await TestServer.started();
      try {
        elsewhere.put("/clip.sgs", CLIP, { cors: true });
        stage.server.put("/away.sgs", "", { status: 302, location: `${elsewhere.origin}/clip.sgs` });
        const page = await open('src="clip.sgs"', "?src=away.sgs");
        await page.getByRole("alert").waitFor();
        expect(elsewhere.requests).toEqual([]);
        expectQuiet(/ERR_FAILED|redirect|CORS/i);
      } finally {
        await elsewhere.stop();
      }
    });

    test("mean nothing to an isolated player, and few controls with embed=1", async () => {
      const isolated = await open('src="clip.sgs" isolated', "?src=other.sgs&t=0.3");
      await shows(isolated, 0);
      await isolated.context().close();
      const page = await open('src="clip.sgs"', "?embed=1&t=0.3");
      await shows(page, 9);
      expect(await page.getByRole("button", { name: "Cameras" }).isVisible()).toBe(false);
      expect(await page.getByRole("button", { name: "Play", exact: true }).first().isVisible()).toBe(true);
      expectQuiet();
    });
  });

  test("a stream inside the page, and files that are dropped", async () => {
    const base64 = Buffer.from(CLIP).toString("base64");
    const embedded = `<script type="application/octet-stream;base64" id="stream">${base64}</script>`;
    const page = await open('src="#stream"');
    stage.server.put("/page.html", embedded + pageWith('src="#stream"'), { type: "text/html" });
    await page.reload();
    await shows(page, 0);
    await ask(page, (player) => player.seek(0.3));
    await shows(page, 9);
    expect(stage.server.rangesOf("/clip.sgs")).toEqual([]);
    const said = await page.evaluate(async () => {
      const other = document.createElement("structgstream-player");
      other.setAttribute("src", "#stream");
      document.body.append(other);
      const text = () => other.shadowRoot!.querySelector("progress + p")?.textContent;
      while (!text()) await Promise.resolve();
      const first = text();
      other.remove();
      return first;
    });
    expect(said).toBe("Opening the page's stream");
    await page.evaluate(async (text) => {
      const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
      const transfer = new DataTransfer();
      transfer.items.add(new File([bytes], "mine.sgs"));
      const stage = document.querySelector("structgstream-player")!.shadowRoot!.querySelector(".stage")!;
      stage.dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, bubbles: true, cancelable: true }));
    }, base64);
    await shows(page, 0);
    await page.getByRole("button", { name: "Play", exact: true }).first().click();
    await page.waitForFunction(() => heard.told.some(([name]) => name === "ended"));
    expectQuiet();
  });

  test("a screenshot is a picture of what is shown", async () => {
    const page = await open();
    await shows(page, 0);
    const size = await ask(page, async (player) => {
      const bitmap = await createImageBitmap(await player.screenshot());
      return [bitmap.width, bitmap.height];
    });
    expect(size).toEqual([320, 240]);
    expectQuiet();
  });

  test("comparison with a camera's own picture", async () => {
    const red = Buffer.from(
      "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGP4z8AAAAMBAQDJ/pLvAAAAAElFTkSuQmCC",
      "base64",
    );
    stage.server.put("/truth.json", JSON.stringify(["cam02"]), { type: "application/json" });
    stage.server.put("/truth/cam02/0.jpg", red, { type: "image/png" });
    stage.server.put("/truth/cam02/6.jpg", red, { type: "image/png" });
    const page = await open('src="clip.sgs" truth="truth.json"', "", { reducedMotion: "reduce" });
    await shows(page, 0);
    await page.getByRole("button", { name: /^Compare/ }).click();
    const slider = page.getByRole("slider", { name: /picture ends/ });
    await slider.waitFor();
    await slider.focus();
    await page.keyboard.press("ArrowLeft");
    expect(await slider.getAttribute("aria-valuenow")).toBe("48");
    await ask(page, (player) => player.seek(0.2));
    await shows(page, 6);
    await expect.poll(() => stage.server.requests.map(({ path }) => path)).toContain("/truth/cam02/6.jpg");
    await page.locator(".stage").focus();
    await page.keyboard.press("-");
    await slider.waitFor({ state: "hidden" });
    expectQuiet();
  });

  test("an element that is removed while it loads leaves nothing behind", async () => {
    stage.server.put("/clip.sgs", CLIP, { bytesPerSecond: 20_000 });
    const page = await open();
    await page.waitForTimeout(300);
    await page.evaluate(() => document.querySelector("structgstream-player")!.remove());
    await expect.poll(() => page.workers().length).toBe(0);
    stage.server.put("/clip.sgs", CLIP);
    await page.evaluate(() => {
      const again = document.createElement("structgstream-player");
      again.setAttribute("src", "clip.sgs");
      again.style.cssText = "width:100%;height:100%;aspect-ratio:auto";
      document.body.append(again);
    });
    await shows(page, 0);
    await page.evaluate(() => document.querySelector("structgstream-player")!.destroy());
    await expect.poll(() => page.workers().length).toBe(0);
    expectQuiet();
  });

  test("150 frames take no more memory than 50, nor workers, nor textures", async () => {
    // Few anchors: software GL shows many pictures of them in a second.
    stage.server.put("/few.sgs", readFileSync(new URL("../../../core/test/fixtures/paper.sgs", import.meta.url)));
    const page = await open('src="few.sgs" loop autoplay controls="off"', "", {
      viewport: { width: 160, height: 120 },
    });
    const client = await page.context().newCDPSession(page);
    const state = async () => {
      await client.send("HeapProfiler.collectGarbage");
      const { usedSize } = await client.send("Runtime.getHeapUsage");
      const counts = await ask(page, (player) => player.resources);
      return { usedSize, workers: page.workers().length, ...counts };
    };
    const reach = (count: number) =>
      page.waitForFunction((wanted) => heard.frames.length >= wanted, count, { timeout: 55_000, polling: 200 });
    await reach(50);
    const before = await state();
    await reach(150);
    const after = await state();
    expect({ ...after, usedSize: 0 }).toEqual({ ...before, usedSize: 0 });
    expect(after.usedSize).toBeLessThan(before.usedSize * 1.1 + 2e5);
    expectQuiet();
  });
});
