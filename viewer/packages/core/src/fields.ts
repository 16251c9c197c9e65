// SPDX-License-Identifier: Apache-2.0
/** The fields of a scene and how their shapes fit together (docs/bitstream.md, section Fields). */

import { StreamError } from "./errors.js";

export const FREE_COLUMNS = 14;

/** By code, from 1 on; a number is a size, a letter denotes the same size in all fields. */
const FIELD_TABLE = [
  ["anchor_positions", ["M", 3]],
  ["offset_scales", ["M", 3]],
  ["base_scales", ["M", 3]],
  ["anchor_offsets", ["M", "K", 3]],
  ["anchor_features", ["M", "D"]],
  ["opacity_mlp", ["P_alpha"]],
  ["color_mlp", ["P_c"]],
  ["covariance_mlp", ["P_Sigma"]],
  ["free", ["F", FREE_COLUMNS]],
  ["free_births", ["F"]],
  ["camera_color", ["V", 6]],
  ["appearance", ["M", "R"]],
  ["appearance_basis", ["R", "D"]],
  ["environment", ["E", 3]],
] as const;

export type FieldName = (typeof FIELD_TABLE)[number][0];

/** Every field, in the order of their codes. */
export const FIELD_NAMES: readonly FieldName[] = FIELD_TABLE.map(([name]) => name);

/** Optional fields; a scene has both of the first two or neither. */
export const OPTIONAL_FIELDS: readonly FieldName[] = ["appearance", "appearance_basis", "environment"];

/** Rows of an environment: spherical harmonics up to degree 0, 1 and 2. */
const ENVIRONMENT_ROWS: readonly number[] = [1, 4, 9];

/** Whether these are the fields of a scene. */
export function isScene(names: ReadonlySet<FieldName>): boolean {
  const whole = FIELD_NAMES.every((name) => names.has(name) || OPTIONAL_FIELDS.includes(name));
  return whole && names.has("appearance") === names.has("appearance_basis");
}

/** Numbers of a field, the last dimension fastest; identities are 64-bit integers. */
export interface Tensor {
  readonly shape: readonly number[];
  readonly data: Float32Array | BigInt64Array;
}

export type Fields = ReadonlyMap<FieldName, Tensor>;

export function fieldOf(code: number): FieldName | undefined {
  return FIELD_NAMES[code - 1];
}

/** The field of an array, whose name is what comes before the dot. */
export function fieldIn(name: string): string {
  return name.slice(0, name.indexOf("."));
}

export function isFieldName(name: unknown): name is FieldName {
  return FIELD_NAMES.some((known) => known === name);
}

/** `first` and `second`, in the order of the codes. */
export function mergedFields(first: Fields, second: Fields): Map<FieldName, Tensor> {
  const merged = new Map<FieldName, Tensor>();
  for (const name of FIELD_NAMES) {
    const value = second.get(name) ?? first.get(name);
    if (value !== undefined) merged.set(name, value);
  }
  return merged;
}

/** What {@link checkShapes} needs of a header. */
interface ShapeFacts {
  readonly distanceInput: boolean;
  readonly cameras: readonly { readonly heldOut: boolean }[];
}

/**
 * Checks that the existing fields are consistent.
 *
 * @throws StreamError they are not; the message names the first field that does not fit
 */
export function checkShapes(fields: Fields, header: ShapeFacts, where: string): void {
  const training = header.cameras.filter((camera) => !camera.heldOut).length;
  const sizes = new Map<string, number>([["V", training]]);
  for (const [name, expected] of FIELD_TABLE) {
    const value = fields.get(name);
    if (value !== undefined) matchShape(name, value, expected, sizes, where);
  }
  const rows = sizes.get("E");
  if (rows !== undefined && !ENVIRONMENT_ROWS.includes(rows)) {
    throw new StreamError(`${where} has an environment of ${rows} rows; expected 1, 4 or 9.`);
  }
  const k = sizes.get("K");
  const features = sizes.get("D");
  if (k === undefined || features === undefined) return;
  if (k < 1 || features < 1) {
    throw new StreamError(`${where} has ${k} Gaussians and ${features} features an anchor; both must be 1 up.`);
  }
  const inputs = features + 3 + Number(header.distanceInput);
  let hidden: number | undefined;
  for (const [letter, outputs] of [["P_alpha", k] as const, ["P_c", 3 * k] as const, ["P_Sigma", 7 * k] as const]) {
    const weights = sizes.get(letter);
    if (weights === undefined) continue;
    const units = (weights - outputs) / (inputs + 1 + outputs);
    if (!Number.isInteger(units) || units < 1 || units !== (hidden ?? units)) {
      throw new StreamError(
        `${where} has an MLP of ${weights} weights, which is no hidden layer between ${inputs} inputs and ` +
          `${outputs} outputs, or not the same as in the other MLPs.`,
      );
    }
    hidden = units;
  }
}

function matchShape(
  name: FieldName,
  value: Tensor,
  expected: readonly (string | number)[],
  sizes: Map<string, number>,
  where: string,
): void {
  let fits = value.shape.length === expected.length;
  fits &&= value.data instanceof BigInt64Array === (name === "free_births");
  for (const [i, letter] of expected.entries()) {
    const size = value.shape[i];
    if (typeof letter === "string" && !sizes.has(letter) && size !== undefined) sizes.set(letter, size);
    fits &&= size === (typeof letter === "string" ? sizes.get(letter) : letter);
  }
  if (!fits) {
    const wanted = expected.map((letter) => (typeof letter === "string" ? (sizes.get(letter) ?? letter) : letter));
    throw new StreamError(
      `${where} has field ${name} as (${value.shape.join(", ")}), which does not fit the others; ` +
        `expected (${wanted.join(", ")}).`,
    );
  }
}
