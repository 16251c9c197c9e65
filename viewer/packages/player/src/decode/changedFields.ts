// SPDX-License-Identifier: Apache-2.0
/** Selects the fields of a frame to send: copies of those that differ from the last ones sent. */

import type { FieldName, Fields, Tensor } from "@structgstream/core";

export class ChangedFields {
  private sent: Fields = new Map();

  constructor(private readonly dynamic: ReadonlySet<FieldName>) {}

  /** The receiver has lost its fields: all are sent again. */
  forget(): void {
    this.sent = new Map();
  }

  /** Copies that can be transferred; the originals are stored. */
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
  // Bits are compared, so that a NaN equals itself.
  const [x, y] = [wordsOf(a), wordsOf(b)];
  for (let i = 0; i < x.length; i++) if (x[i] !== y[i]) return false;
  return true;
}

function wordsOf({ data }: Tensor): Int32Array {
  return new Int32Array(data.buffer, data.byteOffset, data.byteLength / 4);
}
