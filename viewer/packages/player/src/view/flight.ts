// SPDX-License-Identifier: Apache-2.0
/** A smooth flight from one view to another. */

import { along, between, type Vector } from "@structgstream/gl";
import type { View } from "./navigator.js";

export class Flight {
  /**
   * @param startSeconds start time, of the clock that {@link at} uses
   * @param seconds above 0
   */
  constructor(
    private readonly from: View,
    private readonly to: View,
    private readonly around: Vector,
    private readonly startSeconds: number,
    private readonly seconds: number,
  ) {}

  /** The view at a time; `over` if it has arrived. */
  at(now: number): { readonly view: View; readonly over: boolean } {
    const share = Math.min(Math.max((now - this.startSeconds) / this.seconds, 0), 1);
    if (share === 1) return { view: this.to, over: true };
    const eased = share * share * (3 - 2 * share);
    const camera = between(this.from.camera, this.to.camera, eased, this.around);
    const way = along(this.to.pivot, this.from.pivot, -1);
    return { view: { camera, pivot: along(this.from.pivot, way, eased) }, over: false };
  }
}
