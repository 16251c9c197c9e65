// SPDX-License-Identifier: Apache-2.0
/** The end of a stream that is still growing: when its next frame may come. */

const REMEMBERED = 4;

export class GrowingEdge {
  private readonly arrivals: number[] = [];
  private count = 0;
  /** Whether all that has been written was read. */
  reached = false;

  /** @param now seconds of any clock */
  frames(count: number, now: number): void {
    // What was there when the stream was opened says nothing of how fast it grows.
    if (this.reached && count > this.count) {
      this.arrivals.push(now);
      if (this.arrivals.length > REMEMBERED) this.arrivals.shift();
    }
    this.count = count;
  }

  /** Seconds until the next frame, by the pace of the last ones; undefined while that is not known. */
  nextIn(now: number): number | undefined {
    const [first, last] = [this.arrivals[0], this.arrivals.at(-1)];
    if (first === undefined || last === undefined || this.arrivals.length < 2) return undefined;
    const pace = (last - first) / (this.arrivals.length - 1);
    return Math.max(last + pace - now, 0);
  }
}
