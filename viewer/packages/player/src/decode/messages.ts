// SPDX-License-Identifier: Apache-2.0
/** What the engine and the decode worker say to each other. */

import type { FieldName, StreamHeader } from "@structgstream/core";
import type { SceneUpdate } from "@structgstream/gl";
import type { SourceDescription } from "../source/description.js";

/** Frames from the first number to before the second. */
export type FrameRange = readonly [first: number, end: number];

/** Which frames the engine wants now. */
export interface Demand {
  /** A new one begins a seek: `at` is wanted soon, and the key frame before it at once. */
  readonly serial: number;
  /** The frame that should be on the screen; those before it are late. */
  readonly at: number;
  /** Frames are decoded up to before this one. */
  readonly until: number;
  /** Packets are fetched up to before this one. */
  readonly ahead: number;
}

export type ToDecoder =
  | {
      readonly type: "open";
      readonly source: SourceDescription;
      /** Whether the stream will be shown from its first frame on, so that its packet is fetched with the header. */
      readonly fromStart: boolean;
      /** Packets are kept in no more bytes than these. */
      readonly budgetBytes: number;
    }
  | { readonly type: "demand"; readonly demand: Demand }
  /** One of the qualities; undefined leaves it to the connection. */
  | { readonly type: "quality"; readonly quality: number | undefined }
  /** The next frame is to come with all its dynamic fields. */
  | { readonly type: "refresh" };

/** What one packet took. */
export interface PacketFacts {
  readonly index: number;
  readonly isKey: boolean;
  readonly bytes: number;
  readonly byField: ReadonlyMap<FieldName, number>;
}

/** How a stream in a segments folder grows. */
export interface LiveFacts {
  /** Whether frames still come. */
  readonly live: boolean;
  /** How far behind the newest frame playing should stay. */
  readonly targetSeconds: number;
  /** Time of a clock from frame to frame of late. */
  readonly frameSeconds: number | undefined;
  /** Time of the media from frame to frame of late. */
  readonly mediaSeconds: number;
  readonly fps: number;
  /** Unix time at which frames of presentation time 0 would have been filmed, by the pace of the newest. */
  readonly filmedAtZero: number | undefined;
}

/** All packets that are known of. */
export interface CatalogFacts {
  /** The first frame that there still is. */
  readonly first: number;
  /** The number after the last frame's. */
  readonly count: number;
  /** Frames whose times are known, rising; times between them go evenly. Without it: all from 0 on. */
  readonly frames?: Float64Array;
  /** Of these frames, in seconds; rising. Times of packets not read yet are counted on from those that were. */
  readonly ptsSeconds: Float64Array;
  /** Those that are known. */
  readonly keys: Uint32Array;
  readonly lost: readonly FrameRange[];
  /** Whether no more packets will come. */
  readonly complete: boolean;
  readonly live?: LiveFacts;
}

export type FromDecoder =
  | {
      readonly type: "opening";
      readonly loadedBytes: number;
      readonly totalBytes: number | undefined;
      readonly ended: boolean;
    }
  | { readonly type: "header"; readonly header: StreamHeader; readonly ranged: boolean }
  | { readonly type: "catalog"; readonly facts: CatalogFacts }
  /** Packets that are there, and bytes fetched so far, everything counted. */
  | { readonly type: "stored"; readonly ranges: readonly FrameRange[]; readonly fetchedBytes: number }
  | {
      readonly type: "frame";
      readonly serial: number;
      readonly update: SceneUpdate;
      /** Of what the frame belongs to, where that is something else than the frame before: another period or quality. */
      readonly header?: StreamHeader;
      /** False for a picture on the way: the key frame before the one that was sought, or one that is late. */
      readonly exact: boolean;
      /** Of all packets decoded since the last frame given. */
      readonly packets: readonly PacketFacts[];
      readonly decodeMilliseconds: number;
    }
  /** Frames up to before `end` cannot be shown. */
  | { readonly type: "gap"; readonly serial: number; readonly end: number }
  | { readonly type: "damage"; readonly message: string; readonly lost: FrameRange }
  /** The qualities of the stream, and which of them frames are of. */
  | { readonly type: "qualities"; readonly names: readonly string[]; readonly at: number }
  /** Something the user may want to know. */
  | { readonly type: "notice"; readonly message: string }
  | { readonly type: "waiting"; readonly seconds: number; readonly problem: string | undefined }
  /** Unless it is fatal, the next demand is another attempt. */
  | { readonly type: "failed"; readonly message: string; readonly fatal: boolean };
