// SPDX-License-Identifier: Apache-2.0
/** Records: the frame of everything in a stream file (docs/bitstream.md, sections Prefix and Records). */

import { StreamError } from "./errors.js";

export const RecordType = { init: 1, key: 2, delta: 3, index: 4, sound: 32 } as const;
export const MAJOR = 2;
export const PREFIX_BYTES = 12;
export const HEAD_BYTES = 8;
export const CHECKSUM_BYTES = 4;
/** Index and presentation time at the beginning of a packet's payload. */
export const FRAME_BYTES = 12;
export const INDEX_ENTRY_BYTES = 13;
const MAGIC = [0x89, 0x53, 0x47, 0x53, 0x0d, 0x0a, 0x1a, 0x0a];

/** One record; `offset` is the offset of its first byte in the stream, `period` the number of its period. */
export interface StreamRecord {
  readonly type: number;
  readonly period: number;
  readonly payload: Uint8Array;
  readonly offset: number;
}

let crcTable: Uint32Array | undefined;

function madeCrcTable(): Uint32Array {
  const table = new Uint32Array(256);
  for (let byte = 0; byte < 256; byte++) {
    let rest = byte;
    for (let bit = 0; bit < 8; bit++) rest = rest & 1 ? (rest >>> 1) ^ 0xedb88320 : rest >>> 1;
    table[byte] = rest;
  }
  return table;
}

/** CRC-32 as in zlib and PNG. */
export function crc32(bytes: Uint8Array): number {
  crcTable ??= madeCrcTable();
  const table = crcTable;
  let crc = -1;
  for (let i = 0; i < bytes.length; i++) crc = (crc >>> 8) ^ table[(crc ^ bytes[i]!) & 255]!;
  return ~crc >>> 0;
}

export function viewOf(bytes: Uint8Array): DataView {
  return new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
}

/** Whether `bytes` may be the beginning of a stream: the existing part of the signature is correct. */
export function isSignature(bytes: Uint8Array): boolean {
  return MAGIC.every((byte, i) => i >= bytes.length || bytes[i] === byte);
}

/**
 * Checks that a stream has this major version.
 *
 * @param bytes the first 12 bytes, or fewer if the stream is truncated
 * @throws StreamError it does not; the message states what was found and what to do
 */
export function checkPrefix(bytes: Uint8Array, name: string): void {
  if (!isSignature(bytes)) {
    throw new StreamError(`${name} is not a structgstream file: its first bytes are not the format's signature.`);
  }
  if (bytes.length < PREFIX_BYTES) {
    throw new StreamError(`${name} is cut at byte ${bytes.length}, before anything that can be shown.`);
  }
  const view = viewOf(bytes);
  const major = view.getUint16(8, true);
  if (major !== MAJOR) {
    const version = `${major}.${view.getUint16(10, true)}`;
    const advice = major > MAJOR ? "Use a newer one." : "Write the stream again, or use an older one.";
    throw new StreamError(`${name} has format version ${version}; this program reads ${MAJOR}.x. ${advice}`);
  }
}

/** The period that the head of a record at `at` states. */
export function periodAt(bytes: Uint8Array, at: number): number {
  return bytes[at + 2]! + 256 * bytes[at + 3]!;
}

/** Length of the record with this `head` (8 bytes); nothing is allocated. */
export function recordBytes(head: Uint8Array): number {
  return HEAD_BYTES + viewOf(head).getUint32(4, true) + CHECKSUM_BYTES;
}

/**
 * The record that fills `bytes`, or undefined if it is truncated or damaged. The payload is not copied.
 *
 * @param offset offset of the bytes in the stream
 */
export function recordIn(bytes: Uint8Array, offset: number): StreamRecord | undefined {
  if (bytes.length < HEAD_BYTES + CHECKSUM_BYTES || recordBytes(bytes) !== bytes.length) return undefined;
  const end = bytes.length - CHECKSUM_BYTES;
  if (viewOf(bytes).getUint32(end, true) !== crc32(bytes.subarray(0, end))) return undefined;
  return { type: bytes[0]!, period: periodAt(bytes, 0), payload: bytes.subarray(HEAD_BYTES, end), offset };
}
