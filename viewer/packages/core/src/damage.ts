// SPDX-License-Identifier: Apache-2.0
/** Finds where a stream continues after damage (docs/bitstream.md, section Damage). */

import { ZSTD_MAGIC } from "./json.js";
import {
  CHECKSUM_BYTES,
  FRAME_BYTES,
  HEAD_BYTES,
  INDEX_ENTRY_BYTES,
  periodAt,
  RecordType,
  recordBytes,
  recordIn,
  viewOf,
} from "./records.js";

const MIN_PACKET_BYTES = HEAD_BYTES + FRAME_BYTES + CHECKSUM_BYTES;
const WORK = 4;
/** Offset of the description, which is a zstd frame, in an init record. */
const DESCRIPTION_AT = HEAD_BYTES + 4;

/** A damaged record that others follow, and the lost frames from `first` to before `end`. */
export interface Damage {
  readonly offset: number;
  readonly first: number;
  readonly end: number;
}

/** State before the damaged record at byte `offset`: the next frame, and the time of the last one. */
export interface Standing {
  readonly offset: number;
  readonly expected: number;
  readonly afterSeconds: number;
  /** Period of the last complete init record. */
  readonly period: number;
  /** The first byte after the last complete packet that is in no complete record. */
  readonly since: number;
}

/**
 * The record at which a stream continues: its offset in the searched bytes, and its frame, which an init record does not
 * have.
 */
export interface Following {
  readonly at: number;
  readonly next: number | undefined;
}

/** Largest possible frame of a packet at byte `offset`, because lost frames took bytes, too. */
export function lastFrame({ expected, since }: Standing, offset: number): number {
  return expected + Math.floor((offset - since) / MIN_PACKET_BYTES);
}

/**
 * Finds the record after damage. Use one object per stream: all its calls together verify checksums of at most four times
 * the stream's bytes, so that a hostile stream cannot occupy a reader for long.
 */
export class Search {
  private work = 0;

  /**
   * The first complete packet, init record or index that can follow the damage; otherwise the number of bytes in which none
   * begins.
   *
   * @param bytes bytes of the stream from `start` on, which is after the first byte of the damaged record
   * @param more whether more bytes may come
   * @returns undefined if the limit of verified bytes is reached
   */
  next(bytes: Uint8Array, start: number, damaged: Standing, more: boolean): Following | number | undefined {
    const view = viewOf(bytes);
    for (let at = 0; at + HEAD_BYTES <= bytes.length; at++) {
      const kind = bytes[at]!;
      if (kind < RecordType.init || kind > RecordType.index) continue;
      const isIndex = kind === RecordType.index;
      const period = periodAt(bytes, at);
      if (kind === RecordType.init ? period <= damaged.period : period !== (isIndex ? 0 : damaged.period)) continue;
      const size = recordBytes(bytes.subarray(at, at + HEAD_BYTES));
      if (at + Math.min(HEAD_BYTES + (isIndex ? 0 : FRAME_BYTES), size) <= bytes.length) {
        if (!canFollow(view, at, size, at + start, damaged)) continue;
        if (at + size <= bytes.length) {
          this.work += size;
          if (this.work > WORK * (start + bytes.length)) return undefined;
          const record = recordIn(bytes.subarray(at, at + size), at);
          const next = record && nextFrame(record.type, record.payload);
          if (record && (next === undefined || isBetween(next, at + start, damaged))) return { at, next };
          continue;
        }
      }
      if (more) return at;
    }
    return more ? Math.max(bytes.length - HEAD_BYTES + 1, 0) : bytes.length;
  }
}

/** Whether the first bytes of a record at `at`, byte `offset` of the stream, can follow the damage. */
function canFollow(view: DataView, at: number, size: number, offset: number, damaged: Standing): boolean {
  const kind = view.getUint8(at);
  const length = size - HEAD_BYTES - CHECKSUM_BYTES;
  if (kind === RecordType.index) return length % INDEX_ENTRY_BYTES === 0;
  if (length < FRAME_BYTES) return false;
  if (kind === RecordType.init) return view.getUint32(at + DESCRIPTION_AT, true) === ZSTD_MAGIC;
  const seconds = view.getFloat64(at + HEAD_BYTES + 4, true);
  const later = Number.isFinite(seconds) && seconds > damaged.afterSeconds;
  return later && isBetween(view.getUint32(at + HEAD_BYTES, true), offset, damaged);
}

function isBetween(frame: number, offset: number, damaged: Standing): boolean {
  return damaged.expected <= frame && frame <= lastFrame(damaged, offset);
}

/** The frame of a packet, or the one after an index. */
function nextFrame(kind: number, payload: Uint8Array): number | undefined {
  if (kind === RecordType.init) return undefined;
  if (kind !== RecordType.index) return viewOf(payload).getUint32(0, true);
  let count = 0;
  for (let at = 4; at < payload.length; at += INDEX_ENTRY_BYTES) if (payload[at] !== RecordType.init) count++;
  return count;
}
