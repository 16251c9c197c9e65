// SPDX-License-Identifier: Apache-2.0
/** What a player reads packets with: by place, without numbers in between. */

import { expect, test } from "vitest";
import { fieldBytes, SceneDecoder } from "../src/decoder.ts";
import { readStream } from "../src/reader.ts";
import { bytesOf, expectSame, FIXTURES, VECTORS } from "./streams.ts";

test.each([
  ["raw", bytesOf(VECTORS, "version-2.sgs")],
  ["compact", bytesOf(FIXTURES, "paper.sgs")],
])("a %s frame is the same when those before it were only advanced through", (_, stream) => {
  const reader = readStream(stream);
  const expected = readStream(stream);
  const last = reader.packets.length - 1;
  const decoder = new SceneDecoder(reader.header!);
  for (let i = 0; i < last; i++) decoder.advance(reader.take(i));
  const frame = decoder.decode(reader.take(last));
  for (const [name, tensor] of expected.frame(last).fields) expectSame(frame.fields.get(name), tensor);
});

test("a packet that was taken is no longer the reader's", () => {
  const reader = readStream(bytesOf(FIXTURES, "paper.sgs"));
  expect(reader.take(2).index).toBe(2);
  expect(() => reader.take(2)).toThrow("Frame 2 of The stream is no longer in memory.");
  expect(() => reader.frame(2)).toThrow("is no longer in memory");
});

test("the bytes of a packet's fields are all of it but index and time", () => {
  const reader = readStream(bytesOf(FIXTURES, "paper.sgs"));
  const packet = reader.take(1);
  const sizes = fieldBytes(packet);
  expect(new Set(sizes.keys())).toEqual(reader.header!.dynamic);
  expect([...sizes.values()].reduce((sum, bytes) => sum + bytes, 0)).toBe(packet.payload.length - 12);
});

test("a delta packet cannot be advanced through without the one before it", () => {
  const reader = readStream(bytesOf(FIXTURES, "paper.sgs"));
  const decoder = new SceneDecoder(reader.header!);
  expect(() => decoder.advance(reader.take(1))).toThrow("needs packet 0");
});
