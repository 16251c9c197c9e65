// SPDX-License-Identifier: Apache-2.0
/** What an engine tells. */

import type { StreamHeader } from "@structgstream/core";

/** Seconds from the first to before the second. */
export type TimeRange = readonly [startSeconds: number, endSeconds: number];

export interface EngineEvents {
  /** Bytes of the header are coming; the total may never be known. */
  opening: { readonly loadedBytes: number; readonly totalBytes: number | undefined; readonly ended: boolean };
  header: StreamHeader;
  /** Another frame is to be drawn. */
  frame: { readonly index: number; readonly ptsSeconds: number };
  /** The clock waits for bytes, or no longer does. */
  stall: { readonly stalled: boolean };
  /** One sentence; after a fatal one nothing more can be shown. */
  error: { readonly message: string; readonly fatal: boolean };
  /** Something the user may want to know, and need not do anything about; empty when it is over. */
  notice: { readonly message: string };
  progress: {
    readonly buffered: readonly TimeRange[];
    readonly fetchedBytes: number;
    readonly durationSeconds: number;
    readonly complete: boolean;
  };
  /** Playing, paused, seeking or at the end: one of them has changed. */
  state: Readonly<Record<string, never>>;
  ended: Readonly<Record<string, never>>;
}
