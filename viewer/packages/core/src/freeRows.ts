// SPDX-License-Identifier: Apache-2.0
/** Free Gaussians from frame to frame: some are removed, changed or spawned (docs/bitstream.md, section Free 3DGs). */

import { type AdaptiveDecoder, bitLength } from "./adaptive.js";
import { StreamError } from "./errors.js";
import { FREE_COLUMNS } from "./fields.js";
import { type Change, decodedChange, type Group, noChange, placesOf, type Rows } from "./rows.js";

/** Largest number of free Gaussians: a symbol can take less than a bit, so bytes do not bound their number. */
export const MAX_FREE = 2 ** 18;

const GROUPS: readonly Group[] = [
  { name: "free.means", first: 0, end: 3 },
  { name: "free.log_scales", first: 3, end: 6 },
  { name: "free.quats", first: 6, end: 10 },
  { name: "free.logit_opacities", first: 10, end: 11 },
  { name: "free.colors", first: 11, end: 14 },
];

const MEANS = [6, 7, 8, 9, 10]; // quaternions and opacities
const LED = [12, 13]; // green and blue
const BORN_CONTEXTS = [FREE_COLUMNS, FREE_COLUMNS * 39, FREE_COLUMNS * 13];

/** Free Gaussians as indices `[F, 14]`, and their ascending identities. */
export interface FreeRows extends Rows {
  readonly births: BigInt64Array;
}

export function noFree(): FreeRows {
  return { births: new BigInt64Array(0), bins: new Int32Array(0), change: noChange(0, FREE_COLUMNS) };
}

/** The free Gaussians of the frame after `before`. */
export function decodedFree(decoder: AdaptiveDecoder, before: FreeRows, where: string): FreeRows {
  const alive = placesOf(decoder.flags("free_births.alive", before.change.history, 8));
  const kept: Change = {
    history: Uint8Array.from(alive, (row) => before.change.history[row]!),
    sizes: Int32Array.from(alive, (row) => before.change.sizes[row]!),
    residuals: rowsOf(before.change.residuals, alive),
    columns: FREE_COLUMNS,
  };
  const change = decodedChange(decoder, kept, GROUPS);
  const stayed = rowsOf(before.bins, alive);
  for (let i = 0; i < stayed.length; i++) stayed[i]! += change.residuals[i]!;
  const spawned = decodedBirths(decoder, stayed, where);
  const births = new BigInt64Array(alive.length + spawned.births.length);
  for (const [i, row] of alive.entries()) births[i] = before.births[row]!;
  births.set(spawned.births, alive.length);
  for (let i = 1; i < births.length; i++) {
    if (births[i]! <= births[i - 1]!) {
      throw new StreamError(`${where} has births that do not ascend; it is damaged.`);
    }
  }
  const bins = new Int32Array(births.length * FREE_COLUMNS);
  bins.set(stayed);
  bins.set(spawned.bins, alive.length * FREE_COLUMNS);
  // Spawned Gaussians have no last change.
  const whole = noChange(births.length, FREE_COLUMNS);
  whole.history.set(change.history);
  whole.sizes.set(change.sizes);
  whole.residuals.set(change.residuals);
  return { births, bins, change: whole };
}

function rowsOf(values: Int32Array, rows: Int32Array): Int32Array {
  const found = new Int32Array(rows.length * FREE_COLUMNS);
  for (const [i, row] of rows.entries()) {
    found.set(values.subarray(row * FREE_COLUMNS, (row + 1) * FREE_COLUMNS), i * FREE_COLUMNS);
  }
  return found;
}

/** The spawned Gaussians, given the indices of the remaining ones. */
function decodedBirths(decoder: AdaptiveDecoder, alive: Int32Array, where: string): Pick<FreeRows, "births" | "bins"> {
  const count = decoder.numbers("free_births.count", new Int32Array(1), [1])[0]!;
  if (count < 0 || count > MAX_FREE - alive.length / FREE_COLUMNS) {
    throw new StreamError(
      `${where} adds ${count} free Gaussians, which makes more than ${MAX_FREE}, or fewer than none.`,
    );
  }
  if (!count) return noFree();
  const frames = decoder.numbers("free_births.frame", new Int32Array(count), [1]);
  const fresh = Int32Array.from(frames, (frame) => Number(frame !== 0));
  const numbers = decoder.numbers("free_births.number", fresh, [2]);
  const births = new BigInt64Array(count);
  let frame = 0;
  let number = 0;
  for (let i = 0; i < count; i++) {
    frame += frames[i]!;
    number = (fresh[i] ? 0 : number) + numbers[i]!;
    if (frame < 0 || frame >= 2 ** 31 || number < 0 || number >= 2 ** 32) {
      throw new StreamError(`${where} has births beyond 63 bits; it is damaged.`);
    }
    births[i] = (BigInt(frame) << 32n) | BigInt(number);
  }
  return { births, bins: decodedBorn(decoder, alive, count, where) };
}

/** The indices `[count, 14]` of spawned Gaussians, column by column. */
function decodedBorn(decoder: AdaptiveDecoder, alive: Int32Array, count: number, where: string): Int32Array {
  const bins = new Int32Array(count * FREE_COLUMNS);
  const rows = alive.length / FREE_COLUMNS;
  const contexts = new Int32Array(count * BORN_CONTEXTS.length);
  let one: Int32Array = new Int32Array(count); // errors in earlier columns
  let two: Int32Array = new Int32Array(count);
  for (let column = 0; column < FREE_COLUMNS; column++) {
    for (let i = 0, at = 0; i < count; i++) {
      const length = errorLength(one[i]!);
      contexts[at++] = column;
      contexts[at++] = (column * 13 + length) * 3 + Math.sign(one[i]!) + 1;
      contexts[at++] = column * 13 + Math.min(length + errorLength(two[i]!), 12);
    }
    const errors = decoder.numbers("free.born", contexts, BORN_CONTEXTS);
    const start = rows ? alive[alive.length - FREE_COLUMNS + column]! : 0;
    const mean = MEANS.includes(column) && rows ? meanOf(alive, column) : 0;
    for (let i = 0, at = column; i < count; i++, at += FREE_COLUMNS) {
      let led = mean;
      if (!MEANS.includes(column)) led = i ? bins[at - FREE_COLUMNS]! : start;
      if (LED.includes(column)) {
        const before = i ? bins[at - 1 - FREE_COLUMNS]! : rows ? alive[alive.length - FREE_COLUMNS + column - 1]! : 0;
        led += bins[at - 1]! - before;
      }
      const bin = errors[i]! + led;
      if (bin < -(2 ** 31) || bin >= 2 ** 31) {
        throw new StreamError(`${where} has a bin beyond 32 bits; it is damaged.`);
      }
      bins[at] = bin;
    }
    [one, two] = [errors, one];
  }
  return bins;
}

function meanOf(bins: Int32Array, column: number): number {
  let sum = 0;
  for (let at = column; at < bins.length; at += FREE_COLUMNS) sum += bins[at]!;
  return Math.floor(sum / (bins.length / FREE_COLUMNS));
}

function errorLength(error: number): number {
  return bitLength(Math.abs(error), 12);
}
