// SPDX-License-Identifier: Apache-2.0
/**
 * Updates that have come and were not drawn yet.
 *
 * An update holds what changed since the last one given, so none may be lost: what is not drawn goes on with the next.
 */

import type { FieldName, Tensor } from "@structgstream/core";
import type { SceneUpdate } from "@structgstream/gl";

interface Pending {
  readonly update: SceneUpdate;
  /** To be drawn whatever the clock says. */
  readonly atOnce: boolean;
}

export class FrameQueue {
  private pending: Pending[] = [];
  private carried = new Map<FieldName, Tensor>();

  add(update: SceneUpdate, atOnce: boolean): void {
    this.pending.push({ update, atOnce });
  }

  /** Keeps what an update changes, without ever drawing it by itself. */
  carry(update: SceneUpdate): void {
    for (const [name, tensor] of update.fields) this.carried.set(name, tensor);
  }

  /** All that is there belongs to another place of the stream now. */
  carryAll(): void {
    for (const { update } of this.pending) this.carry(update);
    this.pending = [];
  }

  /** The last update that is due at frame `index`, with all that changed before it. */
  take(index: number): SceneUpdate | undefined {
    let last: SceneUpdate | undefined;
    while (this.pending.length) {
      const { update, atOnce } = this.pending[0]!;
      if (!atOnce && update.index > index) break;
      this.pending.shift();
      this.carry(update);
      last = update;
    }
    if (!last) return undefined;
    const fields = this.carried;
    this.carried = new Map();
    return { ...last, fields };
  }
}
