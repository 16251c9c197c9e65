// SPDX-License-Identifier: Apache-2.0
/** Rows of bins that mostly stay: which ones change, and by how much (docs/bitstream.md, section Rows). */

import type { Decoder } from "./coder.js";

const SIGNS = 2; // a residual's context tells -2 and less, -1, 0, 1, 2 and more
const CLASSES = 2 * SIGNS + 1;
const ACTIVITY_CONTEXTS = 2 * 3 * 4;
const RESIDUAL_CONTEXTS = CLASSES * (CLASSES + 2);

/** What a frame did to rows of bins: which are active, and `[n, columns]` residuals, zero where they are not. */
export interface Change {
  readonly active: Uint8Array;
  readonly residuals: Int32Array;
  readonly columns: number;
}

/** Columns from `first` to below `end`, which have tables of their own. */
export interface Group {
  readonly name: string;
  readonly first: number;
  readonly end: number;
}

export function noChange(rows: number, columns: number): Change {
  return { active: new Uint8Array(rows), residuals: new Int32Array(rows * columns), columns };
}

/** The change of the frame that follows the one whose change is `before`. */
export function decodedChange(decoder: Decoder, before: Change, groups: readonly Group[]): Change {
  if (!groups.length) return before;
  const active = decodedActivity(decoder, `${groups[0]!.name}.active`, before.active);
  const rows = placesOf(active);
  const residuals = new Int32Array(before.residuals.length);
  for (const group of groups) decodedResiduals(decoder, group, rows, before, residuals);
  return { active, residuals, columns: before.columns };
}

/** Where a mask is not zero. */
export function placesOf(mask: Uint8Array): Int32Array {
  const places = new Int32Array(mask.length);
  let count = 0;
  for (let i = 0; i < mask.length; i++) if (mask[i]) places[count++] = i;
  return places.subarray(0, count);
}

function decodedActivity(decoder: Decoder, name: string, before: Uint8Array): Uint8Array {
  const count = before.length;
  const around = new Uint8Array(count + 6);
  around.set(before, 3);
  const found = new Uint8Array(count + 1);
  for (let first = 0; first < 2; first++) {
    const contexts = new Uint8Array((count + 1 - first) >> 1);
    for (let i = 0, row = first; row < count; i++, row += 2) {
      const near =
        around[row]! + around[row + 1]! + around[row + 2]! + around[row + 4]! + around[row + 5]! + around[row + 6]!;
      const beside = first ? found[row - 1]! + found[row + 1]! : 0;
      contexts[i] = (before[row]! * 3 + beside) * 4 + Math.min((near + 1) >> 1, 3);
    }
    const values = decoder.flags(`${name}${first}`, contexts, ACTIVITY_CONTEXTS);
    for (let i = 0; i < values.length; i++) found[first + 2 * i] = values[i]!;
  }
  return found.subarray(0, count);
}

/** Writes the residuals of active rows, decoding every second of them first. */
function decodedResiduals(
  decoder: Decoder,
  group: Group,
  rows: Int32Array,
  before: Change,
  residuals: Int32Array,
): void {
  const { columns } = before;
  const width = group.end - group.first;
  for (let first = 0; first < 2; first++) {
    const contexts = new Uint8Array(((rows.length + 1 - first) >> 1) * width);
    for (let i = 0, place = first; place < rows.length; place += 2) {
      const at = rows[place]! * columns;
      const above = first ? rows[place - 1]! * columns : 0;
      const below = first && place + 1 < rows.length ? rows[place + 1]! * columns : -1;
      for (let column = group.first; column < group.end; column++) {
        let beside = 0;
        if (first) beside = residuals[above + column]! + (below < 0 ? 0 : residuals[below + column]!);
        const own = clip(before.residuals[at + column]!, SIGNS) + SIGNS;
        contexts[i++] = own * (CLASSES + 2) + clip(beside, SIGNS + 1) + SIGNS + 1;
      }
    }
    const values = decoder.residuals(`${group.name}.change${first}`, contexts, RESIDUAL_CONTEXTS);
    for (let i = 0, place = first; place < rows.length; place += 2) {
      const at = rows[place]! * columns;
      for (let column = group.first; column < group.end; column++) residuals[at + column] = values[i++]!;
    }
  }
}

function clip(value: number, most: number): number {
  return Math.max(-most, Math.min(value, most));
}
