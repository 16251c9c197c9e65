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
import { decodedFree, type FreeBins, noFree } from "./freeRows.js";
import { type Change, decodedChange, type Group, noChange } from "./rows.js";

/** Fields of an anchor, which change together: three numbers each, or one per direction of the appearance. */
const ANCHOR_ROWS: readonly FieldName[] = ["anchor_positions", "offset_scales", "base_scales", "appearance"];
const WEIGHTS: readonly FieldName[] = ["opacity_mlp", "color_mlp", "covariance_mlp"];
export const FREE_STEPS = ["free_means", "free_log_scales", "free_quats", "free_logit_opacities", "free_colors"];
const FREE_WIDTHS = [3, 3, 4, 1, 3];
export const LARGEST = 2 ** 22;

/** Fields that may be dynamic. */
export const CODABLE: ReadonlySet<FieldName> = new Set([...ANCHOR_ROWS, ...WEIGHTS, "free", "free_births"] as const);

export type Steps = ReadonlyMap<string, number>;

/** The dynamic part of a scene and its last change; `anchors` is `[M, columns of the dynamic fields]`. */
export interface SceneBins {
  readonly anchors: Int32Array;
  readonly change: Change;
  readonly weights: ReadonlyMap<FieldName, Int32Array>;
  readonly weightChanges: ReadonlyMap<FieldName, Change>;
  readonly free: FreeBins;
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
export function withoutChange(bins: SceneBins): SceneBins {
  return {
    ...bins,
    change: noChange(bins.change.history.length, bins.change.columns),
    weightChanges: new Map([...bins.weights].map(([name, weights]) => [name, noChange(weights.length, 1)])),
    free: { ...bins.free, change: noChange(bins.free.births.length, FREE_COLUMNS) },
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
  const weights = new Map<FieldName, Int32Array>();
  for (const name of WEIGHTS) if (dynamic.has(name)) weights.set(name, nearest(state.get(name)!, steps.get(name)!));
  return withoutChange({ anchors, change: noChange(rows, columns), weights, weightChanges: new Map(), free: noFree() });
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
  bins: SceneBins,
  dynamic: ReadonlySet<FieldName>,
  steps: Steps,
): Map<FieldName, Tensor> {
  const state = new Map<FieldName, Tensor>();
  const rows = bins.change.history.length;
  const { columns } = bins.change;
  for (const { name, first, end } of anchorColumns(dynamic, columns)) {
    const step = steps.get(name)!;
    const width = end - first;
    const data = new Float32Array(width * rows);
    for (let i = 0, at = first; i < data.length; i += width, at += columns) {
      for (let column = 0; column < width; column++) data[i + column] = bins.anchors[at + column]! * step;
    }
    state.set(name, { shape: [rows, width], data });
  }
  for (const [name, weights] of bins.weights) {
    const step = steps.get(name)!;
    state.set(name, { shape: [weights.length], data: Float32Array.from(weights, (bin) => bin * step) });
  }
  if (dynamic.has("free")) {
    const byColumn = FREE_STEPS.flatMap((name, i) => Array<number>(FREE_WIDTHS[i]!).fill(steps.get(name)!));
    const data = Float32Array.from(bins.free.bins, (bin, i) => bin * byColumn[i % FREE_COLUMNS]!);
    state.set("free", { shape: [bins.free.births.length, FREE_COLUMNS], data });
    state.set("free_births", { shape: [bins.free.births.length], data: bins.free.births.slice() });
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
  const groups = anchorColumns(dynamic, before.change.columns);
  const change = decodedChange(decoder, before.change, groups);
  const anchors = summed(before.anchors, change.residuals, where);
  const weights = new Map<FieldName, Int32Array>();
  const weightChanges = new Map<FieldName, Change>();
  for (const [name, bins] of before.weights) {
    const found = decodedChange(decoder, before.weightChanges.get(name)!, [{ name, first: 0, end: 1 }]);
    weightChanges.set(name, found);
    weights.set(name, summed(bins, found.residuals, where));
  }
  const free = dynamic.has("free") ? decodedFree(decoder, before.free, where) : before.free;
  for (const bin of free.bins) checkBin(bin, where);
  return { anchors, change, weights, weightChanges, free };
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
