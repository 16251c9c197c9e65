// SPDX-License-Identifier: Apache-2.0
/** Where a stream goes on after damage (docs/bitstream.md, section Damage). */

import { CHECKSUM_BYTES, HEAD_BYTES, periodAt, RecordType, recordBytes, recordIn, viewOf } from "./records.js";

const FRAME_BYTES = 12;
const INDEX_ENTRY_BYTES = 13;
const LEAST_PACKET_BYTES = HEAD_BYTES + FRAME_BYTES + CHECKSUM_BYTES;
const WORK = 4;
/** Where the description of an init record is in it, and how it begins: it is a zstd frame. */
const ZSTD = [HEAD_BYTES + 4, 0xfd2fb528] as const;

/** A record that is not whole although others follow it, and the frames from `first` to before `end` that it costs. */
export interface Damage {
  readonly offset: number;
  readonly first: number;
  readonly end: number;
}

/** What is known where the damaged record begins, at byte `offset`: the next frame, and the time of the last one. */
export interface Standing {
  readonly offset: number;
  readonly expected: number;
  readonly afterSeconds: number;
  /** Of the last whole init record. */
  readonly period: number;
  /** The first byte after the last whole packet that is in no whole record. */
  readonly since: number;
}

/**
 * The record that a stream goes on with: where it begins in the bytes that were searched, and its frame; an init record
 * states none.
 */
export interface Following {
  readonly at: number;
  readonly next: number | undefined;
}

/** The last frame that a packet at byte `offset` can be: those that were lost took bytes, too. */
export function lastFrame({ expected, since }: Standing, offset: number): number {
  return expected + Math.floor((offset - since) / LEAST_PACKET_BYTES);
}

/**
 * Finds what follows damage. One is made for each stream: with all its calls it verifies checksums of no more than four
 * times the stream's bytes, so that a stream made for it cannot make a reader work for long.
 */
export class Search {
  private work = 0;

  /**
   * The first whole packet, init record or index that can come after the damage; otherwise the number of bytes that none
   * begins in.
   *
   * @param bytes of the stream from byte `start` on, which is after the first byte of the damaged record
   * @param more whether others may come
   * @returns undefined when too much has been looked at already
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

/** Whether a record at `at`, byte `offset` of the stream, can come after the damage by what its beginning says. */
function canFollow(view: DataView, at: number, size: number, offset: number, damaged: Standing): boolean {
  const kind = view.getUint8(at);
  const length = size - HEAD_BYTES - CHECKSUM_BYTES;
  if (kind === RecordType.index) return length % INDEX_ENTRY_BYTES === 0;
  if (length < FRAME_BYTES) return false;
  if (kind === RecordType.init) return view.getUint32(at + ZSTD[0], true) === ZSTD[1];
  const seconds = view.getFloat64(at + HEAD_BYTES + 4, true);
  const later = Number.isFinite(seconds) && seconds > damaged.afterSeconds;
  return later && isBetween(view.getUint32(at + HEAD_BYTES, true), offset, damaged);
}

function isBetween(frame: number, offset: number, damaged: Standing): boolean {
  return damaged.expected <= frame && frame <= lastFrame(damaged, offset);
}

/** The frame that a packet is, or that would follow an index. */
function nextFrame(kind: number, payload: Uint8Array): number | undefined {
  if (kind === RecordType.init) return undefined;
  if (kind !== RecordType.index) return viewOf(payload).getUint32(0, true);
  let count = 0;
  for (let at = 4; at < payload.length; at += INDEX_ENTRY_BYTES) if (payload[at] !== RecordType.init) count++;
  return count;
}
