// SPDX-License-Identifier: Apache-2.0
/** Which packets a stream has, where they are, and which frames can be shown. */

import type { IndexEntry, PacketInfo } from "@structgstream/core";
import type { CatalogFacts, FrameRange } from "./messages.js";

interface Entry {
  readonly isKey: boolean;
  readonly offset: number;
  /** Where something else begins: records of unknown types may lie before it. */
  readonly end: number;
  ptsSeconds: number | undefined;
}

export class Catalog {
  // By frame; undefined where a packet was lost before anything was known of it.
  private readonly entries: (Entry | undefined)[] = [];
  private readonly damaged = new Set<number>();
  complete = false;

  /**
   * @param fps frames a second, for times that are not known yet
   * @param independent whether every packet stands alone, whatever its kind: codec `raw`
   */
  constructor(
    private readonly fps: number,
    private readonly independent: boolean,
  ) {}

  get count(): number {
    return this.entries.length;
  }

  /** Takes everything from an index; `end` is where the index record begins. */
  fill(index: readonly IndexEntry[], end: number): void {
    for (const [i, { isKey, offset }] of index.entries()) {
      this.entries.push({ isKey, offset, end: index[i + 1]?.offset ?? end, ptsSeconds: undefined });
    }
    this.complete = true;
  }

  /** Takes a packet that was found by reading; frames that it leaves out are lost. */
  append({ index, isKey, offset, bytes, ptsSeconds }: PacketInfo): void {
    while (this.entries.length < index) this.markDamaged(this.entries.push(undefined) - 1);
    this.entries.push({ isKey, offset, end: offset + bytes, ptsSeconds });
  }

  /** The bytes in which a frame's packet is. */
  place(index: number): { readonly start: number; readonly end: number } | undefined {
    const entry = this.entries[index];
    return entry && { start: entry.offset, end: entry.end };
  }

  isKey(index: number): boolean {
    return this.entries[index]?.isKey === true;
  }

  learn(index: number, ptsSeconds: number): void {
    const entry = this.entries[index];
    if (entry) entry.ptsSeconds = ptsSeconds;
  }

  markDamaged(index: number): void {
    this.damaged.add(index);
  }

  isDamaged(index: number): boolean {
    return this.damaged.has(index);
  }

  /** The first packet that a frame needs. */
  groupStart(index: number): number {
    let first = index;
    while (!this.independent && first > 0 && !this.isKey(first)) first--;
    return first;
  }

  /** The frame after the last that needs a packet like this one. */
  groupEnd(index: number): number {
    let end = index + 1;
    while (!this.independent && end < this.count && !this.isKey(end)) end++;
    return end;
  }

  /** Whether a frame cannot be shown because of a packet that it needs. */
  isLost(index: number): boolean {
    if (!this.damaged.size) return false;
    for (let i = this.groupStart(index); i <= index; i++) if (this.damaged.has(i)) return true;
    return false;
  }

  /** The frame to show for one that is lost: the last before it, or else the first after it. */
  shownFor(index: number): number | undefined {
    for (let i = Math.min(index, this.count - 1); i >= 0; i--) if (!this.isLost(i)) return i;
    for (let i = index + 1; i < this.count; i++) if (!this.isLost(i)) return i;
    return undefined;
  }

  facts(): CatalogFacts {
    const ptsSeconds = new Float64Array(this.count);
    const keys: number[] = [];
    for (const [i, entry] of this.entries.entries()) {
      const after = i ? ptsSeconds[i - 1]! + 1 / this.fps : 0;
      // Guesses may be beyond a time that is known: time must rise all the same.
      ptsSeconds[i] = Math.max(entry?.ptsSeconds ?? after, i ? ptsSeconds[i - 1]! + 1e-9 : Number.NEGATIVE_INFINITY);
      if (entry?.isKey) keys.push(i);
    }
    return { ptsSeconds, keys: Uint32Array.from(keys), lost: this.lost(), complete: this.complete };
  }

  private lost(): FrameRange[] {
    const ranges: FrameRange[] = [];
    for (const index of [...this.damaged].sort((a, b) => a - b)) {
      const last = ranges.at(-1);
      const end = this.groupEnd(index);
      if (!last || index > last[1]) ranges.push([index, end]);
      else if (end > last[1]) ranges[ranges.length - 1] = [last[0], end];
    }
    return ranges;
  }
}
