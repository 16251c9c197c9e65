// SPDX-License-Identifier: Apache-2.0
/** Which fields of a frame have to be sent: copies of those that are not what was sent last. */

import type { FieldName, Fields, Tensor } from "@structgstream/core";

export class ChangedFields {
  private sent: Fields = new Map();

  constructor(private readonly dynamic: ReadonlySet<FieldName>) {}

  /** What was sent is no longer there: everything goes again. */
  forget(): void {
    this.sent = new Map();
  }

  /** Copies to give away; what they are copies of is kept. */
  of(fields: Fields): Map<FieldName, Tensor> {
    const changed = new Map<FieldName, Tensor>();
    for (const name of this.dynamic) {
      const tensor = fields.get(name);
      if (!tensor || isSame(tensor, this.sent.get(name))) continue;
      changed.set(name, { shape: tensor.shape, data: tensor.data.slice() });
    }
    this.sent = fields;
    return changed;
  }
}

function isSame(a: Tensor, b: Tensor | undefined): boolean {
  if (!b || a.data.length !== b.data.length || a.shape.length !== b.shape.length) return false;
  if (!a.shape.every((size, i) => size === b.shape[i])) return false;
  // Bits, so that a NaN is the same as itself.
  const [x, y] = [wordsOf(a), wordsOf(b)];
  for (let i = 0; i < x.length; i++) if (x[i] !== y[i]) return false;
  return true;
}

function wordsOf({ data }: Tensor): Int32Array {
  return new Int32Array(data.buffer, data.byteOffset, data.byteLength / 4);
}
