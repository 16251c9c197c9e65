// SPDX-License-Identifier: Apache-2.0
/** A stream that is being decoded: its packets, and the chapters of its frames. */

import { SceneDecoder, type StreamHeader } from "@structgstream/core";
import type { Catalog } from "./catalog.js";
import { ChangedFields } from "./changedFields.js";
import type { PacketLoader } from "./packetLoader.js";
import type { PacketStore } from "./packetStore.js";

/** The part of a stream that follows one init record. */
export class Chapter {
  readonly decoder: SceneDecoder;
  readonly changed: ChangedFields;

  constructor(readonly header: StreamHeader) {
    this.decoder = new SceneDecoder(header);
    this.changed = new ChangedFields(header.dynamic);
  }
}

/** Largest number of cached headers of periods. */
const MAX_CHAPTERS = 3;

/** The chapters that were used last, by key of their period. */
export class Chapters {
  private readonly kept = new Map<number, Chapter>();

  get(period: number): Chapter | undefined {
    const found = this.kept.get(period);
    if (found) {
      // The most recently used one is at the end.
      this.kept.delete(period);
      this.kept.set(period, found);
    }
    return found;
  }

  put(period: number, header: StreamHeader): void {
    if (!this.kept.has(period)) this.kept.set(period, new Chapter(header));
    if (this.kept.size > MAX_CHAPTERS) this.kept.delete(this.kept.keys().next().value as number);
  }
}

/** What the streams of a file and of segments folders report. */
export interface StreamEvents {
  /** Further packets are known. */
  changed(): void;
  /** Packets have arrived. */
  stored(): void;
  /** Frames up to before `end`, or all that need the first one, are damaged or not available. */
  lost(first: number, end: number | undefined, reason: string): void;
  waiting(seconds: number, problem: string | undefined): void;
  /** Unless it is fatal, the next demand tries again. */
  failed(message: string, fatal: boolean): void;
}

export interface Stream {
  readonly catalog: Catalog;
  readonly store: PacketStore;
  readonly loader: PacketLoader;
  /**
   * The chapter of a frame; undefined while its page or init record is being fetched.
   *
   * @param ahead the frame after the last one that will be needed soon
   */
  chapter(index: number, ahead: number): Chapter | undefined;
}
