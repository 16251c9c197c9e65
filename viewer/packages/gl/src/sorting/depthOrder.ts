// SPDX-License-Identifier: Apache-2.0
/** Sorting by depth: a counting sort with bins adapted to the depths, and a final insertion sort that makes it exact. */

const COARSE_BINS = 4096;
/** Largest number of places that the insertion moves a number: beyond it, depths in a bin differ only by rounding. */
const LONGEST_WALK = 64;

/** Reusable buffers, so that sorting allocates no memory. */
export class DepthSorter {
  private readonly coarse = new Uint32Array(COARSE_BINS);
  private readonly firsts = new Uint32Array(COARSE_BINS);
  private starts = new Uint32Array(0);
  private bins = new Uint32Array(0);

  /**
   * Writes the indices 0 to `count` - 1 of `depths` to `order`: far ones first, and later ones first among equals, which is
   * the reverse of a stable ascending order. Depths must be finite and not negative.
   */
  sort(depths: Float32Array, count: number, order: Uint32Array): void {
    if (count === 0) return;
    if (this.bins.length < count) {
      this.bins = new Uint32Array(count);
      this.starts = new Uint32Array(count + 1);
    }
    this.assignBins(depths, count);
    const { starts, bins } = this;
    starts.fill(0, 0, count + 1);
    for (let i = 0; i < count; i++) starts[bins[i]! + 1]!++;
    for (let i = 0; i < count; i++) starts[i + 1]! += starts[i]!;
    for (let i = 0; i < count; i++) {
      const place = starts[bins[i]!]!++;
      order[count - 1 - place] = i;
    }
    walk(depths, count, order);
  }

  /**
   * Every coarse bin has as many fine bins as numbers; `bins` ascend with the depth. Bits of positive floats are about
   * linear in their logarithms, so that a far background leaves enough bins for near content.
   */
  private assignBins(depths: Float32Array, count: number): void {
    const bits = new Uint32Array(depths.buffer, depths.byteOffset, count);
    let [low, high] = [bits[0]!, bits[0]!];
    for (let i = 1; i < count; i++) {
      const found = bits[i]!;
      if (found < low) low = found;
      if (found > high) high = found;
    }
    const { coarse, firsts, bins } = this;
    const scale = high > low ? (COARSE_BINS * (1 - 2 ** -20)) / (high - low) : 0;
    coarse.fill(0);
    for (let i = 0; i < count; i++) coarse[((bits[i]! - low) * scale) | 0]!++;
    for (let c = 0, sum = 0; c < COARSE_BINS; sum += coarse[c++]!) firsts[c] = sum;
    for (let i = 0; i < count; i++) {
      const at = (bits[i]! - low) * scale;
      const c = at | 0;
      bins[i] = firsts[c]! + (((at - c) * coarse[c]!) | 0);
    }
  }
}

/** Insertion sort; bins have only a few numbers each. */
function walk(depths: Float32Array, count: number, order: Uint32Array): void {
  for (let i = count - 2; i >= 0; i--) {
    const moving = order[i]!;
    const depth = depths[moving]!;
    let to = i;
    const last = Math.min(count - 1, i + LONGEST_WALK);
    while (to < last && depths[order[to + 1]!]! > depth) {
      order[to] = order[to + 1]!;
      to++;
    }
    order[to] = moving;
  }
}
