// SPDX-License-Identifier: Apache-2.0
/** When a clock that had to wait may go on. */

import type { Edge } from "./edge.js";
import type { StoredFrames } from "./storedFrames.js";
import type { Timeline } from "./timeline.js";

/** After a stall so much is waited for, or the next one would follow at once. */
const REBUFFER_SECONDS = 0.5;
const MOST_REBUFFER_SECONDS = 3;

export class Rebuffering {
  /** Since when it could go on. */
  private since: number | undefined;

  constructor(
    private readonly timeline: Timeline,
    private readonly stored: StoredFrames,
    private readonly edge: Edge,
  ) {}

  /** Another wait begins, or none goes on. */
  begin(): void {
    this.since = undefined;
  }

  /**
   * @param time of the clock
   * @param rate of the clock
   * @param reached the last frame that can be drawn
   * @param ahead the frame after the last that was asked for
   * @param now seconds of any clock
   */
  isOver(time: number, rate: number, reached: number, ahead: number, now: number): boolean {
    const { timeline, edge } = this;
    const frame = timeline.frameAt(time);
    if (reached <= frame) return frame >= timeline.count - 1 && timeline.complete;
    this.since ??= now;
    if (now - this.since > MOST_REBUFFER_SECONDS) return true;
    if (edge.flows) return edge.seconds - time >= Math.min(edge.distance, REBUFFER_SECONDS);
    const enough = Math.min(timeline.frameAt(time + REBUFFER_SECONDS * rate), ahead - 1);
    // A store may be too small for that much.
    return edge.grows || reached >= enough || this.stored.has(enough);
  }
}
