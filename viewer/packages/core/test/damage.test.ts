// SPDX-License-Identifier: Apache-2.0
/** A flipped bit is reported with its record and costs at most its group (docs/bitstream.md, section Damage). */

import { describe, expect, test } from "vitest";
import { Search } from "../src/damage.ts";
import { StreamError } from "../src/errors.ts";
import { readStream, StreamReader } from "../src/reader.ts";
import { crc32, RecordType, viewOf } from "../src/records.ts";
import { bytesOf, expectSame, flipped, inPieces, joined, piecesOf, record, VECTORS } from "./streams.ts";

const STREAMS = { raw: bytesOf(VECTORS, "version-2.sgs"), compact: bytesOf(VECTORS, "version-2-compact.sgs") };

describe.each(Object.entries(STREAMS))("a %s stream", (codec, stream) => {
  const whole = readStream(stream);
  const count = whole.packets.length;
  const frames = whole.packets.map(({ index }) => whole.frame(index));

  /** The end of what frame `first` takes with it. */
  function groupEnd(first: number): number {
    if (codec === "raw") return first + 1;
    const next = whole.packets.find(({ index, isKey }) => isKey && index > first);
    return next?.index ?? count;
  }

  function expectLost(reader: StreamReader, lost: number[]): void {
    for (let index = 0; index < count; index++) {
      if (lost.includes(index)) {
        expect(() => reader.frame(index)).toThrow(`Frame ${index} of The stream is lost: the record at byte `);
      } else {
        const frame = reader.frame(index);
        for (const [name, tensor] of frames[index]!.fields) expectSame(frame.fields.get(name), tensor);
      }
    }
  }

  test.each(whole.packets.map(({ index }) => index))(
    "any bit of packet %i costs what is left of its group",
    (first) => {
      const { offset, bytes } = whole.packets[first]!;
      const end = groupEnd(first);
      const lost = Array.from({ length: end - first }, (_, i) => first + i);
      for (let bit = 8 * offset; bit < 8 * (offset + bytes); bit += bit < 8 * (offset + 20) ? 1 : 331) {
        const damaged = flipped(stream, bit);
        const readers = [readStream(damaged), ...(bit % 3 ? [] : [inPieces(damaged, 13)])];
        for (const reader of readers) {
          expect([reader.state, reader.damage]).toEqual(["complete", [{ offset, first, end }]]);
          expect(reader.packets).toEqual(whole.packets.filter(({ index }) => index !== first));
        }
        if (bit % 5 === 0) expectLost(readers.at(-1)!, lost);
      }
    },
  );

  test("damage of the index and after it costs nothing", () => {
    const { offset, bytes } = whole.packets.at(-1)!;
    for (let bit = 8 * (offset + bytes); bit < 8 * stream.length; bit += 13) {
      const reader = readStream(flipped(stream, bit));
      expect([reader.packets, reader.damage]).toEqual([whole.packets, []]);
    }
  });

  test("what comes after damage shows as soon as it is there", () => {
    const { offset, bytes } = whole.packets[1]!;
    const reader = new StreamReader();
    const damaged = flipped(stream, 8 * (offset + bytes) - 1);
    reader.push(damaged.subarray(0, offset + bytes));
    expect([reader.packets.length, reader.damage.length]).toEqual([1, 0]);
    const third = whole.packets[2]!;
    for (let at = offset + bytes; at < third.offset + third.bytes; at++) {
      expect(reader.packets.length).toBe(1);
      reader.push(damaged.subarray(at, at + 1));
    }
    expect(reader.packets.length).toBe(2);
    expect(reader.damage.map(({ first }) => first)).toEqual([1]);
  });

  test("damage that nothing follows, and a cut", () => {
    const { offset, bytes } = whole.packets.at(-1)!;
    const end = stream.subarray(0, offset + bytes);
    const damaged = readStream(flipped(end, 8 * offset + 100));
    expect([damaged.state, damaged.packets.length, damaged.damage]).toEqual(["damaged", count - 1, []]);
    const cut = readStream(end.subarray(0, -1));
    expect([cut.state, cut.packets.length, cut.damage]).toEqual(["reading", count - 1, []]);
    expect(() => cut.frame(count - 1)).toThrow(`has frames 0 to ${count - 2}; there is no frame ${count - 1}.`);
  });

  test("damage of what is no packet costs no frame", () => {
    const foreign = record(77, new Uint8Array(30));
    foreign[20] = 1;
    const { offset } = whole.packets[2]!;
    const reader = readStream(joined(stream.subarray(0, offset), foreign, stream.subarray(offset)));
    expect([reader.state, reader.damage]).toEqual(["complete", [{ offset, first: 2, end: 2 }]]);
    expectLost(reader, []);
  });

  test("frames that cannot have been there are not believed", () => {
    const [prefix, init, first, second, third] = piecesOf(stream) as Uint8Array[];
    const room = Math.floor(second!.length / 24);
    for (const [index, packets] of [
      [2 ** 32 - 1, 1],
      [1 + room + 1, 1],
      [1 + room, 2],
    ] as const) {
      const far = third!.slice();
      viewOf(far).setUint32(8, index, true);
      viewOf(far).setUint32(far.length - 4, crc32(far.subarray(0, -4)), true);
      const reader = readStream(joined(prefix!, init!, first!, flipped(second!, 70), far));
      expect(reader.packets.length).toBe(packets);
    }
  });
});

test("several damages, and two adjacent ones", () => {
  const stream = STREAMS.compact;
  const { packets } = readStream(stream);
  const [one, four] = [8 * packets[1]!.offset + 32, 8 * packets[4]!.offset + 100];
  const separate = readStream(flipped(stream, one, four));
  expect(separate.damage.map(({ first, end }) => [first, end])).toEqual([
    [1, 3],
    [4, 6],
  ]);
  expect(() => separate.frame(5)).toThrow(`lost: the record at byte ${packets[4]!.offset}, where frame 4 should be`);
  const adjacent = readStream(flipped(stream, 8 * packets[2]!.offset + 32, 8 * packets[3]!.offset + 32));
  expect(adjacent.damage.map(({ first, end }) => [first, end])).toEqual([[2, 6]]);
});

test("a stream full of heads does not keep a reader busy", () => {
  const stream = STREAMS.compact;
  const { offset, bytes } = readStream(stream).packets[0]!;
  const head = new Uint8Array(20);
  head[0] = RecordType.key;
  viewOf(head).setUint32(4, 10_000, true);
  viewOf(head).setUint32(8, 1, true);
  viewOf(head).setFloat64(12, 9, true);
  const heads = joined(...Array<Uint8Array>(20_000).fill(head), new Uint8Array(10_000));
  const reader = readStream(joined(stream.subarray(0, offset + bytes), heads));
  expect([reader.state, reader.packets.length]).toEqual(["damaged", 1]);
  const search = new Search();
  expect(search.next(heads, 1, { offset: 0, expected: 1, afterSeconds: 0, period: 0, since: 0 }, true)).toBeUndefined();
});

test("after damage, records that contradict each other are refused when the end has come", () => {
  const [prefix, init, first, second, third] = piecesOf(STREAMS.raw) as Uint8Array[];
  const long = flipped(second!, 8 * 7);
  const reader = new StreamReader();
  reader.push(joined(prefix!, init!, first!, long, third!, third!));
  expect(reader.packets.length).toBe(1);
  expect(() => reader.finish()).toThrow("has packet 2 where packet 3 belongs");
  expect(() => reader.finish()).toThrow(StreamError);
});

test("frame 0 is a key packet, also after damage", () => {
  const [prefix, init, , second] = piecesOf(STREAMS.compact) as Uint8Array[];
  const delta = second!.slice();
  viewOf(delta).setUint32(8, 0, true);
  viewOf(delta).setUint32(delta.length - 4, crc32(delta.subarray(0, -4)), true);
  const damaged = flipped(record(77, new Uint8Array(30)), 200);
  expect(() => readStream(joined(prefix!, init!, damaged, delta))).toThrow("begins with a delta packet");
});
