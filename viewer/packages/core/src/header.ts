// SPDX-License-Identifier: Apache-2.0
/** What a receiver knows before the first frame. */

import type { FieldName, Fields } from "./fields.js";

/** A camera of the capture, in the capture's own units. */
export interface Camera {
  readonly name: string;
  /** 16 numbers, row by row: world to camera, OpenCV axes. */
  readonly viewmat: readonly number[];
  /** 9 numbers, row by row: pixels, centre of the top-left pixel at (0.5, 0.5). */
  readonly K: readonly number[];
  readonly width: number;
  readonly height: number;
  readonly near: number;
  readonly heldOut: boolean;
}

/** `scene = (capture - center) * scale`. */
export interface Similarity {
  readonly center: readonly [number, number, number];
  readonly scale: number;
}

/** What the init record says; `reference` is what key packets of the `compact` codec change. */
export interface StreamHeader {
  readonly cameras: readonly Camera[];
  readonly similarity: Similarity;
  readonly fps: number;
  readonly codec: string;
  readonly dynamic: ReadonlySet<FieldName>;
  readonly static: Fields;
  readonly reference: Fields;
  readonly steps: ReadonlyMap<string, number>;
  readonly distanceInput: boolean;
  readonly config: Readonly<Record<string, unknown>>;
  readonly metadata: Readonly<Record<string, unknown>>;
}

export function trainingCameras(header: StreamHeader): number {
  return header.cameras.filter((camera) => !camera.heldOut).length;
}
