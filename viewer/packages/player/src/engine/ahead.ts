// SPDX-License-Identifier: Apache-2.0
/** How many frames are wanted before their time. */

import type { Demand } from "../decode/messages.js";
import type { Timeline } from "./timeline.js";

const AHEAD_SECONDS = 10;
/** Decoded frames wait in a queue, which takes memory: few are enough to even out decoding. */
const LEAD_SECONDS = 0.15;
const LEAST_LEAD = 3;
const MOST_LEAD = 8;

/**
 * What is wanted of a stream whose clock is at frame `at`.
 *
 * @param rate of the clock; undefined while nothing is played
 * @param aheadSeconds packets are fetched for so long ahead
 */
export function demandOf(
  timeline: Timeline,
  serial: number,
  at: number,
  rate: number | undefined,
  aheadSeconds = AHEAD_SECONDS,
): Demand {
  if (rate === undefined) return { serial, at, until: at + 1, ahead: at + 1 };
  const { count, first, duration, start } = timeline;
  const lead = Math.ceil((LEAD_SECONDS * rate * (count - first)) / Math.max(duration - start, 1e-3));
  const until = at + 1 + Math.min(Math.max(lead, LEAST_LEAD), MOST_LEAD);
  const ahead = Math.max(timeline.frameAt(timeline.ptsOf(at) + aheadSeconds * rate) + 1, until);
  return { serial, at, until, ahead };
}
