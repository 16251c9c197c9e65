// SPDX-License-Identifier: Apache-2.0
/** Events of an engine. */

import type { StreamHeader } from "@structgstream/core";

/** Interval in seconds: start, and end (exclusive). */
export type TimeRange = readonly [startSeconds: number, endSeconds: number];

export interface EngineEvents {
  /** Bytes of the header have arrived; the total may be unknown. */
  opening: { readonly loadedBytes: number; readonly totalBytes: number | undefined; readonly ended: boolean };
  header: StreamHeader;
  /** A new frame must be drawn. */
  frame: { readonly index: number; readonly ptsSeconds: number };
  /** The clock starts or stops waiting for bytes. */
  stall: { readonly stalled: boolean };
  /** An error in one sentence; nothing more can be shown after a fatal one. */
  error: { readonly message: string; readonly fatal: boolean };
  /** Information for the user that needs no action; empty when it does not apply any more. */
  notice: { readonly message: string };
  progress: {
    readonly buffered: readonly TimeRange[];
    readonly fetchedBytes: number;
    readonly durationSeconds: number;
    readonly complete: boolean;
  };
  /** One of these has changed: playing, paused, seeking, ended. */
  state: Readonly<Record<string, never>>;
  ended: Readonly<Record<string, never>>;
}
