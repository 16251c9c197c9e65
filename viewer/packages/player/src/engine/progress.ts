// SPDX-License-Identifier: Apache-2.0
/** The target of a seek, and the progress towards it. */

export class Progress {
  /** Number of the last seek. */
  serial = 0;
  /** The target of the last seek. */
  target = 0;
  seeking = false;
  /** The last frame that can be drawn or is known to be lost. */
  reached = -1;
  /** The frame that was drawn last. */
  shown = -1;

  /** Starts a seek to frame `target`. */
  seek(target: number): void {
    this.serial++;
    this.target = target;
    this.reached = target - 1;
    this.seeking = true;
  }

  /** Records that frames up to `index` can be drawn or are lost. */
  reach(index: number): void {
    this.reached = Math.max(this.reached, index);
  }

  /** Records that the target is reached. */
  arrive(): void {
    this.seeking = false;
    this.reach(this.target);
    if (this.target < this.shown) this.shown = -1;
  }

  /**
   * Whether drawing the received frame `index` would be a step back. The decoder starts at a key frame
   * again after a seek or a switch to another rendition, although it has decoded that frame before.
   */
  isBack(index: number, exact: boolean): boolean {
    return index < this.shown && !(this.seeking && (exact || this.target < this.shown));
  }
}
