// SPDX-License-Identifier: Apache-2.0
/** Rows of indices of which few change: the active rows and their residuals (docs/bitstream.md, section Rows). */

import type { AdaptiveDecoder } from "./adaptive.js";

const REMEMBERED = 7; // activity of three frames
const MOST = 255; // upper bound of a size

/**
 * The change of rows in one frame: residuals `[n, columns]`, zero for inactive rows, and the total size of each row's
 * residuals. Bit 0 of `history` is set if the row is active, bits 1 and 2 if it was active in the two frames before.
 */
export interface Change {
  readonly history: Uint8Array;
  readonly sizes: Int32Array;
  readonly residuals: Int32Array;
  readonly columns: number;
}

/** Indices `[n, columns]`, and their last change. */
export interface Rows {
  readonly bins: Int32Array;
  readonly change: Change;
}

/** Columns from `first` to below `end`, with models of their own. */
export interface Group {
  readonly name: string;
  readonly first: number;
  readonly end: number;
}

export function noChange(rows: number, columns: number): Change {
  return {
    history: new Uint8Array(rows),
    sizes: new Int32Array(rows),
    residuals: new Int32Array(rows * columns),
    columns,
  };
}

/** The change of the frame that follows the one whose change is `before`. */
export function decodedChange(decoder: AdaptiveDecoder, before: Change, groups: readonly Group[]): Change {
  if (!groups.length) return before;
  const active = decoder.activity(`${groups[0]!.name}.active`, before.history, before.sizes);
  const rows = placesOf(active);
  const { columns } = before;
  const residuals = new Int32Array(before.residuals.length);
  const others = new Int32Array(rows.length);
  for (const { name, first, end } of groups) {
    const width = end - first;
    const last = new Int32Array(rows.length * width);
    for (let a = 0, i = 0; a < rows.length; a++) {
      const at = rows[a]! * columns;
      for (let column = first; column < end; column++) last[i++] = before.residuals[at + column]!;
    }
    const found = decoder.residuals(`${name}.change`, width, last, others);
    for (let a = 0, i = 0; a < rows.length; a++) {
      const at = rows[a]! * columns;
      for (let column = first; column < end; column++, i++) {
        residuals[at + column] = found[i]!;
        others[a]! += Math.min(Math.abs(found[i]!), MOST);
      }
    }
  }
  const sizes = new Int32Array(active.length);
  for (let a = 0; a < rows.length; a++) sizes[rows[a]!] = others[a]!;
  const history = new Uint8Array(active.length);
  for (let i = 0; i < history.length; i++) history[i] = ((before.history[i]! << 1) & REMEMBERED) | active[i]!;
  return { history, sizes, residuals, columns };
}

/** Indices at which a mask is not zero. */
export function placesOf(mask: Uint8Array): Int32Array {
  const places = new Int32Array(mask.length);
  let count = 0;
  for (let i = 0; i < mask.length; i++) if (mask[i]) places[count++] = i;
  return places.subarray(0, count);
}
