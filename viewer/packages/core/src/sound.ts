// SPDX-License-Identifier: Apache-2.0
/** The sound of a stream: Opus packets of 20 ms beside each frame (docs/bitstream.md, section Sound). */

import { viewOf } from "./records.js";

/** Samples of a packet, of each channel, at 48 kHz. */
export const PACKET_SAMPLES = 960;
export const SOUND_RATE = 48_000;
const HEAD = 14;
const MAX_PACKET_BYTES = 1275;

/** What the init record states of the sound. */
export interface SoundFormat {
  /** A codec that this version does not know cannot be played; the pictures can. */
  readonly codec: string;
  /** 1 or 2. */
  readonly channels: number;
}

/** The sound that is stored with a frame. */
export interface FrameSound {
  readonly index: number;
  /** Presentation time of the first sample that decoding the first packet gives. */
  readonly seconds: number;
  /** Opus packets of 20 ms, one after the other. */
  readonly packets: readonly Uint8Array[];
}

/**
 * The sound in a sound record, with packets that are views of `payload`; undefined if that contradicts the format, which
 * costs sound and no picture.
 */
export function soundOf(payload: Uint8Array): FrameSound | undefined {
  if (payload.length < HEAD) return undefined;
  const view = viewOf(payload);
  const [index, seconds, count] = [view.getUint32(0, true), view.getFloat64(4, true), view.getUint16(12, true)];
  let start = HEAD + 2 * count;
  if (!Number.isFinite(seconds) || start > payload.length) return undefined;
  const packets: Uint8Array[] = [];
  for (let at = HEAD; at < HEAD + 2 * count; at += 2) {
    const end = start + view.getUint16(at, true);
    packets.push(payload.subarray(start, end));
    start = end;
  }
  return start === payload.length && packets.every(isPacket) ? { index, seconds, packets } : undefined;
}

/** Whether this may be an Opus packet of 20 ms, by its first bytes (RFC 6716, section 3.1). */
function isPacket(packet: Uint8Array): boolean {
  if (packet.length < 1 || packet.length > MAX_PACKET_BYTES) return false;
  const [config, code] = [packet[0]! >> 3, packet[0]! & 3];
  const lengths = config < 12 ? [10, 20, 40, 60] : config < 16 ? [10, 20] : [2.5, 5, 10, 20];
  const frame = lengths[config % lengths.length]!;
  if (code === 3) return packet.length > 1 && frame * (packet[1]! & 63) === 20;
  return frame * (code ? 2 : 1) === 20;
}
