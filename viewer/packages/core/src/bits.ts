// SPDX-License-Identifier: Apache-2.0
/** Numbers as bits, the highest first, and Exp-Golomb codes (docs/entropy.md, section Bits). */

import { StreamError } from "./errors.js";

export class BitReader {
  private readonly end_: number;
  private position = 0;

  /** @param where subject of error messages */
  constructor(
    private readonly data: Uint8Array,
    private readonly where: string,
  ) {
    this.end_ = 8 * data.length;
  }

  /** The next `width` bits, at most 31, as a number. */
  fixed(width: number): number {
    if (this.position + width > this.end_) throw new StreamError(`${this.where} ends within a number; it is damaged.`);
    let value = 0;
    for (let left = width; left > 0; ) {
      const there = 8 - (this.position & 7);
      const count = Math.min(left, there);
      const byte = this.data[this.position >>> 3]!;
      value = (value << count) | ((byte >>> (there - count)) & ((1 << count) - 1));
      this.position += count;
      left -= count;
    }
    return value;
  }

  /** An Exp-Golomb code of this order with at most `mostZeros` leading zeros. */
  golomb(order: number, mostZeros: number): number {
    let zeros = 0;
    while (this.position < this.end_ && !((this.data[this.position >>> 3]! >>> (7 - (this.position & 7))) & 1)) {
      this.position++;
      if (++zeros > mostZeros) break;
    }
    if (zeros > mostZeros || this.position === this.end_) {
      throw new StreamError(`${this.where} holds a number that is cut or out of bounds; it is damaged.`);
    }
    return this.fixed(zeros + order + 1) - (1 << order);
  }

  /** A signed Exp-Golomb code: an index into 0, -1, 1, -2, 2 ... */
  signedGolomb(order: number, mostZeros: number): number {
    const place = this.golomb(order, mostZeros);
    return place % 2 ? -((place + 1) >>> 1) : place >>> 1;
  }

  /** Check that only the zeros that fill the last byte remain. */
  end(): void {
    const left = this.end_ - this.position;
    if (left > 7 || this.fixed(left) !== 0) {
      throw new StreamError(`${this.where} goes on after its last number; it is damaged.`);
    }
  }
}
