// SPDX-License-Identifier: Apache-2.0
/** Free Gaussians from frame to frame: some die, some change, some are born (docs/bitstream.md, section Free 3DGs). */

import type { Decoder } from "./coder.js";
import { StreamError } from "./errors.js";
import { FREE_COLUMNS } from "./fields.js";
import { type Change, decodedChange, type Group, noChange, placesOf } from "./rows.js";

/** Free Gaussians that a scene may have: a symbol can take less than a bit, so bytes do not bound their number. */
export const MOST_FREE = 2 ** 18;

const GROUPS: readonly Group[] = [
  { name: "free.means", first: 0, end: 3 },
  { name: "free.log_scales", first: 3, end: 6 },
  { name: "free.quats", first: 6, end: 10 },
  { name: "free.logit_opacities", first: 10, end: 11 },
  { name: "free.colors", first: 11, end: 14 },
];

/** Free Gaussians as bins `[F, 14]`, their ascending births, and what the last frame did to them. */
export interface FreeBins {
  readonly births: BigInt64Array;
  readonly bins: Int32Array;
  readonly change: Change;
}

export function noFree(): FreeBins {
  return { births: new BigInt64Array(0), bins: new Int32Array(0), change: noChange(0, FREE_COLUMNS) };
}

/** What becomes of `before`. */
export function decodedFree(decoder: Decoder, before: FreeBins, where: string): FreeBins {
  const alive = placesOf(decoder.flags("free_births.alive", before.change.active, 2));
  const kept: Change = {
    active: Uint8Array.from(alive, (row) => before.change.active[row]!),
    residuals: rowsOf(before.change.residuals, alive),
    columns: FREE_COLUMNS,
  };
  const change = decodedChange(decoder, kept, GROUPS);
  const born = decodedBirths(decoder, MOST_FREE - alive.length, where);
  const births = new BigInt64Array(alive.length + born.births.length);
  for (const [i, row] of alive.entries()) births[i] = before.births[row]!;
  births.set(born.births, alive.length);
  for (let i = 1; i < births.length; i++) {
    if (births[i]! <= births[i - 1]!) {
      throw new StreamError(`${where} has births that do not ascend; it is damaged.`);
    }
  }
  const bins = new Int32Array(births.length * FREE_COLUMNS);
  bins.set(rowsOf(before.bins, alive));
  for (let i = 0; i < change.residuals.length; i++) bins[i]! += change.residuals[i]!;
  bins.set(born.bins, alive.length * FREE_COLUMNS);
  // What was born did not change.
  const whole = noChange(births.length, FREE_COLUMNS);
  whole.active.set(change.active);
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

function decodedBirths(decoder: Decoder, most: number, where: string): Pick<FreeBins, "births" | "bins"> {
  const count = decoder.number("free_births.count");
  if (count > most) {
    throw new StreamError(`${where} adds ${count} free Gaussians, which makes more than ${MOST_FREE}.`);
  }
  if (!count) return noFree();
  const frames = decoder.naturals("free_births.frame", new Uint8Array(count), 1);
  const fresh = Uint8Array.from(frames, (frame) => Number(frame !== 0));
  const numbers = decoder.naturals("free_births.number", fresh, 2);
  const births = new BigInt64Array(count);
  let frame = 0;
  let number = 0;
  for (let i = 0; i < count; i++) {
    frame += frames[i]!;
    number = (fresh[i] ? 0 : number) + numbers[i]!;
    if (frame >= 2 ** 31 || number >= 2 ** 32) {
      throw new StreamError(`${where} has births beyond 63 bits; it is damaged.`);
    }
    births[i] = (BigInt(frame) << 32n) | BigInt(number);
  }
  const contexts = Uint8Array.from({ length: count * FREE_COLUMNS }, (_, i) => i % FREE_COLUMNS);
  const steps = decoder.naturals("free.born", contexts, FREE_COLUMNS);
  const bins = new Int32Array(steps.length);
  for (let i = 0; i < steps.length; i++) {
    const step = steps[i]!;
    const bin = (i < FREE_COLUMNS ? 0 : bins[i - FREE_COLUMNS]!) + (step & 1 ? -(step >> 1) - 1 : step >> 1);
    if (bin < -(2 ** 31) || bin >= 2 ** 31) {
      throw new StreamError(`${where} has a bin beyond 32 bits; it is damaged.`);
    }
    bins[i] = bin;
  }
  return { births, bins };
}
