// SPDX-License-Identifier: Apache-2.0
/** Opus packets as an Ogg file, which browsers decode as a whole (RFC 3533, RFC 7845). */

import { PACKET_SAMPLES, SOUND_RATE } from "@structgstream/core";
import { joined } from "../source/joined.js";

const SERIAL = 1;
/** A page has at most 255 segments, a packet of 20 ms at most six. */
const PACKETS_PER_PAGE = 42;
const PAGE_HEAD = 27;
const [BEGINS, ENDS] = [2, 4];

let crcTable: Uint32Array | undefined;

/** CRC-32 of Ogg: polynomial 04C11DB7, neither reflected nor inverted. */
function checksum(bytes: Uint8Array): number {
  crcTable ??= Uint32Array.from({ length: 256 }, (_, byte) => {
    let rest = byte << 24;
    for (let bit = 0; bit < 8; bit++) rest = rest & 0x80000000 ? (rest << 1) ^ 0x04c11db7 : rest << 1;
    return rest;
  });
  let crc = 0;
  for (const byte of bytes) crc = (crc << 8) ^ crcTable[(crc >>> 24) ^ byte]!;
  return crc >>> 0;
}

function page(packets: readonly Uint8Array[], number: number, samples: number, flags: number): Uint8Array {
  const segments: number[] = [];
  for (const { length } of packets) segments.push(...Array(Math.floor(length / 255)).fill(255), length % 255);
  const bytes = joined([new Uint8Array(PAGE_HEAD), Uint8Array.from(segments), ...packets]);
  const view = new DataView(bytes.buffer);
  bytes.set(ascii("OggS"));
  bytes[5] = flags;
  view.setUint32(6, samples, true);
  view.setUint32(14, SERIAL, true);
  view.setUint32(18, number, true);
  bytes[26] = segments.length;
  view.setUint32(22, checksum(bytes), true);
  return bytes;
}

function ascii(text: string): Uint8Array {
  return new TextEncoder().encode(text);
}

/** A file of these packets of 20 ms. It states no samples to skip: who decodes it knows what to leave out. */
export function oggOf(packets: readonly Uint8Array[], channels: number): Uint8Array<ArrayBuffer> {
  const head = new Uint8Array(19);
  head.set([...ascii("OpusHead"), 1, channels]);
  new DataView(head.buffer).setUint32(12, SOUND_RATE, true);
  const tags = new Uint8Array(16);
  tags.set(ascii("OpusTags"));
  const pages = [page([head], 0, 0, BEGINS), page([tags], 1, 0, 0)];
  for (let first = 0; first < packets.length; first += PACKETS_PER_PAGE) {
    const end = Math.min(first + PACKETS_PER_PAGE, packets.length);
    const flags = end === packets.length ? ENDS : 0;
    pages.push(page(packets.slice(first, end), pages.length, end * PACKET_SAMPLES, flags));
  }
  return joined(pages);
}
