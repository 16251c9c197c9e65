// SPDX-License-Identifier: Apache-2.0
/** Frames as arrays of plain Gaussians, for any renderer (docs/bitstream.md, From fields to a picture). */

import { type Fields, FREE_COLUMNS, type Tensor } from "./fields.js";
import type { StreamHeader } from "./header.js";

/** A camera's centre or another point: x, y, z, in the capture's axes and units. */
export type Point = readonly [number, number, number];

/**
 * Gaussians of a frame as one camera position sees them, in the capture's axes (of a level camera: x right, y down,
 * z forward) and units. Only the first `count` rows are used.
 */
export interface Gaussians {
  readonly count: number;
  /** [count, 3] */
  readonly means: Float32Array;
  /** [count, 3] standard deviations. */
  readonly scales: Float32Array;
  /** [count, 4] unit quaternions w, x, y, z. */
  readonly rotations: Float32Array;
  /** [count, 3] sRGB; free Gaussians may exceed [0, 1]. */
  readonly colors: Float32Array;
  /** [count] from 1 / 255 to 1. */
  readonly opacities: Float32Array;
}

export interface GaussianOptions {
  /** Variance that is added to the scales, in square pixels of the training pictures; the trainer's own is 0.3. Default: 0. */
  readonly lowPass?: number;
}

const MIN_OPACITY = 1 / 255;
/** Opacities are the tanh of an output. */
const MIN_OUTPUT = Math.atanh(MIN_OPACITY);

/** Evaluates the MLPs of a stream's frames on this thread. */
export class GaussianEvaluator {
  private readonly opacity = new Head("opacity_mlp");
  private readonly color = new Head("color_mlp");
  private readonly covariance = new Head("covariance_mlp");
  private readonly interval: (x: number, y: number, z: number) => number;
  private rows: Rows = rowsOf(0);

  constructor(
    private readonly header: StreamHeader,
    private readonly options: GaussianOptions = {},
  ) {
    this.interval = samplingInterval(header);
  }

  /**
   * Gaussians of a frame, given as `StreamReader.frame(index).fields`, for an eye.
   *
   * The arrays belong to the evaluator: the next call writes to them. What depends neither on the eye nor on the frame is
   * computed once, so consecutive calls are faster than the first. Exposure of single cameras and the environment are left out.
   */
  evaluate(fields: Fields, eye: Point): Gaussians {
    const [anchors, splats] = fields.get("anchor_offsets")!.shape as [number, number, number];
    const capacity = anchors * splats + fields.get("free")!.shape[0]!;
    if (this.rows.opacities.length < capacity) this.rows = rowsOf(capacity);
    const count = this.addFree(fields, this.addStructured(fields, eye));
    return { count, ...this.rows };
  }

  private addStructured(fields: Fields, eye: Point): number {
    const { opacity, color, covariance, rows } = this;
    const { center, scale } = this.header.similarity;
    const [anchors, splats] = fields.get("anchor_offsets")!.shape as [number, number, number];
    const [positions, offsets, offsetScales, baseScales] = (
      ["anchor_positions", "anchor_offsets", "offset_scales", "base_scales"] as const
    ).map((name) => floats(fields.get(name)!)) as [Float32Array, Float32Array, Float32Array, Float32Array];
    for (const head of [opacity, color, covariance]) head.prepare(fields, this.header.distanceInput);
    const [ex, ey, ez] = eye.map((value, axis) => (value - center[axis]!) * scale) as [number, number, number];
    const drawn = new Int32Array(splats);
    let row = 0;
    for (let m = 0; m < anchors; m++) {
      const at = 3 * m;
      const [x, y, z] = [positions[at]!, positions[at + 1]!, positions[at + 2]!];
      const [dx, dy, dz] = [x - ex, y - ey, z - ez];
      const distance = Math.max(Math.sqrt(dx * dx + dy * dy + dz * dz), 1e-12);
      const [ux, uy, uz] = [dx / distance, dy / distance, dz / distance];
      opacity.look(m, ux, uy, uz, distance);
      let found = 0;
      for (let k = 0; k < splats; k++) {
        const output = opacity.output(k);
        if (!(output >= MIN_OUTPUT)) continue;
        rows.opacities[row + found] = Math.tanh(output);
        drawn[found++] = k;
      }
      if (found === 0) continue;
      color.look(m, ux, uy, uz, distance);
      covariance.look(m, ux, uy, uz, distance);
      const kept = this.kept(x / scale + center[0], y / scale + center[1], z / scale + center[2]);
      for (let i = 0; i < found; i++, row++) {
        const k = drawn[i]!;
        for (let axis = 0; axis < 3; axis++) {
          const offset = offsets[3 * (m * splats + k) + axis]! * Math.exp(offsetScales[at + axis]!);
          rows.means[3 * row + axis] = (positions[at + axis]! + offset) / scale + center[axis]!;
          const size = (Math.exp(baseScales[at + axis]!) * sigmoid(covariance.output(7 * k + axis))) / scale;
          rows.scales[3 * row + axis] = Math.sqrt(size * size + kept);
          rows.colors[3 * row + axis] = sigmoid(color.output(3 * k + axis));
        }
        for (let part = 0; part < 4; part++) rows.rotations[4 * row + part] = covariance.output(7 * k + 3 + part);
        normalize(rows.rotations, 4 * row);
      }
    }
    return row;
  }

  private addFree(fields: Fields, row: number): number {
    const { rows } = this;
    const { center, scale } = this.header.similarity;
    const free = floats(fields.get("free")!);
    for (let at = 0; at < free.length; at += FREE_COLUMNS) {
      const opacity = sigmoid(free[at + 10]!);
      if (!(opacity >= MIN_OPACITY)) continue;
      const mean = center.map((middle, axis) => free[at + axis]! / scale + middle) as [number, number, number];
      const kept = this.kept(...mean);
      rows.means.set(mean, 3 * row);
      for (let axis = 0; axis < 3; axis++) {
        const size = Math.exp(free[at + 3 + axis]!) / scale;
        rows.scales[3 * row + axis] = Math.sqrt(size * size + kept);
      }
      rows.rotations.set(free.subarray(at + 6, at + 10), 4 * row);
      normalize(rows.rotations, 4 * row);
      rows.colors.set(free.subarray(at + 11, at + 14), 3 * row);
      rows.opacities[row++] = opacity;
    }
    return row;
  }

  /** Variance to be added at a point, in square units of the capture. */
  private kept(x: number, y: number, z: number): number {
    const { lowPass = 0 } = this.options;
    return lowPass && lowPass * this.interval(x, y, z) ** 2;
  }
}

type Rows = Omit<Gaussians, "count">;

function rowsOf(capacity: number): Rows {
  const rows = (columns: number) => new Float32Array(columns * capacity);
  return { means: rows(3), scales: rows(3), rotations: rows(4), colors: rows(3), opacities: rows(1) };
}

/**
 * One MLP. Its hidden layer's sums over an anchor's features are stored until features or weights change. The appearance of
 * an anchor changes its features by `basis^T a`; because this is linear, it is an input of its own.
 */
class Head {
  private weights: Float32Array = new Float32Array(0);
  private sums: Float32Array = new Float32Array(0);
  private given: Fields = new Map();
  private appearance: Float32Array = new Float32Array(0);
  /** [hidden, rank]: weights of the appearance. */
  private mixed: Float32Array = new Float32Array(0);
  private rank = 0;
  private inputs = 0;
  private features = 0;
  private hidden = 0;
  private distanceInput = false;
  private outputsAt = 0;
  private biasesAt = 0;
  /** Units of the present anchor that are not zero, and their values. */
  private active = new Int32Array(0);
  private values: Float32Array = new Float32Array(0);
  private activeCount = 0;

  constructor(private readonly field: "opacity_mlp" | "color_mlp" | "covariance_mlp") {}

  prepare(fields: Fields, distanceInput: boolean): void {
    const basis = fields.get("appearance_basis");
    this.appearance = basis ? floats(fields.get("appearance")!) : new Float32Array(0);
    const names = [this.field, "anchor_features", "appearance_basis"] as const;
    if (names.every((name) => fields.get(name) === this.given.get(name)) && this.given.size) return;
    this.given = fields;
    const [anchors, features] = fields.get("anchor_features")!.shape as [number, number];
    const splats = fields.get("anchor_offsets")!.shape[1]!;
    const outputs = { opacity_mlp: 1, color_mlp: 3, covariance_mlp: 7 }[this.field] * splats;
    this.weights = floats(fields.get(this.field)!);
    this.inputs = features + 3 + Number(distanceInput);
    this.features = features;
    this.distanceInput = distanceInput;
    this.hidden = (this.weights.length - outputs) / (this.inputs + 1 + outputs);
    this.outputsAt = this.hidden * (this.inputs + 1);
    this.biasesAt = this.outputsAt + outputs * this.hidden;
    this.active = new Int32Array(this.hidden);
    this.values = new Float32Array(this.hidden);
    this.rank = basis?.shape[0] ?? 0;
    this.mixed = new Float32Array(this.hidden * this.rank);
    const first = this.weights.subarray(0, this.hidden * this.inputs);
    if (basis) multiply(this.mixed, first, this.inputs, floats(basis), features, features);
    if (this.sums.length !== anchors * this.hidden) this.sums = new Float32Array(anchors * this.hidden);
    multiply(this.sums, floats(fields.get("anchor_features")!), features, first, this.inputs, features);
  }

  /** Evaluates the hidden layer of an anchor, seen along a unit vector from a distance in scene units. */
  look(anchor: number, ux: number, uy: number, uz: number, distance: number): void {
    const { weights, inputs, features, hidden, sums, active, values, distanceInput, appearance, mixed, rank } = this;
    let count = 0;
    for (let unit = 0; unit < hidden; unit++) {
      const at = unit * inputs + features;
      let sum = weights[hidden * inputs + unit]! + sums[anchor * hidden + unit]!;
      sum += weights[at]! * ux + weights[at + 1]! * uy + weights[at + 2]! * uz;
      if (distanceInput) sum += weights[at + 3]! * distance;
      for (let r = 0; r < rank; r++) sum += mixed[unit * rank + r]! * appearance[anchor * rank + r]!;
      if (!(sum > 0)) continue;
      active[count] = unit;
      values[count++] = sum;
    }
    this.activeCount = count;
  }

  output(index: number): number {
    const { weights, hidden, outputsAt, active, values, activeCount } = this;
    const row = outputsAt + index * hidden;
    let sum = weights[this.biasesAt + index]!;
    for (let i = 0; i < activeCount; i++) sum += weights[row + active[i]!]! * values[i]!;
    return sum;
  }
}

/** `to = a b^T`: the first `columns` of rows that are `aStride` and `bStride` numbers apart. */
function multiply(
  to: Float32Array,
  a: Float32Array,
  aStride: number,
  b: Float32Array,
  bStride: number,
  columns: number,
): void {
  let at = 0;
  for (let i = 0; i < a.length; i += aStride) {
    for (let j = 0; j < b.length; j += bStride) {
      let sum = 0;
      for (let column = 0; column < columns; column++) sum += a[i + column]! * b[j + column]!;
      to[at++] = sum;
    }
  }
}

/** Side of a training pixel at a point, in units of the capture: a mean of the cameras, most of all those that see it. */
function samplingInterval(header: StreamHeader): (x: number, y: number, z: number) => number {
  const cameras = header.cameras.filter(({ heldOut }) => !heldOut);
  const inside = (share: number) => Math.min(Math.max((0.65 - Math.abs(share - 0.5)) * 10, 0), 1);
  return (x, y, z) => {
    let [weights, sum] = [0, 0];
    for (const { viewmat: v, K, width, height } of cameras) {
      const depth = v[8]! * x + v[9]! * y + v[10]! * z + v[11]!;
      if (!(depth > 0)) continue;
      const u = (K[0]! * (v[0]! * x + v[1]! * y + v[2]! * z + v[3]!)) / depth + K[2]!;
      const w = (K[4]! * (v[4]! * x + v[5]! * y + v[6]! * z + v[7]!)) / depth + K[5]!;
      const weight = inside(u / width) * inside(w / height) + 1e-4;
      weights += weight;
      sum += (weight * depth) / Math.sqrt(K[0]! * K[4]!);
    }
    return weights > 0 ? sum / weights : 0;
  };
}

function floats(tensor: Tensor): Float32Array {
  return tensor.data as Float32Array;
}

function sigmoid(x: number): number {
  return 1 / (1 + Math.exp(-x));
}

function normalize(quaternions: Float32Array, at: number): void {
  const [w, x, y, z] = quaternions.subarray(at, at + 4) as unknown as [number, number, number, number];
  const size = Math.max(Math.sqrt(w * w + x * x + y * y + z * z), 1e-12);
  for (let part = 0; part < 4; part++) quaternions[at + part]! /= size;
}
