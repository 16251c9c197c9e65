// SPDX-License-Identifier: Apache-2.0
/** The init record's fields as bins, entropy coded (docs/bitstream.md, section Coded init fields). */

import { LARGEST } from "./bins.js";
import { Decoder } from "./coder.js";
import { StreamError } from "./errors.js";
import { FIELD_NAMES, type FieldName, type Tensor } from "./fields.js";

const WHERE = "The init record";
export const MAX_ANCHORS = 2 ** 22;
const MAX_WEIGHTS = 2 ** 20;
const FREE_NUMBERS = 2 ** 20;
const NUMBERS_A_BYTE = 64;
const MAX_COLUMNS: readonly (readonly [FieldName, number])[] = [
  ["offset_scales", 3],
  ["base_scales", 3],
  ["anchor_offsets", 3 * 64],
  ["anchor_features", 256],
  ["appearance", 256],
];
/** Fields that the init record holds as numbers with either codec. */
export const AS_THEY_ARE: ReadonlySet<FieldName> = new Set(["free", "free_births", "camera_color"] as const);
const SHIFTS = 8;
const SIZES = 5; // classes of what the two columns before hold: 0, 1, 2 to 3, 4 to 7, 8 and more
const LARGEST_SYMBOL = 7;
const HALF = 2 ** 30; // of a key, which has two halves of ten bits an axis
const AXIS_BITS = 10;

/** How many numbers are still allowed: a symbol can take next to nothing, so a few bytes could stand for gigabytes. */
class Budget {
  constructor(private left: number) {}

  take(count: number): void {
    this.left -= count;
    if (this.left < 0) throw new StreamError(`${WHERE} has more than ${NUMBERS_A_BYTE} numbers a byte; it is damaged.`);
  }
}

interface Bins {
  readonly shape: readonly number[];
  readonly bins: Int32Array;
}

/**
 * The fields of coded blocks.
 *
 * @throws StreamError the bytes are damaged, or there is no step for a field
 */
export function decodedFields(
  coded: ReadonlyMap<FieldName, Uint8Array>,
  steps: ReadonlyMap<string, number>,
): Map<FieldName, Tensor> {
  for (const name of coded.keys()) {
    if (!steps.has(name)) throw new StreamError(`The header states no step for ${name} in the init record.`);
  }
  const decoder = new Decoder(coded, WHERE);
  let bytes = 0;
  for (const data of coded.values()) bytes += data.length;
  const found = decodedBins(decoder, coded, new Budget(FREE_NUMBERS + NUMBERS_A_BYTE * bytes));
  decoder.end();
  const fields = new Map<FieldName, Tensor>();
  for (const [name, { shape, bins }] of found) {
    const step = steps.get(name)!;
    const data = new Float32Array(bins.length);
    for (let i = 0; i < bins.length; i++) data[i] = bins[i]! * step; // from() with a function takes ten times as long
    fields.set(name, { shape, data });
  }
  return fields;
}

function decodedBins(
  decoder: Decoder,
  coded: ReadonlyMap<FieldName, Uint8Array>,
  budget: Budget,
): Map<FieldName, Bins> {
  const positions = decodedPositions(decoder, budget);
  const rows = positions.length / 3;
  const found = new Map<FieldName, Bins>([["anchor_positions", { shape: [rows, 3], bins: positions }]]);
  let shifts: Int32Array = new Int32Array(rows);
  for (const [name, most] of MAX_COLUMNS) {
    if (!coded.has(name)) continue;
    const { columns, ...field } = decodedRows(decoder, name, shifts, most, budget);
    shifts = field.shifts;
    if (name === "anchor_offsets" && columns % 3) throw wrongCount(name, field.bins.length);
    const shape = name === "anchor_offsets" ? [rows, columns / 3, 3] : [rows, columns];
    found.set(name, { shape, bins: field.bins });
  }
  for (const name of FIELD_NAMES) {
    if (!coded.has(name) || found.has(name)) continue;
    const bins = decodedNumbers(decoder, name, budget);
    let shape: readonly number[] = [bins.length];
    if (name === "appearance_basis") {
      const [appearance, features] = [found.get("appearance"), found.get("anchor_features")];
      if (appearance === undefined || features === undefined) {
        throw new StreamError(`${WHERE} holds directions of an appearance without the appearance.`);
      }
      shape = [appearance.shape[1]!, features.shape[1]!];
      if (bins.length !== shape[0]! * shape[1]!) throw wrongCount(name, bins.length);
    } else if (name === "environment") {
      if (bins.length % 3) throw wrongCount(name, bins.length);
      shape = [bins.length / 3, 3];
    }
    found.set(name, { shape, bins });
  }
  return found;
}

/** Cells `[M, 3]` by how far each is from the one before along a Z-order curve. */
function decodedPositions(decoder: Decoder, budget: Budget): Int32Array {
  const rows = bounded(decoder.number("anchor_positions.rows"), MAX_ANCHORS, "anchors");
  budget.take(3 * rows);
  if (!rows) return new Int32Array(0);
  const origin = [0, 1, 2].map(() => signedNumber(decoder, "anchor_positions.origin"));
  const descends = decoder.number("anchor_positions.descends") !== 0;
  const far = decoder.naturals("anchor_positions.far", new Uint8Array(rows), 1);
  const near = decoder.naturals(
    "anchor_positions.near",
    Uint8Array.from(far, (part) => Number(part > 0)),
    2,
  );
  const cells = new Int32Array(3 * rows);
  let high = 0;
  let low = 0;
  for (let row = 0; row < rows; row++) {
    let [upper, lower] = [far[row]!, near[row]!];
    if (lower >= HALF) throw beyond();
    if (descends) {
      const odd = lower & 1;
      lower = (lower >> 1) + (upper & 1) * (HALF / 2);
      upper >>= 1;
      if (odd) [upper, lower] = [-1 - upper, HALF - 1 - lower];
    }
    low += lower;
    high += upper;
    if (low >= HALF) {
      low -= HALF;
      high++;
    }
    if (high < 0 || high >= HALF) throw beyond();
    for (let axis = 0; axis < 3; axis++) {
      let cell = 0;
      for (let bit = AXIS_BITS - 1; bit >= 0; bit--) cell = (cell << 1) | ((high >> (3 * bit + axis)) & 1);
      for (let bit = AXIS_BITS - 1; bit >= 0; bit--) cell = (cell << 1) | ((low >> (3 * bit + axis)) & 1);
      cells[3 * row + axis] = checkedBin(cell + origin[axis]!);
    }
  }
  return cells;
}

/** Rows of `[n, columns]`, column by column, and their shifts, which are like those of another field. */
function decodedRows(
  decoder: Decoder,
  name: FieldName,
  like: Int32Array,
  most: number,
  budget: Budget,
): { columns: number; bins: Int32Array; shifts: Int32Array } {
  const rows = like.length;
  const columns = bounded(decoder.number(`${name}.columns`), most, `columns of ${name}`);
  budget.take(columns * rows);
  const shifts = decoder.residuals(`${name}.shift`, new Uint8Array(like), SHIFTS);
  for (const shift of shifts) {
    if (shift < 0) throw new StreamError(`${WHERE} holds a shift of ${name} below 0; it is damaged.`);
  }
  const bins = new Int32Array(rows * columns);
  const contexts = new Uint8Array(rows);
  let [last, before] = [new Int32Array(rows), new Int32Array(rows)];
  for (let column = 0; column < columns; column++) {
    const middle = signedNumber(decoder, `${name}.middle`);
    for (let row = 0; row < rows; row++) {
      const bits = 32 - Math.clz32(Math.min(last[row]! + before[row]!, 8));
      contexts[row] = shifts[row]! * SIZES + Math.min(bits, SIZES - 1);
    }
    const values = decodedValues(decoder, name, contexts);
    for (let row = 0, at = column; row < rows; row++, at += columns) {
      const shift = shifts[row]!;
      const shifted = (middle + ((1 << shift) >> 1)) >> shift;
      bins[at] = checkedBin((values[row]! + shifted) * (1 << shift));
      before[row] = Math.abs(values[row]!);
    }
    [last, before] = [before, last];
  }
  return { columns, bins, shifts };
}

/** Signed numbers: those up to 6 as they are, 7 for all above, and what these have more than 7. */
function decodedValues(decoder: Decoder, name: FieldName, contexts: Uint8Array): Float64Array {
  const found = new Float64Array(decoder.residuals(`${name}.value`, contexts, SHIFTS * SIZES));
  let count = 0;
  for (let i = 0; i < found.length; i++) {
    count += Number(Math.abs(found[i]!) === LARGEST_SYMBOL);
  }
  const more = decoder.naturals(`${name}.more`, new Uint8Array(count), 1);
  let place = 0;
  for (let i = 0; i < found.length; i++) {
    const value = found[i]!;
    if (Math.abs(value) === LARGEST_SYMBOL) found[i] = value + Math.sign(value) * more[place++]!;
  }
  return found;
}

/** Numbers `[n]` of any size. */
function decodedNumbers(decoder: Decoder, name: FieldName, budget: Budget): Int32Array {
  const count = bounded(decoder.number(`${name}.count`), MAX_WEIGHTS, `numbers of ${name}`);
  budget.take(count);
  const values = decoder.naturals(`${name}.value`, new Uint8Array(count), 1);
  return values.map((value) => checkedBin(signed(value)));
}

function signedNumber(decoder: Decoder, name: string): number {
  return checkedBin(signed(decoder.number(name)));
}

/** What has this place in 0, -1, 1, -2, 2 ... */
function signed(place: number): number {
  return place % 2 ? -(place + 1) / 2 : place / 2;
}

function bounded(number: number, most: number, what: string): number {
  if (number > most) throw new StreamError(`${WHERE} has ${number} ${what}; at most ${most} are allowed.`);
  return number;
}

function checkedBin(bin: number): number {
  if (bin < -LARGEST || bin > LARGEST) {
    throw new StreamError(`${WHERE} has a bin beyond 22 bits, which no value stands for; it is damaged.`);
  }
  return bin;
}

function beyond(): StreamError {
  return new StreamError(`${WHERE} holds a position beyond 60 bits; it is damaged.`);
}

function wrongCount(name: FieldName, count: number): StreamError {
  return new StreamError(`${WHERE} holds ${count} numbers of ${name}, which do not fit the other fields.`);
}
