// SPDX-License-Identifier: Apache-2.0
/** A stream in one file: opens it, then reads the parts that are needed. */

import {
  ByteQueue,
  difference,
  HEAD_BYTES,
  RecordType,
  recordBytes,
  recordIn,
  StreamError,
  type StreamHeader,
  type StreamReader,
  unpackedHeader,
} from "@structgstream/core";
import type { ByteClient } from "./byteClient.js";
import type { Place } from "./catalog.js";
import { FileCatalog } from "./fileCatalog.js";
import { Opening, type OpeningEvents } from "./opening.js";
import { PacketLoader } from "./packetLoader.js";
import { PacketStore } from "./packetStore.js";
import { type Chapter, Chapters, type Stream, type StreamEvents } from "./stream.js";

export interface FileEvents extends StreamEvents, Pick<OpeningEvents, "opening"> {
  /** The header is available. */
  begun(stream: FileStream, header: StreamHeader, ranged: boolean): void;
  /** The first packet that is needed at present. */
  wanted(): number;
}

export class FileStream implements Stream {
  readonly catalog: FileCatalog;
  readonly store: PacketStore;
  readonly loader: PacketLoader;
  /** By the number of the period, from 0. */
  private readonly chapters = new Chapters();
  private readonly coming = new Set<number>();
  /** The period of the demanded frames. */
  private current = 0;
  private taken = 0;
  private begun = 1;

  private constructor(
    private readonly client: ByteClient,
    private readonly header: StreamHeader,
    private readonly indexed: boolean,
    budgetBytes: number,
    private readonly events: FileEvents,
  ) {
    this.catalog = new FileCatalog(header.fps, header.codec === "raw");
    this.store = new PacketStore(budgetBytes);
    this.chapters.put(0, header);
    this.loader = new PacketLoader(client, this.catalog, this.store, {
      changed: () => events.stored(),
      damaged: (frame: number, { start }: Place) =>
        events.lost(frame, undefined, `its record at byte ${start} is damaged`),
      waiting: (seconds, problem) => events.waiting(seconds, problem),
      failed: (problem) => events.failed(problem, false),
    });
  }

  /** Opens the client's file. */
  static open(client: ByteClient, name: string, fromStart: boolean, budgetBytes: number, events: FileEvents): void {
    let stream: FileStream | undefined;
    const opening = new Opening(
      client,
      {
        ...events,
        header: (header, ranged, index) => {
          stream = new FileStream(client, header, index !== undefined, budgetBytes, events);
          if (index) stream.catalog.fill(index.entries, index.end);
          events.begun(stream, header, ranged);
          if (index) events.changed();
        },
        read: (reader, ended) => stream?.take(reader, ended),
      },
      name,
      fromStart,
    );
    opening.begin();
  }

  chapter(index: number, ahead: number): Chapter | undefined {
    const { catalog } = this;
    this.current = catalog.period(index);
    // The next period's init record is fetched in advance.
    if (catalog.period(Math.min(ahead, catalog.count) - 1) > this.current) {
      this.opened(catalog.init(this.current + 1).first);
    }
    return this.opened(index);
  }

  private opened(index: number): Chapter | undefined {
    const period = this.catalog.period(index);
    if (!period) this.chapters.put(0, this.header);
    const found = this.chapters.get(period);
    if (!found && !this.catalog.isLost(index)) this.fetch(period);
    return found;
  }

  private fetch(period: number): void {
    const { events, coming, catalog } = this;
    if (coming.has(period)) return;
    coming.add(period);
    const { first, start, end } = catalog.init(period);
    const queue = new ByteQueue();
    this.client.read(start, end, false, {
      bytes: ({ bytes }) => queue.append(bytes),
      end: () => {
        try {
          this.chapters.put(period, this.headerIn(queue, start));
        } catch (error) {
          if (!(error instanceof StreamError)) throw error;
          events.lost(first, catalog.periodEnd(period), error.message);
        }
        coming.delete(period);
        events.stored();
      },
      failed: ({ message }) => {
        coming.delete(period);
        events.failed(message, false);
      },
      waiting: ({ seconds, problem }) => events.waiting(seconds, problem),
    });
  }

  private headerIn(queue: ByteQueue, start: number): StreamHeader {
    const head = queue.peek(HEAD_BYTES);
    const record = head.length === HEAD_BYTES ? recordIn(queue.peek(recordBytes(head)), start) : undefined;
    if (record?.type !== RecordType.init) throw new StreamError(`the init record at byte ${start} is damaged`);
    const header = unpackedHeader(record.payload);
    const differing = difference(this.header, header);
    if (differing) throw new StreamError(`the init record at byte ${start} is another stream's: ${differing}`);
    return header;
  }

  /** Adds the packets that the reader has found since the last call. */
  private take(reader: StreamReader, ended: boolean): void {
    const { catalog, store, indexed, events } = this;
    const keepFrom = events.wanted();
    const sounds = reader.takeSounds();
    const found = reader.packets.slice(this.taken);
    // A packet waits for the sound after it.
    if (this.header.sound && !ended && found.length && sounds.at(-1)?.index !== found.at(-1)!.index) found.pop();
    this.taken += found.length;
    for (const info of found) {
      const before = catalog.count;
      for (; !indexed && (reader.periods[this.begun]?.first ?? Number.POSITIVE_INFINITY) <= info.index; this.begun++) {
        catalog.begin(reader.periods[this.begun]!);
        const header = reader.headerOf(this.begun);
        // Otherwise it is fetched when needed.
        if (header && this.begun <= this.current + 1) this.chapters.put(this.begun, header);
      }
      if (!indexed) catalog.append(info);
      if (!indexed && info.index > before) events.lost(before, info.index, "the record there is damaged");
      store.put(reader.take(info.index), keepFrom);
    }
    for (const sound of sounds) {
      if (!indexed) catalog.extend(sound.index, sound.end);
      store.putSound(sound);
    }
    reader.forgetHeaders();
    if (ended && !indexed) catalog.complete = true;
    if (!indexed) events.changed();
    events.stored();
  }
}
