// SPDX-License-Identifier: Apache-2.0

/** Calls immediately if the last call is some time ago; otherwise once later, for all calls until then. */
export class Throttle {
  private last = Number.NEGATIVE_INFINITY;
  private later: ReturnType<typeof setTimeout> | undefined;

  constructor(
    private readonly milliseconds: number,
    private readonly action: () => void,
  ) {}

  call(): void {
    if (this.later !== undefined) return;
    const wait = this.last + this.milliseconds - performance.now();
    if (wait <= 0) this.act();
    else this.later = setTimeout(() => this.act(), wait);
  }

  private act(): void {
    this.later = undefined;
    this.last = performance.now();
    this.action();
  }
}
