// SPDX-License-Identifier: Apache-2.0
/** How many bits a second come while any are waited for, of late. */

/** What is older than about so many seconds of waiting counts less and less. */
const REMEMBERED_SECONDS = 6;
/** Fewer bytes say nothing, unless they took long. */
const LEAST_BYTES = 30_000;

export class Throughput {
  private active = 0;
  private since = 0;
  private seconds = 0;
  private bytes = 0;
  private known = false;

  /** @param now seconds of any clock */
  constructor(private readonly now: () => number = () => performance.now() / 1000) {}

  /** A reading begins; others may be under way. */
  begin(): void {
    if (!this.active++) this.since = this.now();
  }

  take(bytes: number): void {
    this.bytes += bytes;
  }

  end(): void {
    this.count();
    this.active--;
  }

  /** Undefined while too little has come. */
  get bitsPerSecond(): number | undefined {
    this.count();
    return this.known ? (8 * this.bytes) / Math.max(this.seconds, 1e-3) : undefined;
  }

  private count(): void {
    const now = this.now();
    if (this.active) this.seconds += now - this.since;
    this.since = now;
    this.known ||= this.bytes >= LEAST_BYTES || this.seconds > REMEMBERED_SECONDS / 2;
    if (this.seconds < REMEMBERED_SECONDS) return;
    const share = REMEMBERED_SECONDS / 2 / this.seconds;
    this.seconds *= share;
    this.bytes *= share;
  }
}
