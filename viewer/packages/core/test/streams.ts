// SPDX-License-Identifier: Apache-2.0
/** Stream files that tests look at, and how to make others of them. */

import { readFileSync } from "node:fs";
import { expect } from "vitest";
import type { Tensor } from "../src/fields.ts";
import { StreamReader } from "../src/reader.ts";
import { CHECKSUM_BYTES, crc32, HEAD_BYTES, PREFIX_BYTES, RecordType, viewOf } from "../src/records.ts";

export const VECTORS = new URL("../../../../tests/vectors/", import.meta.url);
export const FIXTURES = new URL("./fixtures/", import.meta.url);

export function bytesOf(folder: URL, name: string): Uint8Array {
  return new Uint8Array(readFileSync(new URL(name, folder)));
}

export function joined(...parts: Uint8Array[]): Uint8Array {
  return new Uint8Array(Buffer.concat(parts));
}

/** A whole record. */
export function record(type: number, payload: Uint8Array, period = 0): Uint8Array {
  const bytes = joined(new Uint8Array([type, 0, 0, 0, 0, 0, 0, 0]), payload, new Uint8Array(CHECKSUM_BYTES));
  viewOf(bytes).setUint16(2, period, true);
  viewOf(bytes).setUint32(4, payload.length, true);
  viewOf(bytes).setUint32(HEAD_BYTES + payload.length, crc32(bytes.subarray(0, -CHECKSUM_BYTES)), true);
  return bytes;
}

export type IndexRow = readonly [frame: number, type: number, offset: number];

/** The index of a file, whose record is at byte `at`, and the footer. */
export function indexOf(rows: readonly IndexRow[], at: number): Uint8Array {
  const payload = new Uint8Array(13 * rows.length);
  for (const [i, [frame, type, offset]] of rows.entries()) {
    viewOf(payload).setUint32(13 * i, frame, true);
    viewOf(payload).setUint8(13 * i + 4, type);
    viewOf(payload).setBigUint64(13 * i + 5, BigInt(offset), true);
  }
  const offset = new Uint8Array(8);
  viewOf(offset).setBigUint64(0, BigInt(at), true);
  return joined(record(RecordType.index, payload), offset, new TextEncoder().encode("SGSINDEX"));
}

/** Prefix and records of a stream, the index last. */
export function piecesOf(stream: Uint8Array): Uint8Array[] {
  const pieces = [stream.subarray(0, PREFIX_BYTES)];
  for (let at = PREFIX_BYTES; at + HEAD_BYTES + CHECKSUM_BYTES <= stream.length; ) {
    const end = at + HEAD_BYTES + viewOf(stream).getUint32(at + 4, true) + CHECKSUM_BYTES;
    pieces.push(stream.subarray(at, end));
    if (stream[at] === RecordType.index) break;
    at = end;
  }
  return pieces;
}

/** The bytes with these bits inverted. */
export function flipped(stream: Uint8Array, ...bits: number[]): Uint8Array {
  const damaged = stream.slice();
  for (const bit of bits) damaged[bit >> 3]! ^= 1 << (bit & 7);
  return damaged;
}

/** A reader that was given the stream in pieces of so many bytes. */
export function inPieces(stream: Uint8Array, size: number): StreamReader {
  const reader = new StreamReader();
  for (let at = 0; at < stream.length; at += size) reader.push(stream.subarray(at, at + size));
  reader.finish();
  return reader;
}

/** Compares bits, so that NaNs and the sign of zero count. */
export function expectSame(found: Tensor | undefined, expected: Tensor): void {
  expect(found?.shape).toEqual(expected.shape);
  expect(found?.data.constructor).toBe(expected.data.constructor);
  expect(Buffer.compare(bits(found!.data), bits(expected.data))).toBe(0);
}

function bits(data: Float32Array | BigInt64Array): Uint8Array {
  return new Uint8Array(data.buffer, data.byteOffset, data.byteLength);
}
