// SPDX-License-Identifier: Apache-2.0
/** Which frame is sought, and how far frames have come. */

export class Progress {
  /** Of the last seek. */
  serial = 0;
  /** The frame that was sought last. */
  target = 0;
  seeking = false;
  /** The last frame that can be drawn or need not be waited for. */
  reached = -1;
  /** The frame that was given to be drawn last. */
  shown = -1;

  /** Frame `target` is wanted. */
  seek(target: number): void {
    this.serial++;
    this.target = target;
    this.reached = target - 1;
    this.seeking = true;
  }

  /** Frames up to `index` can be drawn or need not be waited for. */
  reach(index: number): void {
    this.reached = Math.max(this.reached, index);
  }

  /** What was sought is there. */
  arrive(): void {
    this.seeking = false;
    this.reach(this.target);
    if (this.target < this.shown) this.shown = -1;
  }

  /**
   * Whether frame `index`, which has come, would be a step back on the way forward. The decoder begins with a key frame
   * again where another frame is sought, or another quality is taken, after it has decoded that frame.
   */
  isBack(index: number, exact: boolean): boolean {
    return index < this.shown && !(this.seeking && (exact || this.target < this.shown));
  }
}
