// SPDX-License-Identifier: Apache-2.0
/** Chooses the rendition by the throughput of the connection (adaptive bit rate). */

import type { Quality } from "../source/manifest.js";

/** Throughput, as a multiple of a rendition's bit rate, that is needed to switch up to it, and to stay at it. */
const UP = 1.6;
const STAY = 1.15;
/** Seconds between switches; switching up needs a stable throughput, and takes longer after a switch down. */
const UP_SECONDS = 4;
const AGAIN_SECONDS = 20;
const DOWN_SECONDS = 2;
/**
 * Small packets determine the throughput poorly. If the connection is mostly idle, the next rendition is tried: its packets
 * are fetched in addition to the displayed ones. After a failure the time to the next trial doubles.
 */
const IDLE_SHARE = 0.3;
/** Time limit of a trial. */
const TRIAL_LIMIT_SECONDS = 15;
/** Upper bound of the throughput, as a multiple of that measured with small packets. */
const UNDERESTIMATED = 16;
const TRIAL_SECONDS = 10;
const MAX_TRIAL_SECONDS = 320;
/** Seconds after which a rendition with a temporary failure is tried again. */
const RETRY_SECONDS = 2;

export class AbrController {
  /** Bit rates, rising. */
  steps: readonly Quality[];
  /** The user's choice; undefined for automatic selection. */
  choice: number | undefined;
  at = 0;
  /** Start time of the present trial of the next step. */
  private tryingSince: number | undefined;
  /** Time from the last trial or switch to the next trial. */
  private trialSeconds = TRIAL_SECONDS;
  private tried: number;
  private changed: number;
  private fell = false;
  /** End time of the exclusion of each step. */
  private readonly refused = new Map<number, number>();

  /** @param now seconds of any clock */
  constructor(
    qualities: readonly Quality[],
    private readonly now: () => number,
  ) {
    this.steps = [...qualities].sort((a, b) => a.bits_per_second - b.bits_per_second);
    this.changed = this.tried = now();
  }

  /** The step to use; `bitsPerSecond` is undefined while the throughput is unknown. */
  wanted(bitsPerSecond: number | undefined, busyShare: number): number {
    const { at, steps, choice, tryingSince } = this;
    this.tryingSince = undefined;
    if (choice !== undefined) return this.granted(choice);
    if (bitsPerSecond === undefined) return at;
    const now = this.now();
    const since = now - this.changed;
    const sustains = (step: number, factor: number) => bitsPerSecond >= factor * steps[step]!.bits_per_second;
    if (at > 0 && !sustains(at, STAY)) {
      let lower = at - 1;
      while (lower > 0 && !sustains(lower, STAY)) lower--;
      return since >= DOWN_SECONDS ? this.granted(lower) : at;
    }
    const higher = at + 1;
    const enough = since >= (this.fell ? AGAIN_SECONDS : UP_SECONDS);
    if (higher >= steps.length) return at;
    if (enough && sustains(higher, UP)) return this.granted(higher);
    if (tryingSince !== undefined && now - tryingSince > TRIAL_LIMIT_SECONDS) {
      this.giveUp();
      return at;
    }
    const maybe = busyShare < IDLE_SHARE && sustains(higher, 1 / UNDERESTIMATED);
    const isDue = maybe && now - this.tried >= this.trialSeconds;
    if ((tryingSince === undefined && !isDue) || this.granted(higher) !== higher) return at;
    this.tryingSince = tryingSince ?? now;
    return higher;
  }

  /** Updates the bit rates, which are measured during the run. */
  measured(qualities: readonly Quality[]): void {
    this.steps = this.steps.map((step) => {
      const found = qualities.find(({ name }) => name === step.name);
      return { ...step, bits_per_second: found?.bits_per_second ?? step.bits_per_second };
    });
  }

  /** Record a switch to another step. */
  change(step: number): void {
    const now = this.now();
    this.fell = step < this.at;
    // A step that was used for long has not failed.
    if (this.fell && now - this.changed > MAX_TRIAL_SECONDS) this.trialSeconds = TRIAL_SECONDS;
    else if (this.fell) this.giveUp();
    this.at = step;
    this.tryingSince = undefined;
    this.changed = this.tried = now;
  }

  /** Record that a step is not available, temporarily or permanently. */
  refuse(step: number, temporary: boolean): void {
    this.refused.set(step, temporary ? this.now() + RETRY_SECONDS : Number.POSITIVE_INFINITY);
  }

  private giveUp(): void {
    this.tried = this.now();
    this.trialSeconds = Math.min(2 * this.trialSeconds, MAX_TRIAL_SECONDS);
  }

  private granted(step: number): number {
    return this.now() < (this.refused.get(step) ?? 0) ? this.at : step;
  }
}
