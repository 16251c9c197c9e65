// SPDX-License-Identifier: Apache-2.0
/** The packets of a stream, their positions, and the frames that can be shown. */

import type { FileEntry } from "../source/manifest.js";
import type { CatalogFacts, FrameRange } from "./messages.js";

/** The bytes of a packet: in a file next to a manifest, or in the file of the stream. */
export interface Place {
  readonly start: number;
  readonly end: number;
  readonly entry?: FileEntry;
}

export abstract class Catalog {
  private readonly damaged = new Set<number>();
  complete = false;
  /** The first available frame. */
  first = 0;

  /** The number after that of the last frame. */
  abstract readonly count: number;
  /** Position of a frame's packet, if known. */
  abstract place(index: number): Place | undefined;
  abstract isKey(index: number): boolean;
  /** The first packet that a frame needs. */
  abstract groupStart(index: number): number;
  /** The frame after the last one that needs this frame's packet. */
  abstract groupEnd(index: number): number;
  abstract facts(): CatalogFacts;

  markDamaged(first: number, end = first + 1): void {
    for (let i = first; i < end; i++) this.damaged.add(i);
  }

  isDamaged(index: number): boolean {
    return this.damaged.has(index);
  }

  /** Whether a frame cannot be shown because of a packet that it needs. */
  isLost(index: number): boolean {
    if (!this.damaged.size) return false;
    for (let i = this.groupStart(index); i <= index; i++) if (this.damaged.has(i)) return true;
    return false;
  }

  /** The frame to show instead of a lost one: the last before it, else the first after it. */
  shownFor(index: number): number | undefined {
    for (let i = Math.min(index, this.count - 1); i >= this.first; i--) if (!this.isLost(i)) return i;
    for (let i = Math.max(index + 1, this.first); i < this.count; i++) if (!this.isLost(i)) return i;
    return undefined;
  }

  protected forgetDamage(before: number): void {
    for (const index of this.damaged) if (index < before) this.damaged.delete(index);
  }

  protected lost(): FrameRange[] {
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
