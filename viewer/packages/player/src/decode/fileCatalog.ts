// SPDX-License-Identifier: Apache-2.0
/** The packets of one file, from its index or as they are found during reading. */

import type { IndexEntry, PacketInfo, Period } from "@structgstream/core";
import { Catalog, type Place } from "./catalog.js";
import type { CatalogFacts } from "./messages.js";

interface Entry {
  readonly isKey: boolean;
  readonly offset: number;
  /** Start of the next known record; records of unknown types may precede it. */
  end: number;
  readonly ptsSeconds: number;
}

/** Position of an init record after the first one, and the first frame of its period. */
interface Init {
  readonly first: number;
  readonly start: number;
  readonly end: number;
}

export class FileCatalog extends Catalog {
  private readonly inits: Init[] = [];
  // By frame; undefined for a packet that was lost before its position was known.
  private readonly entries: (Entry | undefined)[] = [];

  /**
   * @param fps frames per second, for times of indexed and of lost frames
   * @param independent whether packets are independent of each other: codec `raw`
   */
  constructor(
    private readonly fps: number,
    private readonly independent: boolean,
  ) {
    super();
  }

  get count(): number {
    return this.entries.length;
  }

  /** Adds all entries of an index, of evenly spaced frames; `end` is the offset of the index record. */
  fill(index: readonly IndexEntry[], end: number): void {
    for (const [i, { isKey, isInit, index: first, offset }] of index.entries()) {
      const next = index[i + 1]?.offset ?? end;
      if (isInit) this.inits.push({ first, start: offset, end: next });
      else this.entries.push({ isKey, offset, end: next, ptsSeconds: first / this.fps });
    }
    this.complete = true;
  }

  /** Adds an init record that was found during reading. */
  begin({ first, offset, bytes }: Period): void {
    this.inits.push({ first, start: offset, end: offset + bytes });
  }

  /** The period of a frame, counted from 0. */
  period(index: number): number {
    return this.inits.filter(({ first }) => first <= index).length;
  }

  /** The init record of a period after the first. */
  init(period: number): Init {
    return this.inits[period - 1]!;
  }

  /** The frame after the last of a period. */
  periodEnd(period: number): number {
    return this.inits[period]?.first ?? this.count;
  }

  /** Adds a packet that was found during reading; the caller reports frames that it skips as lost. */
  append({ index, isKey, offset, bytes, ptsSeconds }: PacketInfo): void {
    while (this.entries.length < index) this.entries.push(undefined);
    this.entries.push({ isKey, offset, end: offset + bytes, ptsSeconds });
  }

  /** The sound of a frame that was found during reading ends at byte `end`. */
  extend(index: number, end: number): void {
    const entry = this.entries[index];
    if (entry) entry.end = Math.max(entry.end, end);
  }

  place(index: number): Place | undefined {
    const entry = this.entries[index];
    return entry && { start: entry.offset, end: entry.end };
  }

  isKey(index: number): boolean {
    return this.entries[index]?.isKey === true;
  }

  groupStart(index: number): number {
    let first = index;
    while (!this.independent && first > 0 && !this.isKey(first)) first--;
    return first;
  }

  groupEnd(index: number): number {
    let end = index + 1;
    while (!this.independent && end < this.count && !this.isKey(end)) end++;
    return end;
  }

  facts(): CatalogFacts {
    const { count, complete } = this;
    const ptsSeconds = new Float64Array(count);
    const keys: number[] = [];
    for (const [i, entry] of this.entries.entries()) {
      const after = i ? ptsSeconds[i - 1]! + 1 / this.fps : 0;
      // Estimated times may exceed a known one, but times must increase.
      ptsSeconds[i] = Math.max(entry?.ptsSeconds ?? after, i ? ptsSeconds[i - 1]! + 1e-9 : Number.NEGATIVE_INFINITY);
      if (entry?.isKey) keys.push(i);
    }
    return { first: 0, count, ptsSeconds, keys: Uint32Array.from(keys), lost: this.lost(), complete };
  }
}
