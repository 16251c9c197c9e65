// SPDX-License-Identifier: Apache-2.0
/**
 * Updates that have come and were not drawn yet.
 *
 * An update holds what changed since the last one given, so none may be lost: what is not drawn goes on with the next.
 */

import type { FieldName, StreamHeader, Tensor } from "@structgstream/core";
import type { SceneUpdate } from "@structgstream/gl";

/** An update, with the header that it and those after it belong to where that is another than before. */
export interface DueUpdate extends SceneUpdate {
  readonly header?: StreamHeader | undefined;
}

interface Pending {
  readonly update: DueUpdate;
  /** To be drawn whatever the clock says. */
  readonly atOnce: boolean;
}

export class FrameQueue {
  private pending: Pending[] = [];
  private carried = new Map<FieldName, Tensor>();
  private header: StreamHeader | undefined;

  add(update: DueUpdate, atOnce: boolean): void {
    this.pending.push({ update, atOnce });
  }

  /** Keeps what an update changes, without ever drawing it by itself. */
  carry({ header, fields }: DueUpdate): void {
    if (header) {
      // What was before belongs to another scene.
      this.header = header;
      this.carried = new Map();
    }
    for (const [name, tensor] of fields) this.carried.set(name, tensor);
  }

  /** All that is there belongs to another place of the stream now. */
  carryAll(): void {
    for (const { update } of this.pending) this.carry(update);
    this.pending = [];
  }

  /** The last update that is due at frame `index`, with all that changed before it. */
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
