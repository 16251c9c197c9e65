// SPDX-License-Identifier: Apache-2.0
/** Messages between the renderer and its sorting worker. */

import type { IntervalBound } from "../sampling.js";
import type { Camera } from "../types.js";
import type { PlacingArrays } from "./placement.js";

/** A request for an order. */
export interface OrderRequest {
  readonly id: number;
  /** Changes of the scene since the last request, in buffers that are transferred. */
  readonly changed: PlacingArrays;
  readonly offsetsPerAnchor: number;
  readonly interval: IntervalBound;
  readonly camera: Camera;
  readonly maxSplats: number;
  /** Buffers of an earlier answer, to be reused. */
  readonly buffers: readonly ArrayBuffer[];
}

/** Slot `v * K + k` is Gaussian `k` of anchor `anchors[v]`; slot `anchorCount * K + i` is free Gaussian `i`. */
export interface Order {
  readonly id: number;
  /** Ascending; only the first `anchorCount` are valid. */
  readonly anchors: Uint32Array<ArrayBuffer>;
  readonly anchorCount: number;
  /** Slots from far to near; only the first `splats` are valid. */
  readonly slots: Uint32Array<ArrayBuffer>;
  readonly splats: number;
  readonly milliseconds: number;
  /** Buffers of the last changes, to be reused. */
  readonly returned: readonly ArrayBuffer[];
}

export interface OrderFailure {
  readonly id: number;
  readonly failure: string;
}

export type OrderAnswer = Order | OrderFailure;
