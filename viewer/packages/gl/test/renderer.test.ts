// SPDX-License-Identifier: Apache-2.0
/** What a player relies on in addition to the pixels: order and state together, lost contexts, nothing left behind. */

import { fileURLToPath } from "node:url";
import { afterAll, afterEach, beforeAll, describe, expect, test, vi } from "vitest";
import { openStage, type Stage } from "./support/browser.ts";
import { chromiumPath } from "./support/chromium.ts";
import { bytesOf, difference } from "./support/compare.ts";
import { viewsOf } from "./support/references.ts";

const executable = chromiumPath();
const fixtures = (name: string) => fileURLToPath(new URL(`./fixtures/${name}`, import.meta.url));
const view = viewsOf(fixtures("odd"))[0]!.camera;

vi.setConfig({ testTimeout: 60_000, hookTimeout: 60_000 });

describe.skipIf(!executable)("in a browser", () => {
  let stage: Stage;
  beforeAll(async () => {
    stage = await openStage(executable!, { odd: fixtures("odd.sgs"), patch: fixtures("patch.sgs") });
  });
  afterEach(async () => {
    await stage.page.evaluate(() => {
      for (const play of globalThis.stage.plays.splice(0)) play.close();
    });
    expect(stage.complaints.splice(0)).toEqual([]);
  });
  afterAll(() => stage?.close());

  test("no picture shows one frame in the order of another", async () => {
    const found = await stage.page.evaluate(async (camera) => {
      const viewmat = camera.viewmat.map((value, i) => (i === 3 ? value + 0.3 : value));
      const moved = { ...camera, viewmat };
      const play = await globalThis.stage.open("odd");
      const other = await globalThis.stage.open("odd");
      play.frame(0);
      const early = play.renderer.render(globalThis.stage.cameraOf(camera));
      const first = await play.picture(camera);
      // Frame 2 is there and its order is not: whatever is drawn is frame 0.
      play.sorter.held = true;
      play.frame(2);
      const between = await play.unsorted(moved);
      play.sorter.release();
      const second = await play.picture(moved);
      const again = play.renderer.render({ ...moved, viewmat: Float64Array.from(viewmat) });
      other.frame(0);
      await other.picture(camera);
      other.sorter.held = true;
      const wanted = await other.unsorted(moved);
      return { early, first, between, second, again, wanted };
    }, view);
    expect(found.early).toMatchObject({ frameIndex: undefined, settled: false, splats: 0 });
    expect(found.first.stats).toMatchObject({ frameIndex: 0, settled: true });
    expect(found.between.stats).toMatchObject({ frameIndex: 0, settled: false, drawn: true });
    expect(found.between.rgba).toBe(found.wanted.rgba);
    expect(found.second.stats).toMatchObject({ frameIndex: 2, settled: true });
    expect(found.second.rgba).not.toBe(found.between.rgba);
    expect(found.again).toMatchObject({ drawn: false, settled: true });
  });

  test("of several updates and cameras the latest wins, and onOrder says when", async () => {
    const found = await stage.page.evaluate(async (camera) => {
      const play = await globalThis.stage.open("odd");
      const plain = globalThis.stage.cameraOf(camera);
      const moved = { ...plain, viewmat: plain.viewmat.map((value, i) => (i === 3 ? value + 0.2 : value)) };
      const seen: (number | undefined)[] = [];
      play.renderer.onOrder = () => seen.push(play.renderer.render(plain).frameIndex);
      for (const index of [0, 1, 2, 3]) {
        play.frame(index);
        play.renderer.render(index % 2 ? plain : moved);
      }
      const stats = await play.renderer.renderSettled(plain);
      return { stats, seen };
    }, view);
    expect(found.stats.frameIndex).toBe(3);
    // The first request was under way when the others came: only the last of them was answered.
    expect(found.seen).toContain(3);
    expect(found.seen.filter((index) => index === 1 || index === 2)).toEqual([]);
  });

  test("a lost context comes back with the same picture", async () => {
    const found = await stage.page.evaluate(async (camera) => {
      const play = await globalThis.stage.open("odd");
      play.frame(1);
      const before = await play.picture(camera);
      const counts = play.renderer.resources;
      const lose = play.canvas.getContext("webgl2")!.getExtension("WEBGL_lose_context")!;
      const happened = (name: string) =>
        new Promise<void>((resolve) => play.canvas.addEventListener(name, () => setTimeout(resolve), { once: true }));
      const lost = happened("webglcontextlost");
      lose.loseContext();
      await lost;
      const away = play.renderer.render(globalThis.stage.cameraOf(camera));
      const gone = play.renderer.resources;
      play.frame(2); // what comes meanwhile is not lost
      const restored = happened("webglcontextrestored");
      lose.restoreContext();
      await restored;
      const later = await play.picture(camera);
      play.frame(1);
      const after = await play.picture(camera);
      return { before, away, gone, later, after, counts, now: play.renderer.resources };
    }, view);
    expect(found.away.drawn).toBe(false);
    expect(found.gone.textures).toBe(0);
    expect(found.later.stats.frameIndex).toBe(2);
    expect(found.after.rgba).toBe(found.before.rgba);
    expect(found.now).toEqual(found.counts);
  });

  test("forty frames leave as many textures as one, and destroying leaves nothing", async () => {
    const found = await stage.page.evaluate(async (camera) => {
      const play = await globalThis.stage.open("odd");
      const plain = globalThis.stage.cameraOf(camera);
      const counts = [];
      for (let i = 0; i < 40; i++) {
        play.frame(i % 4);
        const shift = (value: number, at: number) => (at === 3 ? value + 0.1 * Math.sin(i) : value);
        await play.renderer.renderSettled({ ...plain, viewmat: plain.viewmat.map(shift) });
        if (i === 10 || i === 39) counts.push(play.renderer.resources);
      }
      play.renderer.load(play.reader.header!);
      const empty = play.renderer.render(plain);
      play.close();
      play.close();
      let refused = "";
      try {
        play.renderer.render(plain);
      } catch (error) {
        refused = (error as Error).message;
      }
      return { counts, empty, gone: play.renderer.resources, refused };
    }, view);
    expect(found.counts[1]).toEqual(found.counts[0]);
    expect(found.empty).toMatchObject({ frameIndex: undefined, settled: false });
    expect(found.gone).toEqual({ textures: 0, buffers: 0, programs: 0, framebuffers: 0, workers: 0 });
    expect(found.refused).toContain("destroyed");
  });

  test("a rig camera's colour is its gain and bias; a held-out one's is the mean", async () => {
    const found = await stage.page.evaluate(async (camera) => {
      const play = await globalThis.stage.open("odd");
      play.frame(1);
      const mean = await play.picture(camera);
      const left = await play.picture(camera, { cameraName: "left" });
      const middle = await play.picture(camera, { cameraName: "middle" });
      const refused = await play.picture(camera, { cameraName: "top" }).catch((error: Error) => error.message);
      return { mean: mean.rgba, left: left.rgba, middle: middle.rgba, drawn: left.stats.drawn, refused };
    }, view);
    const [mean, left] = [bytesOf(found.mean), bytesOf(found.left)];
    const [gain, bias] = [
      [0.8, 0.9, 1.1],
      [0.05, 0, -0.05],
    ];
    const off = [...mean].map((value, i) => {
      // Where the picture is full or empty, more or less than that was drawn.
      if (i % 4 === 3 || value === 255 || value === 0) return 0;
      const wanted = Math.min(Math.max(gain[i % 4]! * value + 255 * bias[i % 4]!, 0), 255);
      return Math.abs(left[i]! - wanted);
    });
    expect(Math.max(...off)).toBeLessThan(1.2);
    expect(found.middle).toBe(found.mean);
    expect(found.refused).toBe('The stream has no camera "top"; it has left, middle, right.');
  });

  test("a budget and a smaller resolution draw less, and taking them back draws the same as before", async () => {
    const wide = viewsOf(fixtures("patch"))[0]!.camera;
    const found = await stage.page.evaluate(async (camera) => {
      const play = await globalThis.stage.open("patch");
      play.frame(0);
      const whole = await play.picture(camera);
      play.renderer.maxSplats = 900;
      const few = await play.picture(camera);
      play.renderer.maxSplats = Number.POSITIVE_INFINITY;
      play.renderer.pixelScale = 0.5;
      const coarse = await play.picture(camera);
      play.renderer.pixelScale = 1;
      const again = await play.picture(camera);
      return { whole, few, coarse, again };
    }, wide);
    const { whole, few, coarse, again } = found;
    const off = (rgba: string) => difference(bytesOf(rgba), bytesOf(whole.rgba), wide.width, wide.height).psnrDecibels;
    expect(whole.stats.splats).toBeGreaterThan(2500);
    expect(few.stats.splats).toBeLessThanOrEqual(900);
    expect(few.stats.splats).toBeGreaterThan(800);
    expect(off(few.rgba)).toBeLessThan(40);
    expect(off(coarse.rgba)).toBeGreaterThan(15);
    expect(off(coarse.rgba)).toBeLessThan(45);
    expect(again.rgba).toBe(whole.rgba);
  });

  test.each([
    [{ withoutWebGL2: true }, {}, "This browser does not support WebGL2"],
    [{ limits: { MAX_TEXTURE_SIZE: 1 } }, {}, "entries of anchor_offsets, at most 2048 fit its textures"],
    [{ limits: { MAX_DRAW_BUFFERS: 2 } }, { mlpPath: "mrt" }, 'limits are too small for the MLP path "mrt"'],
  ] as const)("what a device cannot do is said in a sentence: %j", async (device, options, sentence) => {
    const said = await stage.page.evaluate(
      async ([camera, lesser, given]) => {
        try {
          const play = await globalThis.stage.open("patch", { ...given, device: lesser });
          play.frame(0);
          await play.picture(camera);
          return "nothing";
        } catch (error) {
          return (error as Error).message;
        }
      },
      [view, device, options] as const,
    );
    expect(said).toContain(sentence);
  });

  test("a device without transform feedback to speak of takes the other path", async () => {
    const stats = await stage.page.evaluate(async (camera) => {
      const device = { limits: { MAX_TRANSFORM_FEEDBACK_INTERLEAVED_COMPONENTS: 4 } };
      const play = await globalThis.stage.open("odd", { device });
      play.frame(0);
      return (await play.picture(camera)).stats;
    }, view);
    expect(stats.settled).toBe(true);
  });

  test("without a worker given, the renderer starts its own", async () => {
    const stats = await stage.page.evaluate(async (camera) => {
      const play = await globalThis.stage.open("odd", { ownSorter: true });
      play.frame(0);
      return (await play.picture(camera)).stats;
    }, view);
    expect(stats.splats).toBeGreaterThan(100);
  });

  test("a sorting worker that cannot be loaded is reported, and nobody waits for it", async () => {
    const said = await stage.page.evaluate(async (camera) => {
      const play = await globalThis.stage.open("odd", { sorterPath: "/nowhere.js" });
      play.frame(0);
      const refused = await play.picture(camera).catch((error: Error) => error.message);
      return [refused, ...play.errors];
    }, view);
    expect(said[0]).toContain("The sorting worker does not run");
    expect(said[1]).toContain("The sorting worker does not run");
    stage.complaints.splice(0); // the console's own line about the missing file
  });
});
