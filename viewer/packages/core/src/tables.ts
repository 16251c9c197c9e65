// SPDX-License-Identifier: Apache-2.0
/**
 * Frequency tables of the entropy coder and their transmission (docs/entropy.md, section Table sets).
 *
 * No number here reaches 2^53, so the floor of a quotient of doubles is the integer quotient.
 */

import { BitReader } from "./bits.js";
import { StreamError } from "./errors.js";

export const TOTAL = 4096;
const FREQUENCY_BITS = 12;
const MAX_ROW_BYTES = 72;
const MAX_ZEROS = 8;

/** One row of frequencies, which sum to 4096, for each context: `rows` is `[contexts, alphabet]`. */
export interface FrequencyTables {
  readonly contexts: number;
  readonly alphabet: number;
  readonly rows: Uint16Array;
}

/** Writes the frequencies for `weights` into `row`; the first of the largest is adjusted so that the sum is 4096. */
export function weighed(weights: Float64Array, row: Uint16Array): void {
  let sum = 0;
  let peak = 0;
  for (let i = 0; i < weights.length; i++) {
    sum += weights[i]!;
    if (weights[i]! > weights[peak]!) peak = i;
  }
  let rest = TOTAL;
  for (let i = 0; i < weights.length; i++) {
    const weight = weights[i]!;
    row[i] = weight > 0 ? Math.max(Math.floor((weight * TOTAL) / sum), 1) : 0;
    rest -= row[i]!;
  }
  row[peak]! += rest;
}

/** Writes row `number` (0 to 255) of the two-sided geometric family into `row`. */
export function geometricRow(number: number, row: Uint16Array): void {
  const z = number >> 3;
  const q = number & 7;
  const weights = new Float64Array(row.length);
  let side = 1 << 16;
  let sum = 0;
  for (let symbol = 1; symbol < row.length; symbol++) {
    if (symbol > 1 && symbol % 2) side = (side * (2 * q + 1)) >> 4;
    weights[symbol] = Math.max(side, 1);
    sum += weights[symbol]!;
  }
  weights[0] = Math.floor((((2 + (z & 1)) << (z >> 1)) * sum) / 16);
  weighed(weights, row);
}

/** The same row of the family for every context. */
export function geometric(number: number, contexts: number, alphabet: number): FrequencyTables {
  const rows = new Uint16Array(contexts * alphabet);
  const first = rows.subarray(0, alphabet);
  geometricRow(number, first);
  for (let context = 1; context < contexts; context++) rows.set(first, context * alphabet);
  return { contexts, alphabet, rows };
}

/**
 * The tables that result from `data` and the previous ones.
 *
 * @throws StreamError the set is damaged
 */
export function decodedTables(data: Uint8Array, previous: FrequencyTables, where: string): FrequencyTables {
  const { contexts, alphabet } = previous;
  if (data.length > MAX_ROW_BYTES * contexts) {
    throw new StreamError(`${where} has ${data.length} bytes for ${contexts} contexts; it is damaged.`);
  }
  if (!data.length) return previous; // usual if little has changed
  const reader = new BitReader(data, where);
  const rows = previous.rows.slice();
  for (let context = 0; context < contexts; context++) {
    const row = rows.subarray(context * alphabet, (context + 1) * alphabet);
    if (!reader.fixed(1)) continue;
    if (!reader.fixed(1)) geometricRow(reader.fixed(8), row);
    else explicitRow(reader, row, where);
  }
  reader.end();
  return { contexts, alphabet, rows };
}

function explicitRow(reader: BitReader, row: Uint16Array, where: string): void {
  if (reader.fixed(1)) geometricRow(reader.fixed(8), row); // the reference, which is then overwritten
  const precision = reader.fixed(2);
  const order = reader.fixed(1);
  const present: number[] = [];
  if (reader.fixed(1)) {
    for (let symbol = 0; symbol < row.length; symbol++) if (reader.fixed(1)) present.push(symbol);
  } else {
    const count = reader.fixed(5) + 1;
    for (let symbol = 0; symbol < count; symbol++) present.push(symbol);
  }
  if (!present.length || present[present.length - 1]! >= row.length) {
    throw new StreamError(`${where} has a row without symbols, or with more than ${row.length}; it is damaged.`);
  }
  const weights = new Float64Array(row.length);
  for (const symbol of present) {
    let level = levelOf(row[symbol]!, precision);
    if (present.length > 1) level += reader.signedGolomb(order, MAX_ZEROS);
    if (level < 1 || level > (FREQUENCY_BITS + 1) << precision) {
      throw new StreamError(`${where} holds a frequency out of bounds; it is damaged.`);
    }
    const place = level - 1;
    weights[symbol] = ((1 << precision) + (place & ((1 << precision) - 1))) << (place >> precision);
  }
  weighed(weights, row);
}

/** The level, rounded down, of a frequency from 0 to 4096; that of 0 is 1. */
function levelOf(frequency: number, precision: number): number {
  const f = Math.max(frequency, 1);
  const exponent = 31 - Math.clz32(f);
  return 1 + (exponent << precision) + ((f << precision) >> exponent) - (1 << precision);
}
