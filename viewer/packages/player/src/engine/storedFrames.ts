// SPDX-License-Identifier: Apache-2.0
/** The frames whose packets were fetched. */

import type { FrameRange } from "../decode/messages.js";
import type { TimeRange } from "./events.js";
import type { Timeline } from "./timeline.js";

export class StoredFrames {
  ranges: readonly FrameRange[] = [];
  /** Total number of bytes fetched so far. */
  fetchedBytes = 0;

  constructor(private readonly timeline: Timeline) {}

  has(index: number): boolean {
    return this.ranges.some(([first, end]) => index >= first && index < end);
  }

  /** The first frame from `index` on that was neither fetched nor lost. */
  missing(index: number): number {
    const known = [...this.ranges, ...this.timeline.lost].sort(([a], [b]) => a - b);
    return known.reduce((at, [first, end]) => (first <= at ? Math.max(at, end) : at), index);
  }

  /** Intervals of their times. */
  get times(): readonly TimeRange[] {
    const { timeline } = this;
    return this.ranges.map(([first, end]) => [timeline.ptsOf(first), timeline.endOf(end - 1)]);
  }
}
