// SPDX-License-Identifier: Apache-2.0
/**
 * Updates that have arrived and were not drawn yet.
 *
 * An update contains the changes since the last one, so none may be lost: updates that are not drawn are merged.
 */

import type { FieldName, StreamHeader, Tensor } from "@structgstream/core";
import type { SceneUpdate } from "@structgstream/gl";

/** An update, with its header if that differs from the last update's. */
export interface DueUpdate extends SceneUpdate {
  readonly header?: StreamHeader | undefined;
}

interface Pending {
  readonly update: DueUpdate;
  /** Draw it regardless of the clock. */
  readonly atOnce: boolean;
}

export class FrameQueue {
  private pending: Pending[] = [];
  private carried = new Map<FieldName, Tensor>();
  private header: StreamHeader | undefined;

  add(update: DueUpdate, atOnce: boolean): void {
    this.pending.push({ update, atOnce });
  }

  /** Merges an update into the next one without drawing it. */
  carry({ header, fields }: DueUpdate): void {
    if (header) {
      // Earlier updates belong to another scene.
      this.header = header;
      this.carried = new Map();
    }
    for (const [name, tensor] of fields) this.carried.set(name, tensor);
  }

  /** Called after a seek: queued updates must not be drawn any more. */
  carryAll(): void {
    for (const { update } of this.pending) this.carry(update);
    this.pending = [];
  }

  /** The last update that is due at frame `index`, merged with all earlier ones. */
  take(index: number): DueUpdate | undefined {
    let last: DueUpdate | undefined;
    while (this.pending.length) {
      const { update, atOnce } = this.pending[0]!;
      if (!atOnce && update.index > index) break;
      this.pending.shift();
      this.carry(update);
      last = update;
    }
    if (!last) return undefined;
    const { carried: fields, header } = this;
    this.carried = new Map();
    this.header = undefined;
    return { ...last, fields, header };
  }
}
