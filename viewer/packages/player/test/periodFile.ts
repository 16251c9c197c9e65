// SPDX-License-Identifier: Apache-2.0
/** A stream file of several periods, made of a stream that is repeated. */

import { PREFIX_BYTES, RecordType } from "../../core/src/records.ts";
import { type IndexRow, indexOf, joined } from "../../core/test/streams.ts";
import { partsOf, renumbered } from "./liveRun.ts";

export interface PeriodFile {
  readonly bytes: Uint8Array;
  /** Where the init records of all periods but the first begin and end. */
  readonly inits: readonly (readonly [start: number, end: number])[];
  /** Where packets begin. */
  readonly packets: readonly number[];
}

/** `frames` frames of each of `streams`, one period after the other, with index and footer. */
export function periodFile(streams: readonly Uint8Array[], frames: number, fps = 30): PeriodFile {
  const pieces: Uint8Array[] = [];
  const entries: IndexRow[] = [];
  const inits: [number, number][] = [];
  let [at, frame] = [0, 0];
  const add = (bytes: Uint8Array) => {
    pieces.push(bytes);
    at += bytes.length;
  };
  for (const [period, stream] of streams.entries()) {
    const { init, packets } = partsOf(stream, period);
    if (period) {
      entries.push([frame, RecordType.init, at]);
      inits.push([at, at + init.length - PREFIX_BYTES]);
    }
    add(period ? init.subarray(PREFIX_BYTES) : init);
    for (let i = 0; i < frames; i++, frame++) {
      const piece = packets[i % packets.length]!;
      entries.push([frame, piece[0]!, at]);
      add(renumbered(piece, frame, frame / fps, period));
    }
  }
  add(indexOf(entries, at));
  const packets = entries.filter(([, type]) => type !== RecordType.init).map(([, , offset]) => offset);
  return { bytes: joined(...pieces), inits, packets };
}
