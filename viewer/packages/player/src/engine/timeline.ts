// SPDX-License-Identifier: Apache-2.0
/** Frames and their times. */

import type { CatalogFacts, FrameRange, LiveFacts } from "../decode/messages.js";

export class Timeline {
  private facts: CatalogFacts = {
    first: 0,
    count: 0,
    ptsSeconds: new Float64Array(),
    keys: new Uint32Array(),
    lost: [],
    complete: false,
  };

  /** Frames per second, for the duration of the last frame. */
  fps = 1;

  take(facts: CatalogFacts): void {
    this.facts = facts;
  }

  /** The first available frame. */
  get first(): number {
    return this.facts.first;
  }

  /** The number after that of the last frame. */
  get count(): number {
    return this.facts.count;
  }

  /** Start of the first frame, seconds. */
  get start(): number {
    return this.ptsOf(this.first);
  }

  /** Whether no further frames will come. */
  get complete(): boolean {
    return this.facts.complete;
  }

  get keys(): Uint32Array {
    return this.facts.keys;
  }

  /** Growth of the stream, if it has a manifest. */
  get live(): LiveFacts | undefined {
    return this.facts.live;
  }

  get lost(): readonly FrameRange[] {
    return this.facts.lost;
  }

  /** End of the last frame, seconds. */
  get duration(): number {
    return this.count ? this.ptsOf(this.count - 1) + this.lastFor() : 0;
  }

  ptsOf(index: number): number {
    const { frames, ptsSeconds } = this.facts;
    if (!frames) return ptsSeconds[index] ?? 0;
    const at = lastBefore(frames, index);
    const [frame, next] = [frames[at] ?? 0, frames[at + 1]];
    const seconds = ptsSeconds[at] ?? 0;
    if (next === undefined || index <= frame) return seconds;
    return seconds + ((index - frame) / (next - frame)) * (ptsSeconds[at + 1]! - seconds);
  }

  /** End of a frame, seconds. */
  endOf(index: number): number {
    return index + 1 < this.count ? this.ptsOf(index + 1) : this.duration;
  }

  /** The frame at a time: the last one that has started, or the first for earlier times. */
  frameAt(seconds: number): number {
    // Times of frames must map back to these frames after any additions and removals.
    const time = seconds + 1e-6;
    const { frames, ptsSeconds, first } = this.facts;
    const at = lastBefore(ptsSeconds, time);
    if (!frames) return at;
    const [frame, next] = [frames[at] ?? 0, frames[at + 1]];
    const share = next === undefined ? 0 : (time - ptsSeconds[at]!) / (ptsSeconds[at + 1]! - ptsSeconds[at]!);
    const within = Math.min(Math.floor(share * ((next ?? 0) - frame)), (next ?? 0) - frame - 1);
    return Math.max(frame + Math.max(within, 0), first);
  }

  private lastFor(): number {
    return 1 / (this.live?.fps ?? this.fps);
  }
}

/** Index of the last value not above `limit`; 0 if there is none. */
function lastBefore(values: Float64Array, limit: number): number {
  let [low, high] = [0, values.length - 1];
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (values[middle]! <= limit) low = middle;
    else high = middle - 1;
  }
  return low;
}
