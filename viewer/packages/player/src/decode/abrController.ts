// SPDX-License-Identifier: Apache-2.0
/** Chooses the rendition by the throughput of the connection (adaptive bit rate). */

import type { Quality } from "../source/manifest.js";

/** A connection must bear so many times a quality's bit rate to go up to it, and no fewer to stay. */
const UP = 1.6;
const STAY = 1.15;
/** Seconds between changes: up only when it has held for a while, after going down for longer. */
const UP_SECONDS = 4;
const AGAIN_SECONDS = 20;
const DOWN_SECONDS = 2;
/**
 * Small packets say little of what a connection bears. Where it is hardly used the next quality is tried: what it needs
 * is fetched beside the packets that are shown. After a failure twice as long passes until it is tried again.
 */
const IDLE_SHARE = 0.3;
/** What is tried has to be there by then. */
const TRIAL_LIMIT_SECONDS = 15;
/** A connection bears at most so many times what small packets say. */
const UNDERESTIMATED = 16;
const TRIAL_SECONDS = 10;
const MOST_TRIAL_SECONDS = 320;
/** One that could not be had for a reason that may go away is tried again. */
const RETRY_SECONDS = 2;

export class AbrController {
  /** By rising bit rate. */
  steps: readonly Quality[];
  /** What the user wants; undefined leaves it to the connection. */
  choice: number | undefined;
  at = 0;
  /** Since when the step above is tried, though it is not known to be borne. */
  private tryingSince: number | undefined;
  /** So long after the last trial or change the next one is due. */
  private trialSeconds = TRIAL_SECONDS;
  private tried: number;
  private changed: number;
  private fell = false;
  /** Until when, by step. */
  private readonly refused = new Map<number, number>();

  /** @param now seconds of any clock */
  constructor(
    qualities: readonly Quality[],
    private readonly now: () => number,
  ) {
    this.steps = [...qualities].sort((a, b) => a.bits_per_second - b.bits_per_second);
    this.changed = this.tried = now();
  }

  /** The step to be on; `bitsPerSecond` is undefined while nothing is known. */
  wanted(bitsPerSecond: number | undefined, busyShare: number): number {
    const { at, steps, choice, tryingSince } = this;
    this.tryingSince = undefined;
    if (choice !== undefined) return this.granted(choice);
    if (bitsPerSecond === undefined) return at;
    const now = this.now();
    const since = now - this.changed;
    const bears = (step: number, factor: number) => bitsPerSecond >= factor * steps[step]!.bits_per_second;
    if (at > 0 && !bears(at, STAY)) {
      let lower = at - 1;
      while (lower > 0 && !bears(lower, STAY)) lower--;
      return since >= DOWN_SECONDS ? this.granted(lower) : at;
    }
    const higher = at + 1;
    const enough = since >= (this.fell ? AGAIN_SECONDS : UP_SECONDS);
    if (higher >= steps.length) return at;
    if (enough && bears(higher, UP)) return this.granted(higher);
    if (tryingSince !== undefined && now - tryingSince > TRIAL_LIMIT_SECONDS) {
      this.giveUp();
      return at;
    }
    const maybe = busyShare < IDLE_SHARE && bears(higher, 1 / UNDERESTIMATED);
    const isDue = maybe && now - this.tried >= this.trialSeconds;
    if ((tryingSince === undefined && !isDue) || this.granted(higher) !== higher) return at;
    this.tryingSince = tryingSince ?? now;
    return higher;
  }

  /** What is known now of the bit rates, which are measured while the run goes on. */
  measured(qualities: readonly Quality[]): void {
    this.steps = this.steps.map((step) => {
      const found = qualities.find(({ name }) => name === step.name);
      return { ...step, bits_per_second: found?.bits_per_second ?? step.bits_per_second };
    });
  }

  /** Another step is used from now on. */
  change(step: number): void {
    const now = this.now();
    this.fell = step < this.at;
    // What has been borne for long was no failure.
    if (this.fell && now - this.changed > MOST_TRIAL_SECONDS) this.trialSeconds = TRIAL_SECONDS;
    else if (this.fell) this.giveUp();
    this.at = step;
    this.tryingSince = undefined;
    this.changed = this.tried = now;
  }

  /** A step cannot be had, for now or ever. */
  refuse(step: number, temporary: boolean): void {
    this.refused.set(step, temporary ? this.now() + RETRY_SECONDS : Number.POSITIVE_INFINITY);
  }

  private giveUp(): void {
    this.tried = this.now();
    this.trialSeconds = Math.min(2 * this.trialSeconds, MOST_TRIAL_SECONDS);
  }

  private granted(step: number): number {
    return this.now() < (this.refused.get(step) ?? 0) ? this.at : step;
  }
}
