// SPDX-License-Identifier: Apache-2.0
/** Sections of entropy-coded symbols: interleaved rANS (docs/entropy.md, section Symbols). */

import { StreamError } from "./errors.js";
import { viewOf } from "./records.js";
import { type FrequencyTables, TOTAL } from "./tables.js";

const LANES = [1, 4, 32];

function varintAt(data: Uint8Array, start: number, where: string): [value: number, next: number] {
  let value = 0;
  for (let place = 0; place < 5 && start + place < data.length; place++) {
    const byte = data[start + place]!;
    value += (byte & 127) * 2 ** (7 * place);
    if (byte < 128) return [value, start + place + 1];
  }
  throw new StreamError(`${where} is cut or damaged in its first bytes.`);
}

/**
 * The symbols u8 `[n]` of the section at the beginning of `data`, and the length of the section in bytes.
 *
 * @param contexts `[n]`, each below `tables.contexts`
 * @throws StreamError the section is damaged or cut, or states another number of symbols
 */
export function decodedSymbols(
  data: Uint8Array,
  contexts: Uint8Array,
  tables: FrequencyTables,
  where: string,
): { symbols: Uint8Array; bytes: number } {
  const count = contexts.length;
  const [stated, next] = varintAt(data, 0, where);
  if (stated !== count) {
    throw new StreamError(`${where} states ${stated} symbols, ${count} are expected; it is damaged.`);
  }
  const symbols = new Uint8Array(count);
  if (count === 0) return { symbols, bytes: next };
  const [value, start] = varintAt(data, next, where);
  const words = Math.floor(value / 4);
  const lanes = LANES[value % 4];
  // A symbol takes at most one word.
  if (words > count || lanes === undefined) {
    throw new StreamError(`${where} states ${count} symbols in ${words} words; it is damaged.`);
  }
  const end = start + 4 * lanes + 2 * words;
  if (end > data.length) throw new StreamError(`${where} states ${end} bytes, ${data.length} are left; it is damaged.`);
  const view = viewOf(data);
  // States are below 2^32 and stored as int32: every operation below gives the same bits as on unsigned numbers.
  const states = new Int32Array(lanes);
  let sound = true;
  for (let lane = 0; lane < lanes; lane++) {
    states[lane] = view.getInt32(start + 4 * lane, true);
    sound &&= states[lane]! >>> 16 !== 0;
  }
  const starts = startsOf(tables);
  const width = tables.alphabet + 1;
  let word = start + 4 * lanes;
  for (let i = 0, lane = 0; i < count && sound; i++) {
    const x = states[lane]!;
    const slot = x & (TOTAL - 1);
    const row = contexts[i]! * width;
    let place = row;
    while (starts[place + 1]! <= slot) place++;
    const first = starts[place]!;
    let next = (Math.imul(starts[place + 1]! - first, x >>> 12) + slot - first) | 0;
    if (next >>> 16 === 0) {
      sound = word < end;
      next = (next << 16) | data[word]! | (data[word + 1]! << 8);
      word += 2;
    }
    states[lane] = next;
    symbols[i] = place - row;
    lane = lane + 1 === lanes ? 0 : lane + 1;
  }
  if (!sound || word !== end || states.some((state) => state !== TOTAL << 4)) {
    throw new StreamError(`${where} is damaged: its words and final states contradict each other.`);
  }
  return { symbols, bytes: end };
}

/** Cumulative frequencies `[contexts, alphabet + 1]`. */
function startsOf(tables: FrequencyTables): Uint16Array {
  const { contexts, alphabet, rows } = tables;
  const starts = new Uint16Array(contexts * (alphabet + 1));
  for (let context = 0; context < contexts; context++) {
    let sum = 0;
    for (let symbol = 0; symbol < alphabet; symbol++) {
      sum += rows[context * alphabet + symbol]!;
      starts[context * (alphabet + 1) + symbol + 1] = sum;
    }
  }
  return starts;
}
