// SPDX-License-Identifier: Apache-2.0
/** The end of a stream that is still growing: when its next frame may come, and how playing keeps to it. */

import type { Timeline } from "./timeline.js";

const REMEMBERED = 8;
/** The pace of a growing file is that of so many last frames. */
const PACE = 4;
/** A stream whose frames take so many times as long as they play is slower than its media, until they take less again. */
const SLOWER = 1.3;
const QUICK_AGAIN = 1.1;
/** Frames come in steps: so many of the longest step of late, and so much more, should lie between clock and edge. */
const STEPS = 1.5;
const SPARE_SECONDS = 0.25;
/** A longer one was an outage. */
const MOST_STEP_SECONDS = 10;
/** Each stall lets the clock fall back so much farther. */
const STALL_SECONDS = 0.5;
const MOST_STALL_SECONDS = 4;
/** From so much behind where it should be, the clock goes faster, until it is there. */
const SLACK_SECONDS = 0.75;
const FASTEST = 1.1;
/** From so much behind, it jumps to a key frame, if that gains something. */
const JUMP_SECONDS = 5;
const LEAST_GAIN_SECONDS = 1;

/** Frames that are so far apart in the media are shown as soon as they are there: no motion has to be kept even. */
const SPARSE_SECONDS = 0.8;

/** What is shown may leave the window: from its beginning it is gone on so much of it later. */
const LEFT_SHARE = 0.1;

/** How the clock is to go on: so many times as fast as the media, or from another frame, and why. */
export type Pace = { readonly rate: number; readonly to?: undefined } | { readonly to: number; readonly why?: string };

export class Edge {
  /** Whether the clock is to keep to the edge of a live stream; otherwise it plays what the viewer has chosen. */
  follow = true;
  /** Whether all that has been written was read. */
  reached = false;
  private readonly arrivals: number[] = [];
  private count = 0;
  private stalls = 0;
  private catching = false;
  private slow = false;

  constructor(private readonly timeline: Timeline) {}

  /** The timeline may have more frames than before; `now` is seconds of any clock. */
  changed(now: number): void {
    const { count, live } = this.timeline;
    this.reached ||= live?.live === true;
    if (live) this.slow = (live.frameSeconds ?? 0) > (this.slow ? QUICK_AGAIN : SLOWER) * live.mediaSeconds;
    // What was there when the stream was opened says nothing of how fast it grows.
    if (this.reached && this.count && count > this.count) {
      this.arrivals.push(now);
      if (this.arrivals.length > REMEMBERED) this.arrivals.shift();
    }
    this.count = count;
  }

  /** Whether frames may still be appended, and all that there are have been read. */
  get grows(): boolean {
    return this.reached && !this.timeline.complete;
  }

  /** Whether frames still come to a stream that has a manifest. */
  get live(): boolean {
    return this.timeline.live?.live === true;
  }

  /** Whether they come about as fast as they play, so that a distance to the edge can be kept. */
  get flows(): boolean {
    return this.live && !this.slow && !this.sparse;
  }

  /** Whether the clock keeps to the edge. */
  get following(): boolean {
    return this.live && this.follow;
  }

  private get sparse(): boolean {
    return this.timeline.live!.mediaSeconds > SPARSE_SECONDS;
  }

  /** When the newest frame begins, in seconds. */
  get seconds(): number {
    return this.timeline.ptsOf(this.timeline.count - 1);
  }

  /** How many seconds the clock should be behind the newest frame. */
  get distance(): number {
    if (!this.flows) return 0;
    const step = this.arrivals.reduce((most, at, i) => Math.max(most, i ? at - this.arrivals[i - 1]! : 0), 0);
    const needed = STEPS * Math.min(step, MOST_STEP_SECONDS) + SPARE_SECONDS;
    return Math.max(this.timeline.live!.targetSeconds, needed) + this.stalls;
  }

  /** The frame to begin with: the last key frame that is far enough behind the newest. */
  get start(): number {
    const { timeline, seconds, distance } = this;
    let found = timeline.keys[0] ?? timeline.first;
    for (const key of timeline.keys) if (timeline.ptsOf(key) <= seconds - distance) found = key;
    return found;
  }

  /** How the clock, which is at `seconds`, is to go on; `rate` is what the viewer wants. */
  pace(seconds: number, rate: number): Pace {
    const { timeline } = this;
    if (timeline.first > 0 && seconds < timeline.start) {
      const to = timeline.frameAt(timeline.start + LEFT_SHARE * (timeline.duration - timeline.start));
      return { to, why: "The host no longer has this part of the stream: went on after it." };
    }
    if (!this.following || rate !== 1) return { rate };
    if (this.sparse && this.seconds > seconds) return { to: timeline.count - 1 };
    const behind = this.seconds - this.distance - seconds;
    if (behind > JUMP_SECONDS && timeline.ptsOf(this.start) > seconds + LEAST_GAIN_SECONDS)
      return { to: this.start, why: "This was too slow to keep up: went on with the newest frames." };
    this.catching = behind > (this.catching ? 0 : SLACK_SECONDS);
    return { rate: this.catching ? Math.min(1 + behind / 10, FASTEST) : 1 };
  }

  /** The clock had to wait. */
  stalled(): void {
    if (this.following && this.flows) this.stalls = Math.min(this.stalls + STALL_SECONDS, MOST_STALL_SECONDS);
  }

  /** Seconds until the next frame; undefined while that is not known, or where none comes. */
  nextIn(now: number): number | undefined {
    const last = this.arrivals.at(-1);
    const lately = this.arrivals.slice(-PACE);
    const mean = lately.length > 1 ? (last! - lately[0]!) / (lately.length - 1) : undefined;
    const step = this.timeline.live?.frameSeconds ?? mean;
    return step === undefined || last === undefined || !this.grows ? undefined : Math.max(last + step - now, 0);
  }
}
