// SPDX-License-Identifier: Apache-2.0
/** The built player in a real browser: streams, servers and what it says of them. Skipped where there is none. */

import { readStream } from "@structgstream/core";
import { describe, expect, test, vi } from "vitest";
import { TestServer } from "../../../gl/test/support/server.ts";
import type { StructgstreamPlayer } from "../../src/element.ts";
import { CLIP } from "../served.ts";
import { ask, ended, pageWith, reported, StagedTests, shows } from "./stage.ts";

vi.setConfig({ testTimeout: 60_000, hookTimeout: 60_000 });

const PACKETS = readStream(CLIP).packets;
const LAST = PACKETS.length - 1;

describe.skipIf(StagedTests.skipped)("the player in a browser", () => {
  const stage = new StagedTests();

  test("shows the first frame, plays to the end and again", async () => {
    const page = await stage.open();
    await shows(page, 0);
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
    await ended(page);
    await shows(page, LAST);
    const frames = await ask(page, (_, __, shown) => shown);
    expect(frames).toEqual([...frames].sort((a, b) => a - b));
    expect(frames.length).toBeGreaterThan(LAST / 2);
    await page.getByRole("button", { name: "Play again" }).first().click();
    await page.waitForFunction(() => heard.frames.at(-1)! < 4);
  });

  test("has the events, properties, poster, slots and parts of a video", async () => {
    stage.server.put("/poster.svg", new TextEncoder().encode('<svg xmlns="http://www.w3.org/2000/svg"/>'), {
      type: "image/svg+xml",
    });
    const page = await stage.open('src="clip.sgs" poster="poster.svg"');
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
  });

  test("what a page asks for before the module runs, or before the element is in the page, holds", async () => {
    const page = await stage.open("");
    const asked = () => {
      const player = document.querySelector("structgstream-player") ?? document.createElement("structgstream-player");
      Object.assign(player, { src: "clip.sgs", muted: true, playbackRate: 0.0625, loop: true, volume: 0.3 });
      Object.assign(player, { currentTime: 0.2 });
      return player;
    };
    const early = pageWith("").replace("<script>", `<script>(${asked})();`);
    stage.server.put("/page.html", early, { type: "text/html" });
    await page.reload();
    await shows(page, 6);
    const held = () => ask(page, (one) => [one.src, one.muted, one.playbackRate, one.loop, one.volume, one.paused]);
    expect(await held()).toEqual(["clip.sgs", true, 0.0625, true, 0.3, true]);
    // The time at once: the clip is short and begins again.
    const from = await page.evaluate(async (text) => {
      document.querySelector("structgstream-player")!.remove();
      const player = new Function(`return (${text})()`)() as StructgstreamPlayer;
      const playing = player.play();
      document.body.append(player);
      await playing;
      return player.currentTime;
    }, String(asked));
    expect(from).toBeGreaterThanOrEqual(0.2);
    expect(await held()).toEqual(["clip.sgs", true, 0.0625, true, 0.3, false]);
    await page.evaluate(() => {
      const player = document.querySelector("structgstream-player")!;
      player.remove();
      return Promise.resolve().then(() => document.body.append(player));
    });
    await ask(page, (player) => player.play());
    expect(await held()).toEqual(["clip.sgs", true, 0.0625, true, 0.3, false]);
  });

  test("follows a growing file and says when the next frame may come", async () => {
    const cut = (frames: number) => CLIP.subarray(0, PACKETS[frames - 1]!.offset + PACKETS[frames - 1]!.bytes);
    stage.server.put("/clip.sgs", cut(1), { changed: new Date() });
    const page = await stage.open('src="clip.sgs" autoplay');
    await shows(page, 0);
    await page.getByText("Frame 0, the next is awaited").waitFor();
    for (const frames of [2, 3, 4]) {
      stage.server.put("/clip.sgs", cut(frames), { changed: new Date() });
      await shows(page, frames - 1);
    }
    await page.getByText(/Frame 3, next in about \d+ s/).waitFor();
    stage.server.put("/clip.sgs", CLIP, { changed: new Date() });
    await ended(page);
    await shows(page, LAST);
    expect(await reported(page)).toEqual([]);
  });

  test("says that a stream ends within its header, and begins when the rest has come", async () => {
    const header = CLIP.subarray(0, Math.floor(PACKETS[0]!.offset / 2));
    stage.server.put("/clip.sgs", header, { changed: new Date() });
    const page = await stage.open();
    await page.getByText("the stream ends within its header").waitFor();
    stage.server.put("/clip.sgs", CLIP, { changed: new Date() });
    await shows(page, 0);
    stage.server.put("/old.sgs", header);
    await ask(page, (player) => player.load("old.sgs"));
    await page.getByRole("alert").getByText("old.sgs").waitFor();
  });

  test("reads whole from a server without ranges, and says so after what a link wanted", async () => {
    stage.server.put("/clip.sgs", CLIP, { ranges: false });
    const page = await stage.open('src="clip.sgs"', "?t=never");
    await page.getByText('The link\'s "t" was not taken').waitFor();
    await page.getByText("does not support range requests").waitFor();
    await page.getByRole("button", { name: "Close" }).click();
    await shows(page, 0);
    await ask(page, (player) => player.seek(0.3));
    await shows(page, 9);
    expect(stage.server.rangesOf("/clip.sgs").length).toBe(1);
  });

  // The server is what is slow: Chromium refuses to throttle what workers fetch ("Not supported").
  test("waits on a slow network, and goes on", async () => {
    const file = stage.server.put("/clip.sgs", CLIP, { held: [PACKETS[0]!.offset - 2_500, CLIP.length] });
    const page = await stage.open('src="clip.sgs" autoplay');
    await page.getByRole("progressbar").waitFor();
    // The rest of the header, the index at the end and the first picture come, and nothing that follows it.
    file.held = [PACKETS[1]!.offset, CLIP.length - 4_096];
    await shows(page, 0);
    const stalls = () => ask(page, (_, events) => events.filter(([name]) => name === "stall").length);
    await vi.waitUntil(stalls, { timeout: 20_000 });
    // What is left takes 4.5 s, of which 0.4 s are played.
    file.bytesPerSecond = 2_500;
    file.held = undefined;
    await ended(page, 40_000);
    await shows(page, LAST);
    expect(await stalls()).toBeGreaterThan(0);
    expect(await reported(page)).toEqual([]);
  });

  test("its events are DOM events, as a video's are", async () => {
    const page = await stage.open("isolated");
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
      const page = await stage.open('src="newer.sgs"');
      await page.getByText("has format version 7.0; this program reads 2.x. Use a newer one.").waitFor();
      const load = (address: string) =>
        ask(page, new Function("player", `player.load(${JSON.stringify(address)})`) as never);
      await load("page.sgs");
      await page.getByText("its first bytes are not the format's signature").waitFor();
      await load(`${elsewhere.origin}/clip.sgs`);
      await page.getByText("does not allow this page to read it").waitFor();
      await load(`${elsewhere.origin}/open.sgs`);
      await shows(page, 0);
      stage.expectComplaints(/CORS|ERR_FAILED/);
    } finally {
      await elsewhere.stop();
    }
  });

  test("says that there is no WebGL2", async () => {
    const page = await stage.open('src="clip.sgs"', "", {});
    await page.addInitScript(() => {
      HTMLCanvasElement.prototype.getContext = () => null;
    });
    await page.reload();
    await page.getByRole("alert").getByText(/WebGL/).waitFor();
  });

  test("survives a lost context", async () => {
    const page = await stage.open();
    await shows(page, 0);
    const picture = () =>
      ask(page, async (player) => [...new Uint8Array(await (await player.screenshot()).arrayBuffer())]);
    const before = await picture();
    await ask(page, async (player) => {
      const gl = player.shadowRoot!.querySelector("canvas")!.getContext("webgl2")!;
      const loss = gl.getExtension("WEBGL_lose_context")!;
      const happened = (name: string) =>
        new Promise<void>((resolve) => gl.canvas.addEventListener(name, () => setTimeout(resolve), { once: true }));
      const lost = happened("webglcontextlost");
      loss.loseContext();
      await lost;
      await new Promise((resolve) => player.addEventListener("error", resolve, { once: true }));
      const restored = happened("webglcontextrestored");
      loss.restoreContext();
      await restored;
    });
    await ask(page, (player) => player.seek(0.2));
    await shows(page, 6);
    await ask(page, (player) => player.seek(0));
    await shows(page, 0);
    expect(await picture()).toEqual(before);
    expect(await reported(page)).toEqual([expect.stringContaining("taken the graphics memory")]);
    stage.expectComplaints(/CONTEXT_LOST/);
  });

  test("a stream inside the page, and files that are dropped", async () => {
    const base64 = Buffer.from(CLIP).toString("base64");
    const embedded = `<script type="application/octet-stream;base64" id="stream">${base64}</script>`;
    const page = await stage.open('src="#stream"');
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
    await ended(page);
  });
});
