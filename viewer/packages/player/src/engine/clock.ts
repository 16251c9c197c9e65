// SPDX-License-Identifier: Apache-2.0
/** Media time, which advances at a rate relative to a given clock. */

export class MediaClock {
  private base = 0;
  private since: number | undefined;
  private factor = 1;

  get running(): boolean {
    return this.since !== undefined;
  }

  get rate(): number {
    return this.factor;
  }

  /** @param now seconds of any clock, as in every other method */
  setRate(rate: number, now: number): void {
    this.base = this.at(now);
    this.factor = rate;
    if (this.since !== undefined) this.since = now;
  }

  at(now: number): number {
    return this.since === undefined ? this.base : this.base + (now - this.since) * this.factor;
  }

  set(seconds: number, now: number): void {
    this.base = seconds;
    if (this.since !== undefined) this.since = now;
  }

  start(now: number): void {
    this.since ??= now;
  }

  stop(now: number): void {
    this.base = this.at(now);
    this.since = undefined;
  }
}
