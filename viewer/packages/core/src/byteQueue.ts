// SPDX-License-Identifier: Apache-2.0

/** A queue of bytes that arrive in pieces; its memory is at most about twice the bytes in it. */
export class ByteQueue {
  private buffer = new Uint8Array(0);
  private start = 0;
  private end = 0;

  get length(): number {
    return this.end - this.start;
  }

  append(bytes: Uint8Array): void {
    if (this.end + bytes.length > this.buffer.length) {
      const needed = this.length + bytes.length;
      const bigger = new Uint8Array(needed === bytes.length ? needed : Math.max(2 * this.length, needed));
      bigger.set(this.buffer.subarray(this.start, this.end));
      this.end = this.length;
      this.start = 0;
      this.buffer = bigger;
    }
    this.buffer.set(bytes, this.end);
    this.end += bytes.length;
  }

  /** The next bytes, at most `count`, which remain in the queue; valid until the next call. */
  peek(count: number): Uint8Array {
    return this.buffer.subarray(this.start, Math.min(this.start + count, this.end));
  }

  /** Removes the next `count` bytes, which must exist. */
  skip(count: number): void {
    this.start += count;
    if (this.start === this.end) this.clear();
  }

  clear(): void {
    this.buffer = new Uint8Array(0);
    this.start = this.end = 0;
  }
}
