// SPDX-License-Identifier: Apache-2.0
/** Signed residuals from symbols of an alphabet of 16, and escapes for the rare large ones (docs/entropy.md, Escapes). */

import { BitReader } from "./bits.js";
import { StreamError } from "./errors.js";

export const RESIDUAL_ALPHABET = 16;
const LARGEST = 7;
const ESCAPE = 15;
const MAX_ZEROS = 28;

/**
 * Residuals int32 `[n]`: symbols 0 to 14 are 0, -1, 1 ... 7; the value of a symbol 15 is in `escapes`.
 *
 * @throws StreamError the escapes are damaged, or not as many as there are symbols 15
 */
export function residualsOf(symbols: Uint8Array, escapes: Uint8Array, where: string): Int32Array {
  const values = new Int32Array(symbols.length);
  const places: number[] = [];
  for (let i = 0; i < symbols.length; i++) {
    const symbol = symbols[i]!;
    const size = (symbol + 1) >> 1;
    values[i] = symbol & 1 ? -size : size;
    if (symbol === ESCAPE) places.push(i);
  }
  // An escape takes 4 to 61 bits.
  if (8 * escapes.length < 4 * places.length || 8 * escapes.length > 61 * places.length + 7) {
    throw new StreamError(`${where} has ${escapes.length} bytes for ${places.length} values; it is damaged.`);
  }
  const reader = new BitReader(escapes, where);
  for (const place of places) {
    const magnitude = reader.golomb(2, MAX_ZEROS) + LARGEST + 1;
    const negative = reader.fixed(1);
    if (magnitude > 2 ** 31 - 1 + negative) {
      throw new StreamError(`${where} holds a value beyond 32 bits; it is damaged.`);
    }
    values[place] = negative ? -magnitude : magnitude;
  }
  reader.end();
  return values;
}
