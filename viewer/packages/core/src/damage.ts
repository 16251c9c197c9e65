// SPDX-License-Identifier: Apache-2.0
/** Where a stream goes on after damage (docs/bitstream.md, section Damage). */

import { CHECKSUM_BYTES, HEAD_BYTES, RecordType, recordBytes, recordIn, viewOf } from "./records.js";

const FRAME_BYTES = 12;
const INDEX_ENTRY_BYTES = 13;
const LEAST_PACKET_BYTES = HEAD_BYTES + FRAME_BYTES + CHECKSUM_BYTES;
const WORK = 4;

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
}

/** The record that a stream goes on with: where it begins in the bytes that were searched, and its frame. */
export interface Following {
  readonly at: number;
  readonly next: number;
}

/**
 * Finds what follows damage. One is made for each stream: with all its calls it verifies checksums of no more than four
 * times the stream's bytes, so that a stream made for it cannot make a reader work for long.
 */
export class Search {
  private work = 0;

  /**
   * The first whole packet or index that can come after the damage; otherwise the number of bytes that none begins in.
   *
   * @param bytes of the stream from byte `start` on, which is after the first byte of the damaged record
   * @param more whether others may come
   * @returns undefined when too much has been looked at already
   */
  next(bytes: Uint8Array, start: number, damaged: Standing, more: boolean): Following | number | undefined {
    const view = viewOf(bytes);
    for (let at = 0; at + HEAD_BYTES <= bytes.length; at++) {
      const kind = bytes[at]!;
      if (kind < RecordType.key || kind > RecordType.index || view.getUint16(at + 2, true) !== 0) continue;
      const size = recordBytes(bytes.subarray(at, at + HEAD_BYTES));
      const known = Math.min(HEAD_BYTES + (kind === RecordType.index ? 0 : FRAME_BYTES), size);
      if (at + known <= bytes.length) {
        const next = nextFrame(view, at, size - HEAD_BYTES - CHECKSUM_BYTES);
        if (next === undefined || !fits(next, at + start, damaged)) continue;
        if (at + size <= bytes.length) {
          this.work += size;
          if (this.work > WORK * (start + bytes.length)) return undefined;
          if (recordIn(bytes.subarray(at, at + size), at)) return { at, next: next.frame };
          continue;
        }
      }
      if (more) return at;
    }
    return more ? Math.max(bytes.length - HEAD_BYTES + 1, 0) : bytes.length;
  }
}

interface Next {
  readonly frame: number;
  readonly seconds: number | undefined;
}

/** The frame that a packet is, or that would follow an index; undefined where the record at `at` is neither. */
function nextFrame(view: DataView, at: number, length: number): Next | undefined {
  if (view.getUint8(at) === RecordType.index) {
    if (length % INDEX_ENTRY_BYTES) return undefined;
    return { frame: length / INDEX_ENTRY_BYTES, seconds: undefined };
  }
  if (length < FRAME_BYTES) return undefined;
  const start = at + HEAD_BYTES;
  return { frame: view.getUint32(start, true), seconds: view.getFloat64(start + 4, true) };
}

function fits(
  { frame, seconds }: Next,
  offset: number,
  { offset: damaged, expected, afterSeconds }: Standing,
): boolean {
  const last = expected + Math.floor((offset - damaged) / LEAST_PACKET_BYTES);
  const later = seconds === undefined || (Number.isFinite(seconds) && seconds > afterSeconds);
  return expected <= frame && frame <= last && later;
}
