// SPDX-License-Identifier: Apache-2.0
/** A monotonic clock that is the sound card's while an AudioContext runs, so that pictures keep to what is heard. */

/** The part of an AudioContext that tells the time. */
export type TimedContext = Pick<AudioContext, "state" | "currentTime" | "baseLatency" | "outputLatency"> & {
  readonly getOutputTimestamp?: AudioContext["getOutputTimestamp"];
};

/** A stamp of the output that is farther from the context's time is none. */
const MAX_LATENCY_SECONDS = 1;
const MAX_LEAD_SECONDS = 0.05;
/** A context that runs and whose time stands still for so long has lost its device. */
const STUCK_SECONDS = 0.5;

export class AudioClock {
  private context: TimedContext | undefined;
  /** What is added to wall time, or to the context's time while it is followed. */
  private wallOffset = 0;
  private base: number | undefined;
  private last = Number.NEGATIVE_INFINITY;
  private heard = -1;
  private heardAt = 0;

  /** @param wall seconds of a monotonic clock, that of `performance` */
  constructor(private readonly wall: () => number) {}

  follow(context: TimedContext | undefined): void {
    this.context = context;
    this.heard = -1;
  }

  /** Seconds; without a running context as fast as `wall`. */
  now(): number {
    const wall = this.wall();
    const heard = this.heardTime(wall);
    if (heard === undefined) {
      if (this.base !== undefined) this.wallOffset = this.last - wall;
      this.base = undefined;
      this.last = Math.max(this.last, wall + this.wallOffset);
    } else {
      this.base ??= Math.max(this.last, wall + this.wallOffset) - heard;
      this.last = Math.max(this.last, heard + this.base);
    }
    return this.last;
  }

  /** The context's time at which a sound must be played to be heard at `seconds` of this clock. */
  contextTime(seconds: number): number | undefined {
    return this.base === undefined ? undefined : seconds - this.base;
  }

  /** The context's time of what is heard now; undefined unless it runs. */
  private heardTime(wall: number): number | undefined {
    const { context } = this;
    if (context?.state !== "running") return undefined;
    const { currentTime } = context;
    if (currentTime !== this.heard) {
      this.heard = currentTime;
      this.heardAt = wall;
    } else if (wall - this.heardAt > STUCK_SECONDS) return undefined;
    const stamp = context.getOutputTimestamp?.();
    if (stamp?.contextTime && stamp.performanceTime) {
      const heard = stamp.contextTime + wall - stamp.performanceTime / 1000;
      if (heard > currentTime - MAX_LATENCY_SECONDS && heard < currentTime + MAX_LEAD_SECONDS) return heard;
    }
    return currentTime - (context.outputLatency || context.baseLatency || 0);
  }
}
