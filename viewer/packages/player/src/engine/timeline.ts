// SPDX-License-Identifier: Apache-2.0
/** Frames and their times. */

import type { CatalogFacts, FrameRange } from "../decode/messages.js";

export class Timeline {
  private facts: CatalogFacts = { ptsSeconds: new Float64Array(), keys: new Uint32Array(), lost: [], complete: false };

  constructor(private readonly fps: number) {}

  take(facts: CatalogFacts): void {
    this.facts = facts;
  }

  get count(): number {
    return this.facts.ptsSeconds.length;
  }

  /** Whether no more frames will come. */
  get complete(): boolean {
    return this.facts.complete;
  }

  get keys(): Uint32Array {
    return this.facts.keys;
  }

  get lost(): readonly FrameRange[] {
    return this.facts.lost;
  }

  /** When the last frame is over, in seconds. */
  get duration(): number {
    return this.count ? this.ptsOf(this.count - 1) + this.lastFor() : 0;
  }

  ptsOf(index: number): number {
    return this.facts.ptsSeconds[index] ?? 0;
  }

  /** When a frame is over. */
  endOf(index: number): number {
    return index + 1 < this.count ? this.ptsOf(index + 1) : this.duration;
  }

  /** The frame that is shown at a time: the last one that has begun, and the first before all. */
  frameAt(seconds: number): number {
    // Times that come from frames must lead back to them, whatever was added and taken away meanwhile.
    const time = seconds + 1e-6;
    let [low, high] = [0, this.count - 1];
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.ptsOf(middle) <= time) low = middle;
      else high = middle - 1;
    }
    return Math.max(low, 0);
  }

  private lastFor(): number {
    return 1 / this.fps;
  }
}
