// SPDX-License-Identifier: Apache-2.0
/** The header of a stream, which a receiver needs before the first frame. */

import type { FieldName, Fields } from "./fields.js";
import type { SoundFormat } from "./sound.js";

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

/** The content of the init record; `reference` is the state that key packets of the `compact` codec change. */
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
  /** Undefined for a stream without sound. */
  readonly sound: SoundFormat | undefined;
}

/** A part of a stream with its own init record, at byte `offset`; `first` is its first frame. */
export interface Period {
  readonly number: number;
  readonly first: number;
  readonly offset: number;
  readonly bytes: number;
}

/** A sentence on the difference of two headers in what all periods must have in common; undefined if there is none. */
export function difference(first: StreamHeader, later: StreamHeader): string | undefined {
  const shared = ({ cameras, similarity, fps, codec, sound }: StreamHeader) =>
    JSON.stringify([cameras, similarity, fps, codec, sound]);
  return shared(first) === shared(later)
    ? undefined
    : "its cameras, similarity, fps, codec or sound are not those of the first";
}
