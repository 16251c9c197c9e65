// SPDX-License-Identifier: Apache-2.0

import { describe, expect, test } from "vitest";
import { indexEntries, indexOffset } from "../src/fileIndex.ts";
import { readStream, StreamReader } from "../src/reader.ts";
import { RecordType } from "../src/records.ts";
import { bytesOf, expectSame, FIXTURES, inPieces, joined, piecesOf, record, VECTORS } from "./streams.ts";

const RAW = bytesOf(VECTORS, "version-2.sgs");
const COMPACT = bytesOf(FIXTURES, "paper.sgs");

function expectSameReaders(found: StreamReader, expected: StreamReader): void {
  expect(found.state).toBe(expected.state);
  expect(found.packets).toEqual(expected.packets);
  for (const { index } of expected.packets) {
    const frame = found.frame(index);
    for (const [name, tensor] of expected.frame(index).fields) expectSame(frame.fields.get(name), tensor);
  }
}

describe.each([
  ["raw", RAW],
  ["compact", COMPACT],
])("a %s stream", (_, stream) => {
  const whole = readStream(stream);

  test.each([1, 7, 1000])("in pieces of %i bytes is the same as at once", (size) => {
    expectSameReaders(inPieces(stream, size), whole);
  });

  test("shows every frame as soon as its last byte is there", () => {
    const reader = new StreamReader();
    let frames = 0;
    for (const [i, byte] of stream.entries()) {
      reader.push(Uint8Array.of(byte));
      if (reader.packets.length > frames) {
        const { offset, bytes } = reader.packets[frames]!;
        expect(i + 1).toBe(offset + bytes);
        expect(reader.frame(frames).index).toBe(frames);
        frames++;
      }
    }
    expect(frames).toBe(whole.packets.length);
  });

  test("records of unknown types are skipped, before the init record one is refused", () => {
    const [prefix, ...records] = piecesOf(stream) as [Uint8Array, ...Uint8Array[]];
    const unknown = record(200, Uint8Array.of(1, 2, 3));
    const mixed = readStream(joined(prefix, ...records.flatMap((piece) => [piece, unknown])));
    expect(mixed.state).toBe("complete");
    expect(mixed.packets.length).toBe(whole.packets.length);
    expect(() => readStream(joined(prefix, unknown, ...records))).toThrow("begins with a record of type 200");
  });

  test("what follows the index is not looked at", () => {
    expectSameReaders(readStream(joined(stream, new Uint8Array(1000))), whole);
  });

  test("records that contradict each other", () => {
    const [prefix, init, first, second] = piecesOf(stream) as [Uint8Array, Uint8Array, Uint8Array, Uint8Array];
    const stream_ =
      (...records: Uint8Array[]) =>
      () =>
        readStream(joined(prefix, init, ...records));
    expect(stream_(init)).toThrow("has an init record of period 0, at byte");
    expect(stream_(first, first)).toThrow("has packet 0 where packet 1 belongs");
    expect(stream_(second)).toThrow("has packet 1 where packet 0 belongs");
    expect(stream_(record(RecordType.delta, first.slice(8, -4)))).toThrow("begins with a delta packet");
    const early = second.slice(8, -4);
    early.fill(0, 4, 12);
    expect(stream_(first, record(RecordType.delta, early))).toThrow("is not presented after the one before it");
    early.fill(255, 4, 12);
    expect(stream_(first, record(RecordType.delta, early))).toThrow("which is no time");
  });

  test("the index says what scanning finds", () => {
    const offset = indexOffset(stream.slice(-16), stream.length)!;
    const entries = indexEntries(stream.slice(offset, -16), offset)!;
    expect(entries).toEqual(whole.packets.map(({ index, isKey, offset }) => ({ index, isKey, isInit: false, offset })));
    expect(indexOffset(stream.slice(-17, -1), stream.length)).toBeUndefined();
    expect(indexOffset(stream.slice(-16), offset)).toBeUndefined();
    expect(indexEntries(stream.slice(offset, -15), offset)).toBeUndefined();
    expect(indexEntries(stream.slice(offset, -16), whole.packets[1]!.offset)).toBeUndefined();
  });
});

test("what is no stream, and another major version", () => {
  expect(() => new StreamReader("a.sgs").push(Uint8Array.of(0x89, 0x50))).toThrow("a.sgs is not a structgstream file");
  const newer = RAW.slice();
  newer[8] = 3;
  expect(() => readStream(newer)).toThrow("has format version 3.0; this program reads 2.x. Use a newer one.");
  newer[8] = 1;
  expect(() => readStream(newer)).toThrow("has format version 1.0; this program reads 2.x. Write the stream again");
  newer.set([2, 0, 9], 8);
  expect(readStream(newer).packets.length).toBe(3);
});

test("an error stays", () => {
  const reader = new StreamReader();
  expect(() => reader.push(new Uint8Array(12))).toThrow("not a structgstream file");
  expect(() => reader.push(RAW)).toThrow("not a structgstream file");
  expect(() => reader.finish()).toThrow("not a structgstream file");
});

test("nothing can be shown of a stream that is cut or damaged too early", () => {
  expect(() => readStream(RAW.subarray(0, 5))).toThrow("is cut at byte 5, before anything that can be shown");
  expect(() => readStream(RAW.subarray(0, 90))).toThrow("is cut at byte 90, within the init record");
  const damaged = RAW.slice();
  damaged[30]! ^= 1;
  expect(() => readStream(damaged)).toThrow("its init record is damaged");
});

test("whole groups are dropped, and the error says so", () => {
  const reader = readStream(COMPACT);
  reader.forget(5);
  expect(() => reader.frame(3)).toThrow("Frame 0 of The stream is no longer in memory.");
  expect(reader.frame(5).index).toBe(5);
  expect(reader.frame(4).index).toBe(4);
});

test("a frame that is no number of a frame", () => {
  const reader = readStream(RAW);
  for (const index of [-1, 0.5, 3, Number.NaN])
    expect(() => reader.frame(index)).toThrow("has frames 0 to 2; there is");
});
