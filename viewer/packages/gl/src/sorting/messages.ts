// SPDX-License-Identifier: Apache-2.0
/** What the renderer and its sorting worker say to each other. */

import type { IntervalBound } from "../sampling.js";
import type { Camera } from "../types.js";
import type { PlacingField } from "./placement.js";

/** Asks for an order. */
export interface OrderRequest {
  readonly id: number;
  /** What has changed of the scene since the last request, in buffers that are transferred. */
  readonly changed: ReadonlyMap<PlacingField, Float32Array<ArrayBuffer>>;
  readonly offsetsPerAnchor: number;
  readonly freeColumns: number;
  readonly interval: IntervalBound;
  readonly camera: Camera;
  readonly maxSplats: number;
  /** Of an earlier answer, to be written to again. */
  readonly buffers: readonly ArrayBuffer[];
}

/** Slot `v * K + k` is Gaussian `k` of anchor `anchors[v]`; slot `anchorCount * K + i` is free Gaussian `i`. */
export interface Order {
  readonly id: number;
  /** Ascending; the first `anchorCount` count. */
  readonly anchors: Uint32Array<ArrayBuffer>;
  readonly anchorCount: number;
  /** Slots from far to near; the first `splats` count. */
  readonly slots: Uint32Array<ArrayBuffer>;
  readonly splats: number;
  readonly milliseconds: number;
  /** Of what had changed before, to be filled again. */
  readonly returned: readonly ArrayBuffer[];
}

export interface OrderFailure {
  readonly id: number;
  readonly failure: string;
}

export type OrderAnswer = Order | OrderFailure;
