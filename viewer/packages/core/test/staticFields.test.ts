// SPDX-License-Identifier: Apache-2.0
/** Bounds of the init record's coded fields; that they decode to the right numbers the golden streams show. */

import { describe, expect, test } from "vitest";
import { blocksIn } from "../src/blocks.ts";
import { checkShapes, type FieldName } from "../src/fields.ts";
import { viewOf } from "../src/records.ts";
import { decodedFields, MAX_ANCHORS } from "../src/staticFields.ts";
import { bytesOf, FIXTURES, joined, piecesOf } from "./streams.ts";

/** The coded blocks of a fixture's init record. */
function codedOf(name: string): Map<FieldName, Uint8Array> {
  const payload = piecesOf(bytesOf(FIXTURES, name))[1]!.slice(8, -4);
  const blocks = blocksIn(payload, 4 + viewOf(payload).getUint32(0, true), "It").filter(({ coded }) => coded);
  return new Map(blocks.map(({ name, data, end }) => [name, payload.slice(data, end)]));
}

function varint(value: number): Uint8Array {
  const bytes = [];
  for (; value >= 128; value = Math.floor(value / 128)) bytes.push((value % 128) | 128);
  return Uint8Array.of(...bytes, value);
}

const coded = codedOf("every.sgs");
const steps = new Map([...coded.keys()].map((name) => [name as string, 0.5]));
const replaced = (name: FieldName, data: Uint8Array) => () => decodedFields(new Map(coded).set(name, data), steps);

describe.each<[FieldName, number, string]>([
  ["anchor_positions", MAX_ANCHORS, "anchors"],
  ["base_scales", 3, "columns of base_scales"],
  ["anchor_offsets", 192, "columns of anchor_offsets"],
  ["anchor_features", 256, "columns of anchor_features"],
  ["appearance", 256, "columns of appearance"],
  ["color_mlp", 2 ** 20, "numbers of color_mlp"],
  ["appearance_basis", 2 ** 20, "numbers of appearance_basis"],
  ["environment", 2 ** 20, "numbers of environment"],
])("of %s", (name, most, what) => {
  // Counts below 128 are one byte, those here may take more; the first byte is what the fixture has.
  const rest = coded.get(name)!.subarray(1);

  test("more than allowed is refused before anything is allocated for it", () => {
    const message = `The init record has ${most + 1} ${what}; at most ${most} are allowed.`;
    expect(replaced(name, joined(varint(most + 1), rest))).toThrow(message);
    expect(replaced(name, joined(varint(2 ** 32 - 1), rest))).toThrow(`has ${2 ** 32 - 1} ${what}`);
  });

  test("nothing may be missing or left", () => {
    expect(replaced(name, coded.get(name)!.subarray(0, -1))).toThrow("The init record");
    expect(replaced(name, joined(coded.get(name)!, Uint8Array.of(0)))).toThrow(`more bytes of ${name} than it should`);
  });
});

test("fields are whole numbers of steps", () => {
  const fields = decodedFields(coded, steps);
  expect([...fields.keys()].sort()).toEqual([...coded.keys()].sort());
  for (const { data } of fields.values()) {
    expect((data as Float32Array).every((value) => Number.isInteger(2 * value))).toBe(true);
  }
});

test("fields that need others", () => {
  const without = (name: FieldName) => new Map([...coded].filter(([other]) => other !== name));
  expect(() => decodedFields(without("anchor_positions"), steps)).toThrow("too early in anchor_positions");
  expect(() => decodedFields(without("appearance"), steps)).toThrow("directions of an appearance without");
  expect(() => decodedFields(coded, new Map())).toThrow("states no step for");
});

test("an environment has rows of three, one for each harmonic up to degree 0, 1 or 2", () => {
  const shapes = (rows: number) => () =>
    checkShapes(new Map([["environment", { shape: [rows, 3], data: new Float32Array(3 * rows) }]]), facts, "It");
  const facts = { distanceInput: true, cameras: [] };
  for (const rows of [1, 4, 9]) expect(shapes(rows)).not.toThrow();
  for (const rows of [0, 2, 16])
    expect(shapes(rows)).toThrow(`It has an environment of ${rows} rows; expected 1, 4 or 9.`);
});

test("few bytes do not make many numbers", () => {
  const many = (rows: number) => replaced("anchor_positions", joined(varint(rows), new Uint8Array(20)));
  const bytes = [...coded.values()].reduce((sum, data) => sum + data.length, 0);
  const others = bytes - coded.get("anchor_positions")!.length;
  const most = Math.floor((2 ** 20 + 64 * (others + 23)) / 3);
  expect(many(most)).toThrow("anchor_positions.far,");
  expect(many(most + 1)).toThrow("The init record has more than 64 numbers a byte; it is damaged.");
});
