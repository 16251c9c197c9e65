// SPDX-License-Identifier: Apache-2.0
/** Recent throughput while data is awaited, bits per second, and the share of time in which it is. */

/** Time constant of the average, in seconds of waiting. */
const REMEMBERED_SECONDS = 6;
/** Half-life of a measurement in wall-clock seconds, because small streams rarely wait for packets. */
const HALF_LIFE_SECONDS = 10;
/** Smallest number of bytes of a measurement, unless they took long. */
const MIN_BYTES = 30_000;
const ENOUGH_SECONDS = 10;

export class Throughput {
  private active = 0;
  private since = 0;
  private seconds = 0;
  /** Elapsed time, waiting or not. */
  private wallSeconds = 0;
  private bytes = 0;
  private known = false;
  private readonly began: number;

  /** @param now seconds of any clock */
  constructor(private readonly now: () => number = () => performance.now() / 1000) {
    this.began = this.since = now();
  }

  /** A reading starts; others may be active. */
  begin(): void {
    this.count();
    this.active++;
  }

  take(bytes: number): void {
    this.count();
    this.bytes += bytes;
  }

  end(): void {
    this.count();
    this.active--;
  }

  /** Undefined while there is too little data. */
  get bitsPerSecond(): number | undefined {
    this.count();
    return this.known && this.seconds > 0 ? (8 * this.bytes) / this.seconds : undefined;
  }

  /** The share of time, 0 to 1, in which data is awaited. */
  get busyShare(): number {
    this.count();
    return this.wallSeconds > 0 ? this.seconds / this.wallSeconds : 1;
  }

  private count(): void {
    const now = this.now();
    const passed = now - this.since;
    this.since = now;
    this.scale(0.5 ** (passed / HALF_LIFE_SECONDS));
    this.wallSeconds += passed;
    if (this.active) this.seconds += passed;
    this.known ||= this.bytes >= MIN_BYTES || this.seconds > REMEMBERED_SECONDS / 2;
    this.known ||= this.bytes > 0 && now - this.began > ENOUGH_SECONDS;
    if (this.seconds > REMEMBERED_SECONDS) this.scale(REMEMBERED_SECONDS / 2 / this.seconds);
  }

  private scale(share: number): void {
    this.seconds *= share;
    this.wallSeconds *= share;
    this.bytes *= share;
  }
}
