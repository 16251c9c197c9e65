// SPDX-License-Identifier: Apache-2.0
/** Messages between the engine and the decode worker. */

import type { FieldName, FrameSound, StreamHeader } from "@structgstream/core";
import type { SceneUpdate } from "@structgstream/gl";
import type { SourceDescription } from "../source/description.js";

/** Frames from the first number to before the second. */
export type FrameRange = readonly [first: number, end: number];

/** The frames that the engine needs at present. */
export interface Demand {
  /** A new number starts a seek: the key frame before `at` is needed immediately, `at` soon. */
  readonly serial: number;
  /** The frame that should be visible; earlier ones are late. */
  readonly at: number;
  /** Frames are decoded up to before this one. */
  readonly until: number;
  /** Packets are fetched up to before this one. */
  readonly ahead: number;
  /** Sound is sent up to before frame `until`, and from the start again with a new serial; undefined if none is wanted. */
  readonly sound?: { readonly serial: number; readonly until: number } | undefined;
}

export type ToDecoder =
  | {
      readonly type: "open";
      readonly source: SourceDescription;
      /** Whether playback starts at the first frame, so that its packet is fetched with the header. */
      readonly fromStart: boolean;
    }
  | { readonly type: "demand"; readonly demand: Demand }
  /** One of the renditions; undefined for automatic selection. */
  | { readonly type: "quality"; readonly quality: number | undefined };

/** Bytes and time of one packet. */
export interface PacketFacts {
  readonly index: number;
  readonly isKey: boolean;
  readonly bytes: number;
  readonly byField: ReadonlyMap<FieldName, number>;
}

/** Growth of a stream in a segments folder. */
export interface LiveFacts {
  /** Whether frames still come. */
  readonly live: boolean;
  /** Distance from the newest frame to maintain during playback. */
  readonly targetSeconds: number;
  /** Recent wall-clock time from frame to frame. */
  readonly frameSeconds: number | undefined;
  /** Recent media time from frame to frame. */
  readonly mediaSeconds: number;
  readonly fps: number;
  /** Unix time at which a frame of presentation time 0 would have been captured, extrapolated from the newest. */
  readonly filmedAtZero: number | undefined;
}

/** All known packets. */
export interface CatalogFacts {
  /** The first available frame. */
  readonly first: number;
  /** The number after that of the last frame. */
  readonly count: number;
  /** Frames with known times, rising; times between them are interpolated. Undefined: all frames from 0 on. */
  readonly frames?: Float64Array;
  /** Times of these frames, seconds, rising. Times of packets that were not read yet are extrapolated. */
  readonly ptsSeconds: Float64Array;
  /** Those that are known. */
  readonly keys: Uint32Array;
  readonly lost: readonly FrameRange[];
  /** Whether no further packets will come. */
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
  /** Available packets, and the total number of bytes fetched so far. */
  | { readonly type: "stored"; readonly ranges: readonly FrameRange[]; readonly fetchedBytes: number }
  | {
      readonly type: "frame";
      readonly serial: number;
      readonly update: SceneUpdate;
      /** The header, if the frame belongs to another period or rendition than the one before. */
      readonly header?: StreamHeader;
      /** False for an intermediate picture: the key frame before the target of a seek, or a late frame. */
      readonly exact: boolean;
      /** Facts of all packets decoded since the last frame. */
      readonly packets: readonly PacketFacts[];
      readonly decodeMilliseconds: number;
    }
  /** The sound of frames in order. It begins before the clock, because decoding it needs that. */
  | { readonly type: "sound"; readonly serial: number; readonly sounds: readonly FrameSound[] }
  /** Frames up to before `end` cannot be shown. */
  | { readonly type: "gap"; readonly serial: number; readonly end: number }
  | { readonly type: "damage"; readonly message: string; readonly lost: FrameRange }
  /** The renditions of the stream, and the one in use. */
  | { readonly type: "qualities"; readonly names: readonly string[]; readonly at: number }
  /** Information for the user. */
  | { readonly type: "notice"; readonly message: string }
  | { readonly type: "waiting"; readonly seconds: number; readonly problem: string | undefined }
  /** Unless it is fatal, the next demand tries again. */
  | { readonly type: "failed"; readonly message: string; readonly fatal: boolean };
