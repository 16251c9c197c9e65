// SPDX-License-Identifier: Apache-2.0
/** Which packets a stream has, where they are, and which frames can be shown. */

import type { FileEntry } from "../source/manifest.js";
import type { CatalogFacts, FrameRange } from "./messages.js";

/** The bytes in which a packet is: of one file beside a manifest, or of the file that is the stream. */
export interface Place {
  readonly start: number;
  readonly end: number;
  readonly entry?: FileEntry;
}

export abstract class Catalog {
  private readonly damaged = new Set<number>();
  complete = false;
  /** The first frame that there still is. */
  first = 0;

  /** The number after the last frame's. */
  abstract readonly count: number;
  /** Where a frame's packet is, if that is known. */
  abstract place(index: number): Place | undefined;
  abstract isKey(index: number): boolean;
  /** Takes the time that stands in a packet. */
  abstract learn(index: number, ptsSeconds: number): void;
  /** The first packet that a frame needs. */
  abstract groupStart(index: number): number;
  /** The frame after the last that needs a packet like this one. */
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

  /** The frame to show for one that is lost: the last before it, or else the first after it. */
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
