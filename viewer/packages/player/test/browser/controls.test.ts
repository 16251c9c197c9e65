// SPDX-License-Identifier: Apache-2.0
/** The built player in a real browser: its controls, cameras and links. Skipped where there is none. */

import { readFileSync } from "node:fs";
import { readStream } from "@structgstream/core";
import { describe, expect, test, vi } from "vitest";
import { TestServer } from "../../../gl/test/support/server.ts";
import { CLIP } from "../served.ts";
import { ask, StagedTests, shows } from "./stage.ts";

vi.setConfig({ testTimeout: 60_000, hookTimeout: 60_000 });

const PACKETS = readStream(CLIP).packets;
const LAST = PACKETS.length - 1;

describe.skipIf(StagedTests.skipped)("controls in a browser", () => {
  const stage = new StagedTests();

  test("follows the size of its element, as a screenshot does", async () => {
    const page = await stage.open();
    await shows(page, 0);
    const size = () => ask(page, (player) => [player.camera!.width, player.camera!.height]);
    expect(await size()).toEqual([320, 240]);
    const picture = await ask(page, async (player) => {
      const bitmap = await createImageBitmap(await player.screenshot());
      return [bitmap.width, bitmap.height];
    });
    expect(picture).toEqual([320, 240]);
    await page.setViewportSize({ width: 180, height: 300 });
    await page.waitForFunction(
      () => document.querySelector("structgstream-player")!.shadowRoot!.querySelector("canvas")!.width === 180,
    );
    expect(await size()).toEqual([180, 300]);
  });

  test("follows the zoom of the page, which does not change the element's size", async () => {
    const page = await stage.open();
    await shows(page, 0);
    const session = await page.context().newCDPSession(page);
    const canvas = () => ask(page, (player) => player.shadowRoot!.querySelector("canvas")!.width);
    for (const deviceScaleFactor of [2, 1]) {
      const size = { width: 320, height: 240, mobile: false };
      await session.send("Emulation.setDeviceMetricsOverride", { ...size, deviceScaleFactor });
      await expect.poll(canvas).toBe(320 * deviceScaleFactor);
    }
    await session.send("Emulation.clearDeviceMetricsOverride");
    await session.detach();
  });

  test("the time is read from left to right in a page that is not", async () => {
    const page = await stage.open('src="clip.sgs" dir="rtl"');
    await shows(page, 0);
    expect(await ask(page, (player) => getComputedStyle(player.shadowRoot!.querySelector(".time")!).direction)).toBe(
      "ltr",
    );
  });

  test("who closes a panel goes on where it was opened", async () => {
    const page = await stage.open();
    await shows(page, 0);
    const focused = () => ask(page, (player) => (player.shadowRoot!.activeElement as HTMLElement | null)?.title);
    await page.getByRole("button", { name: "Cameras" }).press("Enter");
    await page.getByRole("button", { name: "Close" }).press("Enter");
    expect(await focused()).toBe("Cameras");
    await page.locator(".stage").press("?");
    await page.getByRole("button", { name: "Close" }).press("Enter");
    expect(await ask(page, (player) => player.shadowRoot!.activeElement?.className)).toBe("stage");
    await page.keyboard.press("End");
    await shows(page, LAST);
  });

  test("keyboard, mouse and wheel", async () => {
    const page = await stage.open();
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
  });

  test("who comes closer does not push the capture's near plane along", async () => {
    const page = await stage.open();
    await shows(page, 0);
    const near = () => ask(page, (player) => player.camera!.near);
    const header = readStream(CLIP).header!;
    const capture = header.cameras[0]!.near * header.similarity.scale;
    expect(await near()).toBeCloseTo(capture, 6);
    await page.locator(".stage").focus();
    for (let i = 0; i < 12; i++) await page.keyboard.press("+");
    await expect.poll(near).toBeLessThan(0.02 * capture);
    await shows(page, 0);
  });

  test("touch: one finger turns, two come closer, a tap plays", async () => {
    const page = await stage.open('src="clip.sgs"', "", { hasTouch: true, isMobile: true });
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
    for (const half of [30, 45, 60]) await touch("touchMove", [160 - half, 80], [160 + half, 80]);
    await touch("touchEnd");
    await page.waitForTimeout(100);
    expect(await eye()).not.toEqual(turned);
    await touch("touchStart", [150, 40]);
    await touch("touchEnd");
    await page.waitForFunction(() => !document.querySelector("structgstream-player")!.paused);
  });

  test("the rig's cameras: list, keys, frusta", async () => {
    const page = await stage.open('src="clip.sgs"', "", {
      viewport: { width: 480, height: 300 },
      reducedMotion: "reduce",
    });
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
  });

  test("flies smoothly unless motion is to be reduced", async () => {
    const page = await stage.open();
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
  });

  describe("links", () => {
    test("lead to the very view and time", async () => {
      const page = await stage.open('src="clip.sgs"', "", {
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
      await stage.close();
      const again = await stage.open('src="other.sgs"', query, { viewport: { width: 800, height: 400 } });
      await shows(again, 6);
      await again.waitForTimeout(300);
      const second = await again.locator("canvas").first().screenshot();
      expect(Math.abs(first.length - second.length) / first.length).toBeLessThan(0.02);
      const near = await ask(again, (player) => [...player.camera!.viewmat]);
      expect(near.every(Number.isFinite)).toBe(true);
    });

    // Which addresses and numbers are refused: view.test.ts. Here, that what is refused has no effect on a page.
    test("that are hostile do nothing", async () => {
      const query = "src=https://example.org/x.sgs&view=%3Cimg src=x onerror=alert(1)>&t=0x10&embed=2&__proto__=1";
      const page = await stage.open('src="clip.sgs"', `?${query}`);
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
    });

    test("cannot be led away by a redirection", async () => {
      const elsewhere = await TestServer.started();
      try {
        elsewhere.put("/clip.sgs", CLIP, { cors: true });
        stage.server.put("/away.sgs", "", { status: 302, location: `${elsewhere.origin}/clip.sgs` });
        const page = await stage.open('src="clip.sgs"', "?src=away.sgs");
        await page.getByRole("alert").waitFor();
        expect(elsewhere.requests).toEqual([]);
        stage.expectComplaints(/ERR_FAILED|redirect|CORS/i);
      } finally {
        await elsewhere.stop();
      }
    });

    test("mean nothing to an isolated player, and few controls with embed=1", async () => {
      const isolated = await stage.open('src="clip.sgs" isolated', "?src=other.sgs&t=0.3");
      await shows(isolated, 0);
      await stage.close();
      const page = await stage.open('src="clip.sgs"', "?embed=1&t=0.3");
      await shows(page, 9);
      expect(await page.getByRole("button", { name: "Cameras" }).isVisible()).toBe(false);
      expect(await page.getByRole("button", { name: "Play", exact: true }).first().isVisible()).toBe(true);
    });
  });

  test("comparison with a camera's own picture", async () => {
    const red = Buffer.from(
      "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGP4z8AAAAMBAQDJ/pLvAAAAAElFTkSuQmCC",
      "base64",
    );
    stage.server.put("/truth.json", JSON.stringify(["cam02"]), { type: "application/json" });
    stage.server.put("/truth/cam02/0.jpg", red, { type: "image/png" });
    stage.server.put("/truth/cam02/6.jpg", red, { type: "image/png" });
    const page = await stage.open('src="clip.sgs" truth="truth.json"', "", { reducedMotion: "reduce" });
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
  });

  test("an element that is removed while it loads leaves nothing behind", async () => {
    stage.server.put("/clip.sgs", CLIP, { bytesPerSecond: 20_000 });
    const page = await stage.open();
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
  });

  test("150 frames take no more memory than 50, nor workers, nor textures", async () => {
    // Few anchors: software GL shows many pictures of them in a second.
    stage.server.put("/few.sgs", readFileSync(new URL("../../../core/test/fixtures/paper.sgs", import.meta.url)));
    const page = await stage.open('src="few.sgs" loop autoplay controls="off"', "", {
      viewport: { width: 160, height: 120 },
    });
    const reach = (count: number) =>
      page.waitForFunction((wanted) => heard.frames.length >= wanted, count, { timeout: 55_000, polling: 200 });
    const client = await page.context().newCDPSession(page);
    const taken = async () => {
      await client.send("HeapProfiler.collectGarbage");
      const { usedSize } = await client.send("Runtime.getHeapUsage");
      const counts = await ask(page, (player) => player.resources);
      return { usedSize, workers: page.workers().length, ...counts };
    };
    await reach(50);
    const first = await taken();
    await reach(150);
    const last = await taken();
    expect({ ...last, usedSize: 0 }).toEqual({ ...first, usedSize: 0 });
    expect(last.usedSize).toBeLessThan(first.usedSize * 1.1 + 2e5);
  });
});
