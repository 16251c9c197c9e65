// SPDX-License-Identifier: Apache-2.0
/** Decides when a clock may continue after a stall. */

import type { Edge } from "./edge.js";
import type { StoredFrames } from "./storedFrames.js";
import type { Timeline } from "./timeline.js";

/** Buffer to wait for after a stall, so that the next one does not follow immediately. */
const REBUFFER_SECONDS = 0.5;
const MAX_REBUFFER_SECONDS = 3;

export class Rebuffering {
  /** Time since which it could continue. */
  private since: number | undefined;

  constructor(
    private readonly timeline: Timeline,
    private readonly stored: StoredFrames,
    private readonly edge: Edge,
  ) {}

  /** Resets at the start or end of a wait. */
  begin(): void {
    this.since = undefined;
  }

  /**
   * @param time time of the clock
   * @param rate rate of the clock
   * @param reached the last frame that can be drawn
   * @param ahead the frame after the last requested one
   * @param now seconds of any clock
   */
  isOver(time: number, rate: number, reached: number, ahead: number, now: number): boolean {
    const { timeline, edge } = this;
    const frame = timeline.frameAt(time);
    if (reached <= frame) return frame >= timeline.count - 1 && timeline.complete;
    this.since ??= now;
    if (now - this.since > MAX_REBUFFER_SECONDS) return true;
    if (edge.flows) return edge.seconds - time >= Math.min(edge.distance, REBUFFER_SECONDS);
    const enough = Math.min(timeline.frameAt(time + REBUFFER_SECONDS * rate), ahead - 1);
    // The store may be too small for this buffer.
    return edge.grows || reached >= enough || this.stored.has(enough);
  }
}
