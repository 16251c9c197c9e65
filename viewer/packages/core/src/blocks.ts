// SPDX-License-Identifier: Apache-2.0
/** Field blocks: one field of the scene as bytes (docs/bitstream.md, section Field blocks). */

import { StreamError } from "./errors.js";
import { type FieldName, fieldOf, type Tensor } from "./fields.js";
import { viewOf } from "./records.js";

const HEAD_BYTES = 4;
const RAW = 0;
const CODED = 1;
const MAX_DIMENSIONS = 4;
const MAX_ELEMENTS = 2 ** 31 - 1;

/** Position of one field in a payload, without a copy; all stated sizes have been checked against the payload. */
export interface Block {
  readonly name: FieldName;
  readonly coded: boolean;
  readonly itemBytes: number;
  readonly shape: readonly number[];
  readonly start: number;
  readonly data: number;
  readonly end: number;
}

function itemBytesOf(coding: number, type: number, dimensions: number): number | undefined {
  if (dimensions > MAX_DIMENSIONS) return undefined;
  if (coding === RAW) return type === 0 ? 4 : type === 1 ? 8 : undefined;
  return coding === CODED && type === 2 && dimensions === 1 ? 1 : undefined;
}

/**
 * Every block from byte `start` to the end.
 *
 * @throws StreamError an unknown field or coding, a duplicate field, or a size that does not fit the payload
 */
export function blocksIn(payload: Uint8Array, start: number, where: string): Block[] {
  const view = viewOf(payload);
  const blocks: Block[] = [];
  for (let at = start; at < payload.length; ) {
    if (at + HEAD_BYTES > payload.length) throw new StreamError(`${where} ends within the head of a field block.`);
    const [code, coding, type, dimensions] = payload.subarray(at, at + HEAD_BYTES) as unknown as [number, ...number[]];
    const name = fieldOf(code);
    const itemBytes = itemBytesOf(coding!, type!, dimensions!);
    if (name === undefined || itemBytes === undefined) {
      throw new StreamError(
        `${where} holds a field block (field ${code}, coding ${coding}, type ${type}, ${dimensions} dimensions) that ` +
          "this version does not know; use a newer one.",
      );
    }
    if (blocks.some((block) => block.name === name)) throw new StreamError(`${where} holds field ${name} twice.`);
    const data = at + HEAD_BYTES + 4 * dimensions!;
    if (data > payload.length) throw new StreamError(`${where} ends within the shape of field ${name}.`);
    const shape = Array.from({ length: dimensions! }, (_, i) => view.getUint32(at + HEAD_BYTES + 4 * i, true));
    // Products within the bounds are exact, and those beyond them exceed them even when rounded. An empty tensor has no
    // bytes to check its sizes against, so they have a bound of their own.
    const bounded = shape.reduce((product, size) => product * Math.max(size, 1), 1) <= MAX_ELEMENTS;
    const end = data + shape.reduce((product, size) => product * size, itemBytes);
    if (!bounded || end > payload.length) {
      throw new StreamError(`${where} states (${shape.join(", ")}) numbers for field ${name}, more than it holds.`);
    }
    blocks.push({ name, coded: coding === CODED, itemBytes, shape, start: at, data, end });
    at = end;
  }
  return blocks;
}

/**
 * The fields of all blocks from byte `start` to the end: tensors of those that are not coded, copied byte by byte (bits of
 * NaNs do not change), and the bytes of coded ones, without a copy. Requires a little-endian machine, as WebGPU and
 * WebAssembly do.
 *
 * @param isCoded whether the stream's codec codes a field here
 * @throws StreamError as {@link blocksIn}, or a block is coded and should not be, or the other way round
 */
export function fieldsIn(
  payload: Uint8Array,
  start: number,
  where: string,
  isCoded: (name: FieldName) => boolean,
): { values: Map<FieldName, Tensor>; coded: Map<FieldName, Uint8Array> } {
  const values = new Map<FieldName, Tensor>();
  const coded = new Map<FieldName, Uint8Array>();
  for (const block of blocksIn(payload, start, where)) {
    if (block.coded !== isCoded(block.name)) {
      const found = block.coded ? "coded, where it should be as it is" : "as it is, where it should be coded";
      throw new StreamError(`${where} holds field ${block.name} ${found}.`);
    }
    if (block.coded) coded.set(block.name, payload.subarray(block.data, block.end));
    else values.set(block.name, tensorOf(payload, block));
  }
  return { values, coded };
}

function tensorOf(payload: Uint8Array, block: Block): Tensor {
  const { buffer } = payload.slice(block.data, block.end);
  const data = block.itemBytes === 8 ? new BigInt64Array(buffer) : new Float32Array(buffer);
  return { shape: block.shape, data };
}
