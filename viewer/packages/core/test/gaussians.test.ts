// SPDX-License-Identifier: Apache-2.0
/** Frames as arrays against what Python's MLPs give, and the README's example. */

import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { expect, test } from "vitest";
import { samplingInterval } from "../../gl/test/support/oracle.ts";
import { type View, viewsOf } from "../../gl/test/support/references.ts";
import type { Fields } from "../src/fields.ts";
import { GaussianEvaluator, type Gaussians, type Point } from "../src/gaussians.ts";
import { readStream, type StreamReader } from "../src/reader.ts";
import { bytesOf, VECTORS } from "./streams.ts";

const GL = new URL("../../gl/test/fixtures/", import.meta.url);
/** Columns of the references: opacity, rgb, shares of the scales, quaternion. */
const COLUMNS = 11;

/** The camera's centre, in the capture's units. */
function eyeOf(view: View, { header }: StreamReader): Point {
  const v = view.camera.viewmat;
  const { center, scale } = header!.similarity;
  const eye = [0, 1, 2].map((i) => -(v[i]! * v[3]! + v[4 + i]! * v[7]! + v[8 + i]! * v[11]!));
  return eye.map((value, i) => value / scale + center[i]!) as unknown as Point;
}

/** Mean of structured Gaussian `id` in the capture's units, and the largest scales that the MLP may give it. */
function placed(fields: Fields, id: number, { header }: StreamReader): { mean: number[]; bound: number[] } {
  const { center, scale } = header!.similarity;
  const number = (name: Parameters<Fields["get"]>[0], at: number) => Number(fields.get(name)!.data[at]);
  const m = Math.floor(id / fields.get("anchor_offsets")!.shape[1]!);
  const of = (axis: number) =>
    number("anchor_positions", 3 * m + axis) +
    number("anchor_offsets", 3 * id + axis) * Math.exp(number("offset_scales", 3 * m + axis));
  return {
    mean: [0, 1, 2].map((axis) => of(axis) / scale + center[axis]!),
    bound: [0, 1, 2].map((axis) => Math.exp(number("base_scales", 3 * m + axis)) / scale),
  };
}

/** Rows whose mean is there; some Gaussians of an anchor have the same offset. */
function rowsAt({ means, count }: Gaussians, mean: number[]): number[] {
  const rows = Array.from({ length: count }, (_, row) => row);
  return rows.filter((row) => mean.every((value, i) => Math.abs(means[3 * row + i]! - value) < 1e-5));
}

test.each(["odd", "patch"])("%s: opacity, colour, scales and rotation are Python's", (name) => {
  const reader = readStream(bytesOf(GL, `${name}.sgs`));
  const evaluator = new GaussianEvaluator(reader.header!);
  const file = readFileSync(new URL(`${name}/outputs.bin`, GL));
  let compared = 0;
  for (const view of viewsOf(fileURLToPath(new URL(name, GL)))) {
    const { fields } = reader.frame(view.frame);
    const found = evaluator.evaluate(fields, eyeOf(view, reader));
    const [ids, values] = [view.offset, view.offset + 4 * view.outputs];
    for (let i = 0; i < view.outputs; i += 4) {
      const truth = Array.from({ length: COLUMNS }, (_, column) =>
        file.readFloatLE(values + 4 * (COLUMNS * i + column)),
      );
      const { mean, bound } = placed(fields, file.readUInt32LE(ids + 4 * i), reader);
      const differences = rowsAt(found, mean).map((row) => {
        const sign = Math.sign(found.rotations[4 * row]! * truth[7]!) || 1;
        const given = [
          found.opacities[row]!,
          ...found.colors.subarray(3 * row, 3 * row + 3),
          ...bound.map((largest, axis) => found.scales[3 * row + axis]! / largest),
          ...[...found.rotations.subarray(4 * row, 4 * row + 4)].map((part) => sign * part),
        ];
        return Math.max(...given.map((value, column) => Math.abs(value - truth[column]!)));
      });
      expect(Math.min(...differences)).toBeLessThan(2e-5);
      compared++;
    }
  }
  expect(compared).toBeGreaterThan(100);
});

test("a new evaluator gives what one gives that has seen other frames", () => {
  const reader = readStream(bytesOf(GL, "odd.sgs"));
  const eye = eyeOf(viewsOf(fileURLToPath(new URL("odd", GL)))[0]!, reader);
  const one = new GaussianEvaluator(reader.header!);
  for (const { index } of reader.packets) {
    const { fields } = reader.frame(index);
    expect(one.evaluate(fields, eye)).toEqual(new GaussianEvaluator(reader.header!).evaluate(fields, eye));
  }
});

test("the low-pass widens by the training pixel of the place", () => {
  const reader = readStream(bytesOf(GL, "odd.sgs"));
  const header = reader.header!;
  const { center, scale } = header.similarity;
  const { fields } = reader.frame(reader.packets.length - 1);
  const free = fields.get("free")!;
  expect(free.shape[0]).toBeGreaterThan(0);
  const [plain, wide] = [{}, { lowPass: 0.3 }].map((options) =>
    new GaussianEvaluator(header, options).evaluate(fields, [0, 0, 0]),
  ) as [Gaussians, Gaussians];
  expect(wide.count).toBe(plain.count);
  // The last one is a free Gaussian, whose own mean counts.
  const [row, axis] = [plain.count - 1, 1];
  const mean = [...plain.means.subarray(3 * row, 3 * row + 3)].map((value, i) => (value - center[i]!) * scale);
  const added = 0.3 * (samplingInterval(header, mean) / scale) ** 2;
  const [before, after] = [plain.scales[3 * row + axis]!, wide.scales[3 * row + axis]!];
  expect((after ** 2 - before ** 2) / added).toBeCloseTo(1, 3);
});

test("the README's example runs", () => {
  const readme = readFileSync(new URL("../README.md", import.meta.url), "utf8");
  const code = /```js\n([\s\S]*?)```/.exec(readme)![1]!;
  const folder = mkdtempSync(join(tmpdir(), "structgstream-"));
  try {
    const built = JSON.stringify(new URL("../dist/index.js", import.meta.url).href);
    writeFileSync(join(folder, "example.mjs"), code.replace('"@structgstream/core"', built));
    writeFileSync(join(folder, "ball.sgs"), bytesOf(VECTORS, "version-2.sgs"));
    const lines = execFileSync(process.execPath, ["example.mjs"], { cwd: folder, encoding: "utf8" }).trim().split("\n");
    expect(lines.length).toBe(readStream(bytesOf(VECTORS, "version-2.sgs")).packets.length);
    for (const line of lines) expect(line).toMatch(/^\d+ [1-9]\d* Gaussians/);
  } finally {
    rmSync(folder, { recursive: true });
  }
});
