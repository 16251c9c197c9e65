// SPDX-License-Identifier: Apache-2.0
/**
 * A scene's dynamic fields as quantization indices (docs/bitstream.md, section Bins).
 *
 * The value of an index is the product of index and step in float32, rounded as in IEEE 754: the product of doubles is
 * exact, and storing it as float32 rounds it once.
 */

import type { AdaptiveDecoder } from "./adaptive.js";
import { StreamError } from "./errors.js";
import { type FieldName, type Fields, FREE_COLUMNS, type Tensor } from "./fields.js";
import { decodedFree, type FreeRows, noFree } from "./freeRows.js";
import { decodedChange, type Group, noChange, type Rows } from "./rows.js";

/** Fields of an anchor, which change together: three numbers each, or one per direction of the appearance. */
const ANCHOR_ROWS: readonly FieldName[] = ["anchor_positions", "offset_scales", "base_scales", "appearance"];
const WEIGHTS: readonly FieldName[] = ["opacity_mlp", "color_mlp", "covariance_mlp"];
export const FREE_STEPS = ["free_means", "free_log_scales", "free_quats", "free_logit_opacities", "free_colors"];
const FREE_WIDTHS = [3, 3, 4, 1, 3];
export const LARGEST = 2 ** 22;

/** Fields that may be dynamic. */
export const CODABLE: ReadonlySet<FieldName> = new Set([...ANCHOR_ROWS, ...WEIGHTS, "free", "free_births"] as const);

export type Steps = ReadonlyMap<string, number>;

/** The dynamic part of a scene; `anchors` have the columns of the dynamic fields. */
export interface SceneBins {
  readonly anchors: Rows;
  readonly weights: ReadonlyMap<FieldName, Rows>;
  readonly free: FreeRows;
}

type Columns = Group & { readonly name: FieldName };

/** The columns of each dynamic field of anchors; the appearance has the remaining ones of `total`. */
function anchorColumns(dynamic: ReadonlySet<FieldName>, total: number): Columns[] {
  return ANCHOR_ROWS.filter((name) => dynamic.has(name)).map((name, number) => ({
    name,
    first: 3 * number,
    end: name === "appearance" ? total : 3 * number + 3,
  }));
}

/** The same without a last change. */
export function withoutChange({ anchors, weights, free }: SceneBins): SceneBins {
  const still = <Kind extends Rows>(rows: Kind): Kind => ({
    ...rows,
    change: noChange(rows.change.history.length, rows.change.columns),
  });
  return {
    anchors: still(anchors),
    weights: new Map([...weights].map(([name, rows]) => [name, still(rows)])),
    free: still(free),
  };
}

/**
 * The nearest bins of the reference state's dynamic fields, without free Gaussians.
 *
 * @throws StreamError a value is too many steps from zero
 */
export function quantizeState(state: Fields, dynamic: ReadonlySet<FieldName>, steps: Steps): SceneBins {
  const rows = state.get("anchor_positions")!.shape[0]!;
  const widths = ANCHOR_ROWS.map((name) => (dynamic.has(name) ? state.get(name)!.shape[1]! : 0));
  const columns = widths.reduce((sum, width) => sum + width, 0);
  const anchors = new Int32Array(rows * columns);
  for (const { name, first, end } of anchorColumns(dynamic, columns)) {
    const bins = nearest(state.get(name)!, steps.get(name)!);
    const width = end - first;
    for (let row = 0; row < rows; row++) {
      for (let i = 0; i < width; i++) anchors[row * columns + first + i] = bins[row * width + i]!;
    }
  }
  const weights = new Map<FieldName, Rows>();
  for (const name of WEIGHTS) {
    if (!dynamic.has(name)) continue;
    const bins = nearest(state.get(name)!, steps.get(name)!);
    weights.set(name, { bins, change: noChange(bins.length, 1) });
  }
  return { anchors: { bins: anchors, change: noChange(rows, columns) }, weights, free: noFree() };
}

function nearest(value: Tensor, step: number): Int32Array {
  const bins = new Int32Array(value.data.length);
  for (let i = 0; i < bins.length; i++) {
    const quotient = Number(value.data[i]) / step;
    const below = Math.floor(quotient);
    const rest = quotient - below;
    // Ties are rounded to even.
    const bin = rest > 0.5 || (rest === 0.5 && below % 2 !== 0) ? below + 1 : below;
    if (!(Math.abs(bin) <= LARGEST)) {
      throw new StreamError(`The reference has a value ${bin} steps from zero; at most ${LARGEST} can be coded.`);
    }
    bins[i] = bin;
  }
  return bins;
}

/** The dynamic fields that the indices represent. */
export function dequantizeState(
  { anchors, weights, free }: SceneBins,
  dynamic: ReadonlySet<FieldName>,
  steps: Steps,
): Map<FieldName, Tensor> {
  const state = new Map<FieldName, Tensor>();
  const rows = anchors.change.history.length;
  const { columns } = anchors.change;
  for (const { name, first, end } of anchorColumns(dynamic, columns)) {
    const step = steps.get(name)!;
    const width = end - first;
    const data = new Float32Array(width * rows);
    for (let i = 0, at = first; i < data.length; i += width, at += columns) {
      for (let column = 0; column < width; column++) data[i + column] = anchors.bins[at + column]! * step;
    }
    state.set(name, { shape: [rows, width], data });
  }
  for (const [name, { bins }] of weights) {
    const step = steps.get(name)!;
    state.set(name, { shape: [bins.length], data: Float32Array.from(bins, (bin) => bin * step) });
  }
  if (dynamic.has("free")) {
    const byColumn = FREE_STEPS.flatMap((name, i) => Array<number>(FREE_WIDTHS[i]!).fill(steps.get(name)!));
    const data = Float32Array.from(free.bins, (bin, i) => bin * byColumn[i % FREE_COLUMNS]!);
    state.set("free", { shape: [free.births.length, FREE_COLUMNS], data });
    state.set("free_births", { shape: [free.births.length], data: free.births.slice() });
  }
  return state;
}

/**
 * The bins of the frame after that of `before`.
 *
 * @throws StreamError the decoded data is inconsistent
 */
export function decodedScene(
  decoder: AdaptiveDecoder,
  before: SceneBins,
  dynamic: ReadonlySet<FieldName>,
  where: string,
): SceneBins {
  const next = (rows: Rows, groups: readonly Group[]): Rows => {
    const change = decodedChange(decoder, rows.change, groups);
    return { bins: summed(rows.bins, change.residuals, where), change };
  };
  const anchors = next(before.anchors, anchorColumns(dynamic, before.anchors.change.columns));
  const weights = new Map([...before.weights].map(([name, rows]) => [name, next(rows, [{ name, first: 0, end: 1 }])]));
  const free = dynamic.has("free") ? decodedFree(decoder, before.free, where) : before.free;
  for (const bin of free.bins) checkBin(bin, where);
  return { anchors, weights, free };
}

function summed(bins: Int32Array, residuals: Int32Array, where: string): Int32Array {
  const sums = new Int32Array(bins.length);
  for (let i = 0; i < bins.length; i++) {
    const sum = bins[i]! + residuals[i]!;
    checkBin(sum, where);
    sums[i] = sum;
  }
  return sums;
}

function checkBin(bin: number, where: string): void {
  if (bin < -LARGEST || bin > LARGEST) {
    throw new StreamError(`${where} has a bin beyond 22 bits, which no value stands for; it is damaged.`);
  }
}
