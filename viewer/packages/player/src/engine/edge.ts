// SPDX-License-Identifier: Apache-2.0
/** The edge of a growing stream: estimates the time of its next frame, and controls the clock to follow it. */

import type { Timeline } from "./timeline.js";

const REMEMBERED = 8;
/** Number of last frames over which the pace of a growing file is measured. */
const PACE = 4;
/** Ratios of wall-clock to media time at which a stream starts and stops counting as slower than its media. */
const SLOWER = 1.3;
const QUICK_AGAIN = 1.1;
/** Target distance of clock and edge: a multiple of the longest recent step between frames, plus a constant. */
const STEPS = 1.5;
const SPARE_SECONDS = 0.25;
/** A longer step counts as an outage. */
const MAX_STEP_SECONDS = 10;
/** Increase of the target distance with each stall. */
const STALL_SECONDS = 0.5;
const MAX_STALL_SECONDS = 4;
/** Deviation from the target distance above which the clock runs faster until it has caught up. */
const SLACK_SECONDS = 0.75;
const FASTEST = 1.1;
/** Deviation above which the clock jumps to a key frame, if that is nearer to the target. */
const JUMP_SECONDS = 5;
const MIN_GAIN_SECONDS = 1;

/** Frames with at least this spacing in media time are shown on arrival, because motion is not smooth anyway. */
const SPARSE_SECONDS = 0.8;

/** The displayed frame may leave the window; playback then continues this share of the window after its start. */
const LEFT_SHARE = 0.1;

/** Control of the clock: a rate, or a jump to another frame with its reason. */
export type Pace = { readonly rate: number; readonly to?: undefined } | { readonly to: number; readonly why?: string };

export class Edge {
  /** Whether the clock follows the edge of a live stream; otherwise it plays from where the viewer has chosen. */
  follow = true;
  /** Whether everything written so far was read. */
  reached = false;
  private readonly arrivals: number[] = [];
  private count = 0;
  private stalls = 0;
  private catching = false;
  private slow = false;

  constructor(private readonly timeline: Timeline) {}

  /** Called when the timeline may have new frames; `now` is seconds of any clock. */
  changed(now: number): void {
    const { count, live } = this.timeline;
    this.reached ||= live?.live === true;
    if (live) this.slow = (live.frameSeconds ?? 0) > (this.slow ? QUICK_AGAIN : SLOWER) * live.mediaSeconds;
    // Frames that existed at opening do not count for the pace.
    if (this.reached && this.count && count > this.count) {
      this.arrivals.push(now);
      if (this.arrivals.length > REMEMBERED) this.arrivals.shift();
    }
    this.count = count;
  }

  /** Whether frames may still be appended, and all existing ones were read. */
  get grows(): boolean {
    return this.reached && !this.timeline.complete;
  }

  /** Whether frames will be added to a stream with a manifest. */
  get live(): boolean {
    return this.timeline.live?.live === true;
  }

  /** Whether frames come about as fast as they are played, so that a distance to the edge can be maintained. */
  get flows(): boolean {
    return this.live && !this.slow && !this.sparse;
  }

  /** Whether the clock follows the edge. */
  get following(): boolean {
    return this.live && this.follow;
  }

  private get sparse(): boolean {
    return this.timeline.live!.mediaSeconds > SPARSE_SECONDS;
  }

  /** Start of the newest frame, seconds. */
  get seconds(): number {
    return this.timeline.ptsOf(this.timeline.count - 1);
  }

  /** Target distance of the clock from the newest frame, seconds. */
  get distance(): number {
    if (!this.flows) return 0;
    const step = this.arrivals.reduce((most, at, i) => Math.max(most, i ? at - this.arrivals[i - 1]! : 0), 0);
    const needed = STEPS * Math.min(step, MAX_STEP_SECONDS) + SPARE_SECONDS;
    return Math.max(this.timeline.live!.targetSeconds, needed) + this.stalls;
  }

  /** The frame to start with: the last key frame that is far enough behind the newest. */
  get start(): number {
    const { timeline, seconds, distance } = this;
    let found = timeline.keys[0] ?? timeline.first;
    for (const key of timeline.keys) if (timeline.ptsOf(key) <= seconds - distance) found = key;
    return found;
  }

  /** Control of the clock, which is at `seconds`; `rate` is the viewer's choice. */
  pace(seconds: number, rate: number): Pace {
    const { timeline } = this;
    if (timeline.first > 0 && seconds < timeline.start) {
      const to = timeline.frameAt(timeline.start + LEFT_SHARE * (timeline.duration - timeline.start));
      return { to, why: "The host no longer has this part of the stream: playback continues after it." };
    }
    if (!this.following || rate !== 1) return { rate };
    if (this.sparse && this.seconds > seconds) return { to: timeline.count - 1 };
    const behind = this.seconds - this.distance - seconds;
    if (behind > JUMP_SECONDS && timeline.ptsOf(this.start) > seconds + MIN_GAIN_SECONDS)
      return { to: this.start, why: "Playback fell behind and continues with the newest frames." };
    this.catching = behind > (this.catching ? 0 : SLACK_SECONDS);
    return { rate: this.catching ? Math.min(1 + behind / 10, FASTEST) : 1 };
  }

  /** The clock had to wait. */
  stalled(): void {
    if (this.following && this.flows) this.stalls = Math.min(this.stalls + STALL_SECONDS, MAX_STALL_SECONDS);
  }

  /** Seconds until the next frame; undefined if unknown, or if none will come. */
  nextIn(now: number): number | undefined {
    const last = this.arrivals.at(-1);
    const lately = this.arrivals.slice(-PACE);
    const mean = lately.length > 1 ? (last! - lately[0]!) / (lately.length - 1) : undefined;
    const step = this.timeline.live?.frameSeconds ?? mean;
    return step === undefined || last === undefined || !this.grows ? undefined : Math.max(last + step - now, 0);
  }
}
