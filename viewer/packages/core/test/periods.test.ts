// SPDX-License-Identifier: Apache-2.0
/** Streams of several periods: in pieces, damaged, contradicting themselves, by their index. */

import { expect, test } from "vitest";
import { indexEntries } from "../src/fileIndex.ts";
import { readStream, type StreamReader } from "../src/reader.ts";
import { PREFIX_BYTES, RecordType } from "../src/records.ts";
import { bytesOf, expectSame, flipped, inPieces, joined, piecesOf, record, VECTORS } from "./streams.ts";

const STREAM = bytesOf(VECTORS, "version-2-periods.sgs");
const PIECES = piecesOf(STREAM);
const FRAMES = 8;
/** The first frame of the second period. */
const LATER = 4;
const WHOLE = readStream(STREAM);
const EXPECTED = [...Array(FRAMES).keys()].map((i) => WHOLE.frame(i).fields);
const OFFSETS = PIECES.map((_, i) => PIECES.slice(0, i).reduce((sum, piece) => sum + piece.length, 0));
/** Which piece the second init record is; before it are the prefix, the first one and the first period's packets. */
const INIT = 2 + LATER;
/** Key packets are 0, 3, 4 and 7. */
const GROUP_ENDS = [3, 3, 3, 4, 7, 7, 7, 8];

function shown(reader: StreamReader): number[] {
  const found: number[] = [];
  for (let i = 0; i < FRAMES; i++) {
    try {
      const frame = reader.frame(i);
      for (const [name, tensor] of EXPECTED[i]!) expectSame(frame.fields.get(name), tensor);
      found.push(i);
    } catch (error) {
      expect(String(error)).toMatch(/is lost|there is no frame/);
    }
  }
  return found;
}

function without(first: number, end: number): number[] {
  return [...Array(FRAMES).keys()].filter((i) => i < first || i >= end);
}

test("frames come in any order, each with the header of its period", () => {
  expect(WHOLE.periods.map(({ number, first }) => [number, first])).toEqual([
    [0, 0],
    [1, LATER],
  ]);
  expect([0, 1].map((place) => WHOLE.headerOf(place)!.metadata.note)).toEqual(["ä", "later"]);
  const backwards = readStream(STREAM);
  for (const i of [7, 3, 4, 0, 5, 2]) {
    for (const [name, tensor] of WHOLE.frame(i).fields) expectSame(backwards.frame(i).fields.get(name), tensor);
  }
  expect(WHOLE.frame(4).fields.get("anchor_positions")!.shape).toEqual([12, 3]);
  expect(WHOLE.frame(3).fields.get("anchor_positions")!.shape).toEqual([21, 3]);
});

test("in pieces of any size it is the same", () => {
  for (const size of [1, 7, 100, 1000]) {
    const reader = inPieces(STREAM, size);
    expect([reader.state, shown(reader)]).toEqual(["complete", without(0, 0)]);
  }
});

test("a flipped bit costs a packet's group, or an init record's period, also while the stream comes", () => {
  for (const [at, piece] of PIECES.entries()) {
    if (at < 2 || at === PIECES.length - 1) continue;
    const frame = at < INIT ? at - 2 : at - 3;
    const lost = at === INIT ? without(LATER, FRAMES) : without(frame, GROUP_ENDS[frame]!);
    const start = 8 * OFFSETS[at]!;
    for (let bit = start; bit < start + 8 * piece.length; bit += bit < start + 160 ? 23 : 4999) {
      const reader = inPieces(flipped(STREAM, bit), 997);
      expect(shown(reader), `bit ${bit}`).toEqual(lost);
      expect(reader.damage.length).toBe(1);
    }
  }
}, 60_000);

test("an init record and the key packet after it may both be damaged", () => {
  const bytes = STREAM.slice();
  for (const at of [INIT - 1, INIT + 1]) bytes[OFFSETS[at]! + 25]! ^= 4;
  const reader = readStream(bytes);
  expect(shown(reader)).toEqual([0, 1, 2, 7]);
  expect(reader.periods.map(({ first }) => first)).toEqual([0, 5]);
});

test("what contradicts itself is refused", () => {
  const before = joined(...PIECES.slice(0, INIT));
  const [init, key] = PIECES.slice(INIT) as [Uint8Array, Uint8Array];
  const stream =
    (...records: Uint8Array[]) =>
    () =>
      readStream(joined(before, ...records));
  expect(stream(renumbered(init, 2))).toThrow("an init record of period 2, at byte");
  expect(stream(init, renumbered(init, 2))).toThrow("where a packet belongs");
  expect(stream(renumbered(key, 1))).toThrow("a packet of period 1, at byte");
  expect(stream(init, renumbered(key, 0))).toThrow("after the init record of period 1");
  expect(stream(init, renumbered(record(RecordType.delta, key.slice(8, -4)), 1))).toThrow(
    "A period of The stream begins with a delta packet",
  );
});

/** A record as one of another period. */
function renumbered(piece: Uint8Array, period: number): Uint8Array {
  return record(piece[0]!, piece.slice(8, -4), period);
}

test("the index says where init records are, and is not believed when it leaves out what they begin", () => {
  const entries = indexEntries(PIECES.at(-1)!, OFFSETS.at(-1)!)!;
  expect(entries.filter(({ isInit }) => isInit)).toEqual([
    { index: LATER, isKey: false, isInit: true, offset: OFFSETS[INIT] },
  ]);
  expect(entries.length).toBe(FRAMES + 1);
  const payload = PIECES.at(-1)!.slice(8, -4);
  const entriesOf = (change: (bytes: Uint8Array) => Uint8Array) =>
    indexEntries(record(RecordType.index, change(payload.slice())), OFFSETS.at(-1)!);
  expect(entriesOf((bytes) => bytes)).toBeDefined();
  expect(entriesOf((bytes) => bytes.subarray(0, 13 * (LATER + 1)))).toBeUndefined(); // ends with an init record
  expect(entriesOf((bytes) => joined(bytes.subarray(13 * LATER, 13 * (LATER + 1)), bytes))).toBeUndefined();
  expect(entriesOf((bytes) => bytes.fill(3, 13 * (LATER + 1) + 4, 13 * (LATER + 1) + 5))).toBeUndefined(); // a delta packet
});

test("a stream of one period is read as before by what stands in its records", () => {
  const reader = readStream(bytesOf(VECTORS, "version-2-compact.sgs"));
  expect(reader.periods).toMatchObject([{ number: 0, first: 0, offset: PREFIX_BYTES }]);
});
