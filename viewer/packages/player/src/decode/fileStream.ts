// SPDX-License-Identifier: Apache-2.0
/** A stream that is one file: opened, then read where it is needed. */

import type { StreamHeader, StreamReader } from "@structgstream/core";
import type { ByteClient } from "./byteClient.js";
import type { Place } from "./catalog.js";
import { FileCatalog } from "./fileCatalog.js";
import { Opening } from "./opening.js";
import { PacketLoader } from "./packetLoader.js";
import { PacketStore } from "./packetStore.js";
import { Chapter, type Stream } from "./stream.js";

export interface FileEvents {
  opening(loadedBytes: number, totalBytes: number | undefined, ended: boolean): void;
  /** The header is there. */
  begun(stream: FileStream, header: StreamHeader, ranged: boolean): void;
  /** More packets are known of. */
  changed(): void;
  /** Packets have come. */
  stored(): void;
  /** Frames up to before `end`, or all that need the first one, are damaged. */
  lost(first: number, end: number | undefined, reason: string): void;
  waiting(seconds: number, problem: string | undefined): void;
  /** Unless it is fatal, the next demand is another attempt. */
  failed(message: string, fatal: boolean): void;
  /** The first packet that is wanted now. */
  wanted(): number;
}

export class FileStream implements Stream {
  readonly catalog: FileCatalog;
  readonly store: PacketStore;
  readonly loader: PacketLoader;
  private readonly only: Chapter;
  private taken = 0;

  private constructor(
    client: ByteClient,
    header: StreamHeader,
    private readonly indexed: boolean,
    budgetBytes: number,
    private readonly events: FileEvents,
  ) {
    this.catalog = new FileCatalog(header.fps, header.codec === "raw");
    this.store = new PacketStore(budgetBytes);
    this.only = new Chapter(header);
    this.loader = new PacketLoader(client, this.catalog, this.store, {
      changed: () => events.stored(),
      damaged: (frame: number, { start }: Place) =>
        events.lost(frame, undefined, `its record at byte ${start} is damaged`),
      waiting: (seconds, problem) => events.waiting(seconds, problem),
      failed: (problem) => events.failed(problem, false),
    });
  }

  /** Opens the file that the client has been told of. */
  static open(client: ByteClient, name: string, fromStart: boolean, budgetBytes: number, events: FileEvents): void {
    let stream: FileStream | undefined;
    const opening = new Opening(
      client,
      {
        opening: (loadedBytes, totalBytes, ended) => events.opening(loadedBytes, totalBytes, ended),
        header: (header, ranged, index) => {
          stream = new FileStream(client, header, index !== undefined, budgetBytes, events);
          if (index) stream.catalog.fill(index.entries, index.end);
          events.begun(stream, header, ranged);
          if (index) events.changed();
        },
        read: (reader, ended) => stream?.take(reader, ended),
        waiting: (seconds, problem) => events.waiting(seconds, problem),
        failed: (problem) => events.failed(problem, true),
      },
      name,
      fromStart,
    );
    opening.begin();
  }

  chapter(): Chapter {
    return this.only;
  }

  /** Takes the packets that the reader has found since the last time. */
  private take(reader: StreamReader, ended: boolean): void {
    const { catalog, store, indexed, events } = this;
    const keepFrom = events.wanted();
    const found = reader.packets.slice(this.taken);
    this.taken = reader.packets.length;
    for (const info of found) {
      const before = catalog.count;
      if (indexed) catalog.learn(info.index, info.ptsSeconds);
      else catalog.append(info);
      if (!indexed && info.index > before) events.lost(before, info.index, "the record there is damaged");
      store.put(reader.take(info.index), keepFrom);
    }
    if (ended && !indexed) catalog.complete = true;
    if (!indexed) events.changed();
    events.stored();
  }
}
