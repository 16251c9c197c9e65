// SPDX-License-Identifier: Apache-2.0
/** Gaussians are drawn as the training pixels showed them, at any size of the picture (docs/bitstream.md). */

import { readFileSync } from "node:fs";
import { fileURLToPath } from "node:url";
import { type Camera as HeaderCamera, readStream, type StreamHeader } from "@structgstream/core";
import { afterAll, beforeAll, describe, expect, test } from "vitest";
import { axes, center, resized, viewmatOf } from "../src/cameraMath.ts";
import { trainingCamerasOf } from "../src/sampling.ts";
import type { Camera } from "../src/types.ts";
import { along, length, scaled, type Vector } from "../src/vectors.ts";
import { openStage, type Stage } from "./support/browser.ts";
import { chromiumPath } from "./support/chromium.ts";
import { bytesOf } from "./support/compare.ts";
import { type Drawn, drawnFree, samplingInterval } from "./support/oracle.ts";
import type { PlainCamera } from "./support/page.ts";
import { PROJECTED_NUMBERS } from "./support/readBack.ts";
import { viewsOf } from "./support/references.ts";

const executable = chromiumPath();
const fixture = (name: string) => fileURLToPath(new URL(`./fixtures/${name}`, import.meta.url));
const FRAME = 3;
const MIN_ALPHA = 1 / 255;
const reader = readStream(new Uint8Array(readFileSync(fixture("odd.sgs"))));
const header = reader.header!;
const { fields } = reader.frame(FRAME);
const positions = fields.get("anchor_positions")!.data as Float32Array;
const free = fields.get("free")!;
const row = (i: number) => (free.data as Float32Array).subarray(14 * i, 14 * i + 14);
const points = [
  ...Array.from({ length: positions.length / 3 }, (_, m) => positions.subarray(3 * m, 3 * m + 3)),
  ...Array.from({ length: free.shape[0]! }, (_, i) => row(i).subarray(0, 3)),
];

/** The same scene filmed by other cameras: of many sizes and focal lengths, all around it, `count` of them. */
function filmedBy(count: number): StreamHeader {
  const cameras = Array.from({ length: count }, (_, i): HeaderCamera => {
    const angle = 2.4 * i;
    const forward: Vector = [Math.sin(angle), 0, Math.cos(angle)];
    const eye = scaled(forward, -2 - (i % 5));
    const viewmat = viewmatOf(eye, [[Math.cos(angle), 0, -Math.sin(angle)], [0, 1, 0], forward]);
    const [width, height] = [20 + 7 * (i % 11), 90 - 5 * (i % 7)];
    const K = [30 + 10 * (i % 9), 0, width / 2 - 3, 0, 35 + 10 * (i % 9), height / 3, 0, 0, 1];
    return { name: `c${i}`, viewmat: [...viewmat], K, width, height, near: 0.1, heldOut: i % 4 === 3 };
  });
  return { ...header, cameras };
}

test("the bound of the sampling interval holds at every point", () => {
  for (const of of [header, filmedBy(40)]) {
    const { middle, spread, slope } = trainingCamerasOf(of).bound;
    for (const point of points) {
      const away = length(along([...point] as unknown as Vector, middle, -1));
      expect(samplingInterval(of, point)).toBeLessThanOrEqual(slope * (away + spread));
    }
  }
});

const given = viewsOf(fixture("odd"))[0]!.camera;
const base: Camera = { ...given, viewmat: Float64Array.from(given.viewmat) };
/** The camera so that a point, here of a free Gaussian, is `factor` times as far away and in the same place of the picture. */
function atDistance(point: Vector, factor: number, near = base.near): Camera {
  const eye = along(point, along(center(base), point, -1), factor);
  return { ...base, viewmat: viewmatOf(eye, axes(base)), near };
}
const zoomed = (factor: number): Camera => ({
  ...base,
  K: { ...base.K, fx: base.K.fx * factor, fy: base.K.fy * factor },
});
const mean = (i: number) => [...row(i).subarray(0, 3)] as unknown as Vector;
const forward = axes(base)[2];
/** The eye at the mean of a Gaussian; exactly there its depth is 0, and it is not drawn. */
const within = (i: number, shift: number): Camera => ({
  ...base,
  viewmat: viewmatOf(along(mean(i), forward, -shift), axes(base)),
  near: 1e-9,
});
const views: readonly (readonly [string, Camera])[] = [
  ["1x", base],
  ...[0.25, 0.5, 3].map((factor) => {
    const [width, height] = [Math.round(base.width * factor), Math.round(base.height * factor)];
    return [`${factor}x`, resized(base, width, height)] as const;
  }),
  ["twice as near", atDistance([0, 0, 0], 0.5)],
  ["a thousand times nearer", atDistance(mean(2), 1e-3, 1e-6)],
  ["a thousand times farther", atDistance(mean(2), 1e3)],
  ["a thousand times the focal length", zoomed(1000)],
  ["a thousandth of the focal length", zoomed(1e-3)],
  ["one pixel", resized(base, 1, 1)],
  ["one pixel of a row", resized(base, 72, 1)],
  ["within a Gaussian", within(1, 1e-4)],
  ["at the mean of a Gaussian", within(1, 0)],
];

/** Whether the numbers of a slot are those of the oracle, or rightly none. */
function agrees(found: Float32Array, wanted: Drawn, camera: Camera): boolean {
  const [x, y, xx, xy, yy, opacity] = found as unknown as [number, number, number, number, number, number];
  const reach = Math.sqrt(2 * Math.max(Math.log(255 * wanted.opacity), 0));
  const [across, down] = [reach * Math.sqrt(wanted.xx), reach * Math.sqrt(wanted.yy)];
  if (!(opacity > 0)) {
    const outside =
      wanted.x + across < 1e-3 ||
      wanted.y + down < 1e-3 ||
      wanted.x - across > camera.width - 1e-3 ||
      wanted.y - down > camera.height - 1e-3;
    const wild = Math.max(across, down, Math.abs(wanted.x), Math.abs(wanted.y)) > 0.99e7;
    return outside || wild || wanted.opacity < 1.001 * MIN_ALPHA || wanted.depth < 1.001 * camera.near;
  }
  const size = Math.max(wanted.xx, wanted.yy);
  const off = [(xx - wanted.xx) / size, (xy - wanted.xy) / size, (yy - wanted.yy) / size, opacity - wanted.opacity];
  const place = [x - wanted.x, y - wanted.y].map((value) => value / (1 + Math.abs(wanted.x) + Math.abs(wanted.y)));
  return [...off, ...place].every((value) => Math.abs(value) < 2e-3);
}

describe.skipIf(!executable)("in a browser", () => {
  let stage: Stage;
  beforeAll(async () => {
    stage = await openStage(executable!, { odd: fixture("odd.sgs") });
  }, 60_000);
  afterAll(() => stage?.close());

  const seen = async (cameras: readonly Camera[], filmed?: StreamHeader, pixelScale = 1) => {
    const plain = cameras.map((camera): PlainCamera => ({ ...camera, viewmat: [...camera.viewmat] }));
    const found = await stage.page.evaluate(
      async ([views, rig, scale, frame]) => {
        const play = await globalThis.stage.open("odd");
        play.renderer.pixelScale = scale;
        if (rig) play.renderer.load({ ...play.reader.header!, cameras: rig });
        play.frame(frame);
        const all = [];
        for (const view of views) {
          const { stats, rgba } = await play.picture(view);
          all.push({ stats, rgba, ...play.readBack() });
        }
        play.close();
        return all;
      },
      [plain, filmed?.cameras, pixelScale, FRAME] as const,
    );
    expect(stage.complaints.splice(0)).toEqual([]);
    const floats = (text: string) => new Float32Array(bytesOf(text).buffer as ArrayBuffer);
    return found.map(({ stats, rgba, intervals, projected, blended }) => ({
      stats,
      rgba: bytesOf(rgba),
      intervals: floats(intervals),
      projected: floats(projected),
      blended: floats(blended),
    }));
  };

  test("sampling intervals are those of the rig, of cameras of any sizes, and 160 of them", async () => {
    for (const filmed of [undefined, filmedBy(2), filmedBy(160)]) {
      const [view] = await seen([base], filmed);
      const wanted = points.map((point) => samplingInterval(filmed ?? header, point));
      expect(view!.intervals.length).toBe(wanted.length);
      for (const [i, value] of wanted.entries()) expect(view!.intervals[i]! / value).toBeCloseTo(1, 4);
    }
  }, 60_000);

  test("what no camera has in front of it has no interval", async () => {
    const behind = header.cameras.map((camera) => {
      const viewmat = camera.viewmat.map((value, i) => (i === 11 ? value - 1000 : value));
      return { ...camera, viewmat };
    });
    const filmed = { ...header, cameras: behind };
    const [view] = await seen([base], filmed);
    expect(view!.intervals.every((value) => value === 0)).toBe(true);
    expect(view!.rgba.some((value, i) => i % 4 < 3 && value > 20)).toBe(true);
  }, 60_000);

  test.each([1, 0.35])(
    "free Gaussians are the oracle's, and all else is finite, drawn at %s of the picture's size",
    async (scale) => {
      const found = await seen(
        views.map(([, camera]) => camera),
        undefined,
        scale,
      );
      for (const [v, [name, camera]] of views.entries()) {
        const { stats, projected, blended } = found[v]!;
        const size = [camera.width, camera.height].map((side) => Math.max(Math.round(side * scale), 1)) as [
          number,
          number,
        ];
        const drawnBy = resized(camera, ...size);
        const plain: PlainCamera = { ...drawnBy, viewmat: [...camera.viewmat] };
        expect(projected.every(Number.isFinite), name).toBe(true);
        // Colours of free Gaussians may be any number; the coverage is one of [0, 1].
        expect(
          blended.every((value, at) => Number.isFinite(value) && (at % 4 < 3 || (value >= 0 && value < 1.001))),
          name,
        ).toBe(true);
        const at = PROJECTED_NUMBERS * stats.anchors * 7;
        for (let i = 0; i < free.shape[0]!; i++) {
          const slot = projected.subarray(at + PROJECTED_NUMBERS * i, at + PROJECTED_NUMBERS * (i + 1));
          const wanted = drawnFree(row(i), samplingInterval(header, row(i)), plain);
          expect(agrees(slot, wanted, drawnBy), `${name}, ${i}: ${[...slot]} is not ${JSON.stringify(wanted)}`).toBe(
            true,
          );
        }
      }
      const shown = (name: string) => {
        const { projected } = found[views.findIndex((view) => view[0] === name)]!;
        return projected.filter((value, i) => i % PROJECTED_NUMBERS === 5 && value > 0).length;
      };
      for (const name of ["1x", "0.25x", "3x", "one pixel", "a thousand times nearer", "within a Gaussian"]) {
        expect(shown(name), name).toBeGreaterThan(0);
      }
    },
    120_000,
  );
});
