// SPDX-License-Identifier: Apache-2.0
/** Streams that the Python encoder made, bit for bit. */

import { readdirSync } from "node:fs";
import { describe, expect, test } from "vitest";
import type { FieldName, Tensor } from "../src/fields.ts";
import { readStream } from "../src/reader.ts";
import { bytesOf, expectSame, FIXTURES, VECTORS } from "./streams.ts";

interface GoldenFrame {
  index: number;
  pts_seconds: number;
  kind: string;
  fields: Record<FieldName, { shape: number[]; values: number[] }>;
}

interface Fixture {
  frames: {
    pts_seconds: number;
    key: boolean;
    fields: Record<string, { shape: number[]; offset: number; bytes: number }>;
  }[];
}

function jsonOf(folder: URL, name: string): unknown {
  return JSON.parse(Buffer.from(bytesOf(folder, name)).toString());
}

const GOLDEN = readdirSync(VECTORS)
  .filter((file) => file.endsWith(".sgs"))
  .map((file) => file.slice(0, -4));

test.each(GOLDEN)("the golden stream %s", (name) => {
  const reader = readStream(bytesOf(VECTORS, `${name}.sgs`));
  const { frames } = jsonOf(VECTORS, `${name}.json`) as { frames: GoldenFrame[] };
  expect(reader.state).toBe("complete");
  expect(reader.packets.length).toBe(frames.length);
  for (const { index, pts_seconds, kind, fields } of frames) {
    const frame = reader.frame(index);
    expect([frame.index, frame.ptsSeconds, reader.packets[index]!.isKey]).toEqual([index, pts_seconds, kind === "KEY"]);
    expect([...frame.fields.keys()]).toEqual(Object.keys(fields));
    for (const [field, { shape, values }] of Object.entries(fields)) {
      const data = field === "free_births" ? BigInt64Array.from(values, BigInt) : Float32Array.from(values);
      expectSame(frame.fields.get(field as FieldName), { shape, data });
    }
  }
});

test("the golden stream's header", () => {
  const header = readStream(bytesOf(VECTORS, "version-2.sgs")).header!;
  expect(header.cameras.map(({ name, heldOut }) => [name, heldOut])).toEqual([
    ["left", false],
    ["middle", true],
    ["right", false],
  ]);
  expect(header.cameras[0]).toMatchObject({ width: 48, height: 32, near: 0.125 });
  expect(header.cameras[2]!.viewmat).toEqual([1, 0, 0, -1, 0, 1, 0, 0, 0, 0, 1, 4.5, 0, 0, 0, 1]);
  expect(header.cameras[0]!.K).toEqual([40, 0, 24, 0, 40.25, 16, 0, 0, 1]);
  expect(header.similarity).toEqual({ center: [0.25, -0.5, 3], scale: 0.75 });
  expect([header.fps, header.codec, header.distanceInput]).toEqual([30, "raw", true]);
  expect(header.config).toEqual({ seed: 7, online: { iterations: 10 } });
  expect(header.metadata).toEqual({ capture: "golden", note: "ä" });
});

describe.each(["paper", "every", "tiny"])("the compact fixture %s", (name) => {
  const stream = bytesOf(FIXTURES, `${name}.sgs`);
  const numbers = bytesOf(FIXTURES, `${name}.bin`);
  const { frames } = jsonOf(FIXTURES, `${name}.json`) as Fixture;

  function expected(index: number): [FieldName, Tensor][] {
    return Object.entries(frames[index]!.fields).map(([field, { shape, offset, bytes }]) => {
      const { buffer } = numbers.slice(offset, offset + bytes);
      const data = field === "free_births" ? new BigInt64Array(buffer) : new Float32Array(buffer);
      return [field as FieldName, { shape, data }];
    });
  }

  test.each([
    ["in order", frames.map((_, i) => i)],
    ["backwards", frames.map((_, i) => frames.length - 1 - i)],
    ["here and there", [5, 6, 1, 3, 3, 4, 2, 0, 4].map((i) => i % frames.length)],
  ])("has the same numbers %s", (_, order) => {
    const reader = readStream(stream);
    expect(reader.packets.map(({ isKey, ptsSeconds }) => [isKey, ptsSeconds])).toEqual(
      frames.map(({ key, pts_seconds }) => [key, pts_seconds]),
    );
    for (const index of order) {
      const frame = reader.frame(index);
      for (const [field, tensor] of expected(index)) expectSame(frame.fields.get(field), tensor);
    }
  });
});
