// SPDX-License-Identifier: Apache-2.0
/** Differences of two pictures or two lists of numbers. */

export interface Difference {
  readonly psnrDecibels: number;
  /** Largest difference of the means of an 8 by 8 block, in levels of 255, over blocks and channels. */
  readonly blockLevels: number;
  readonly pixelLevels: number;
}

const BLOCK = 8;

export function bytesOf(base64: string): Uint8Array {
  const buffer = Buffer.from(base64, "base64");
  return new Uint8Array(buffer.buffer.slice(buffer.byteOffset, buffer.byteOffset + buffer.byteLength));
}

/** Two RGBA pictures, alpha left out. */
export function difference(a: Uint8Array, b: Uint8Array, width: number, height: number): Difference {
  if (a.length !== b.length || a.length !== 4 * width * height) {
    throw new Error(`pictures of ${a.length} and ${b.length} bytes are no pictures of ${width} x ${height} pixels`);
  }
  let [squares, pixel, block] = [0, 0, 0];
  for (let top = 0; top < height; top += BLOCK) {
    for (let left = 0; left < width; left += BLOCK) {
      const [bottom, right] = [Math.min(top + BLOCK, height), Math.min(left + BLOCK, width)];
      for (let channel = 0; channel < 3; channel++) {
        let sum = 0;
        for (let y = top; y < bottom; y++) {
          for (let x = left; x < right; x++) {
            const at = 4 * (y * width + x) + channel;
            const off = a[at]! - b[at]!;
            sum += off;
            squares += off * off;
            pixel = Math.max(pixel, Math.abs(off));
          }
        }
        block = Math.max(block, Math.abs(sum) / ((bottom - top) * (right - left)));
      }
    }
  }
  const psnrDecibels = 10 * Math.log10((255 * 255 * 3 * width * height) / Math.max(squares, 1e-9));
  return { psnrDecibels, blockLevels: block, pixelLevels: pixel };
}

/** One picture as a list of its differences from another, four times as large, around grey. */
export function magnified(a: Uint8Array, b: Uint8Array): Uint8Array {
  return a.map((value, i) => (i % 4 === 3 ? 255 : Math.min(Math.max(128 + 4 * (value - b[i]!), 0), 255)));
}
