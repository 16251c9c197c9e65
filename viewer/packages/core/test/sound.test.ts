// SPDX-License-Identifier: Apache-2.0
/** Sound in a stream: as the Python encoder wrote it, in pieces, damaged, and of no stream. */

import { expect, test } from "vitest";
import { readStream, StreamReader } from "../src/reader.ts";
import { RecordType } from "../src/records.ts";
import { soundOf } from "../src/sound.ts";
import { bytesOf, joined, piecesOf, record, VECTORS } from "./streams.ts";

const STREAM = bytesOf(VECTORS, "version-2-sound.sgs");
const EXPECTED = JSON.parse(Buffer.from(bytesOf(VECTORS, "version-2-sound.json")).toString()) as {
  sound: unknown;
  frames: { index: number; sound: { seconds: number; packets: string[] } }[];
};
const SILENCE = [0xf8, 0xff, 0xfe];

function found(reader: StreamReader) {
  return reader.takeSounds().map(({ index, seconds, packets }) => ({
    index,
    sound: { seconds, packets: packets.map((packet) => Buffer.from(packet).toString("hex")) },
  }));
}

const wanted = EXPECTED.frames.map(({ index, sound }) => ({ index, sound }));

test("the golden sound, at once and byte by byte", () => {
  const whole = readStream(STREAM);
  expect(whole.header!.sound).toEqual(EXPECTED.sound);
  expect(found(whole)).toEqual(wanted);
  expect(found(whole)).toEqual([]);
  const reader = new StreamReader();
  const parts = [];
  for (const byte of STREAM) {
    reader.push(Uint8Array.of(byte));
    parts.push(...found(reader));
  }
  expect(parts).toEqual(wanted);
});

test("where a sound record ends is stated, and frames that are forgotten have none", () => {
  const reader = readStream(STREAM);
  reader.forget(8);
  expect(reader.takeSounds().map(({ index, end }) => [index, STREAM[end]])).toEqual([
    [8, RecordType.delta],
    [9, RecordType.delta],
    [10, RecordType.delta],
    [11, RecordType.index],
  ]);
});

test("a damaged sound, one of another frame and one that is none cost no frame", () => {
  const pieces = piecesOf(STREAM);
  const sound = pieces[3]!;
  const flipped = sound.slice();
  flipped[9]! ^= 1;
  const other = sound.slice(8, -4);
  other[0] = 5;
  for (const bad of [flipped, record(RecordType.sound, other), record(RecordType.sound, Uint8Array.of(1, 2))]) {
    const reader = readStream(joined(...pieces.map((piece) => (piece === sound ? bad : piece))));
    expect(reader.packets.length).toBe(12);
    expect(reader.frame(11).index).toBe(11);
    expect(found(reader)).toEqual(wanted.slice(1));
  }
});

test("what is no sound", () => {
  const payload = (count: number, lengths: number[], bytes: number[], seconds = 0) => {
    const made = new Uint8Array(14 + 2 * lengths.length + bytes.length);
    const view = new DataView(made.buffer);
    view.setFloat64(4, seconds, true);
    view.setUint16(12, count, true);
    for (const [i, length] of lengths.entries()) view.setUint16(14 + 2 * i, length, true);
    made.set(bytes, 14 + 2 * lengths.length);
    return made;
  };
  expect(soundOf(payload(1, [3], SILENCE))!.packets).toEqual([Uint8Array.from(SILENCE)]);
  expect(soundOf(payload(0, [], []))!.packets).toEqual([]);
  for (const wrong of [
    new Uint8Array(13),
    payload(1, [], []),
    payload(1, [4], SILENCE),
    payload(1, [3], [...SILENCE, 0]),
    payload(1, [0], []),
    payload(1, [1], [0x00]), // 10 ms
    payload(1, [2], [0x83, 7]), // seven times 2.5 ms
    payload(1, [3], SILENCE, Number.NaN),
  ]) {
    expect(soundOf(wrong)).toBeUndefined();
  }
  for (const right of [[0x08], [0x01], [0x68], [0x83, 8]]) {
    expect(soundOf(payload(1, [right.length], right))).toBeDefined();
  }
});
