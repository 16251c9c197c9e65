// SPDX-License-Identifier: Apache-2.0
/** Pictures in a browser against those of the Python CPU renderer (`make_fixtures.py`). */

import { readdirSync } from "node:fs";
import { fileURLToPath } from "node:url";
import { afterAll, beforeAll, describe, expect, test } from "vitest";
import type { MlpPath } from "../src/index.ts";
import { openStage, type Stage } from "./support/browser.ts";
import { chromiumPath } from "./support/chromium.ts";
import type { Lesser } from "./support/page.ts";
import { compared } from "./support/references.ts";

const MIN_DECIBELS = 50;
const MAX_BLOCK_LEVELS = 8;
const MAX_OFF: Readonly<Record<MlpPath, number>> = { "transform-feedback": 1e-4, mrt: 2e-3 };
/** Gaussians of an anchor: of the clip, and of the scene of random numbers. */
const OFFSETS = { patch: 3, odd: 7 } as const;
const executable = chromiumPath();

const folder = (name: string) => fileURLToPath(new URL(`./fixtures/${name}`, import.meta.url));

describe.skipIf(!executable)("in a browser", () => {
  let stage: Stage;
  beforeAll(async () => {
    const files: Record<string, string> = {};
    for (const name of Object.keys(OFFSETS)) {
      files[name] = folder(`${name}.sgs`);
      for (const file of readdirSync(folder(name))) files[`${name}/${file}`] = `${folder(name)}/${file}`;
    }
    stage = await openStage(executable!, files);
  }, 60_000);
  afterAll(() => stage?.close());

  const small: Lesser = { limits: { MAX_DRAW_BUFFERS: 4, MAX_TRANSFORM_FEEDBACK_INTERLEAVED_COMPONENTS: 24 } };
  const cases: readonly (readonly [keyof typeof OFFSETS, MlpPath, string, Lesser])[] = [
    ["patch", "transform-feedback", "this device", {}],
    ["patch", "mrt", "this device", {}],
    ["odd", "transform-feedback", "this device", {}],
    ["odd", "mrt", "this device", {}],
    ["odd", "transform-feedback", "small limits", small],
    ["odd", "mrt", "small limits", small],
    [
      "patch",
      "mrt",
      "no float targets",
      { withoutExtensions: ["EXT_color_buffer_float", "EXT_color_buffer_half_float"] },
    ],
  ];
  test.each(cases)(
    "%s looks as in Python, by %s, with %s",
    async (name, path, _, device) => {
      for await (const view of compared(stage, name, folder(name), path, OFFSETS[name], device)) {
        const where = `${name} ${view.name}`;
        // Eight bits a blend lose more: the fall-back is held to less, and says so to its user.
        const least = device.withoutExtensions ? 36 : MIN_DECIBELS;
        expect(view.psnrDecibels, where).toBeGreaterThanOrEqual(least);
        expect(view.blockLevels, where).toBeLessThanOrEqual(MAX_BLOCK_LEVELS);
        expect(view.mlp, where).toBeLessThanOrEqual(MAX_OFF[path]);
        expect(view.gaussians, where).toBeGreaterThan(50);
        expect(view.stats.frameIndex, where).toBeDefined();
        console.log(`${where} by ${path}: ${view.psnrDecibels.toFixed(1)} dB, block ${view.blockLevels.toFixed(2)}`);
      }
      expect(stage.complaints).toEqual([]);
    },
    60_000,
  );
});
