// SPDX-License-Identifier: Apache-2.0
/** Number of frames to decode and fetch in advance. */

import type { Demand } from "../decode/messages.js";
import type { Timeline } from "./timeline.js";

/** Time for which packets are fetched in advance. */
const AHEAD_SECONDS = 10;
/** Decoded frames in the queue: few are sufficient to even out decoding, and each needs memory. */
const LEAD_SECONDS = 0.15;
const MIN_LEAD = 3;
const MAX_LEAD = 8;

/**
 * The demand of a stream whose clock is at frame `at`.
 *
 * @param rate rate of the clock; undefined while paused
 */
export function demandOf(timeline: Timeline, serial: number, at: number, rate: number | undefined): Demand {
  if (rate === undefined) return { serial, at, until: at + 1, ahead: at + 1 };
  const { count, first, duration, start } = timeline;
  const lead = Math.ceil((LEAD_SECONDS * rate * (count - first)) / Math.max(duration - start, 1e-3));
  const until = at + 1 + Math.min(Math.max(lead, MIN_LEAD), MAX_LEAD);
  const ahead = Math.max(timeline.frameAt(timeline.ptsOf(at) + AHEAD_SECONDS * rate) + 1, until);
  return { serial, at, until, ahead };
}
