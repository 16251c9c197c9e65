// SPDX-License-Identifier: Apache-2.0
/**
 * Opens a stream: reads its header and the positions of its packets.
 *
 * Of a stored file only the first bytes, the index at its end, the time of the last packet and the rest of the init record
 * are read. Without an index, without range requests, or if frames are not evenly spaced (a live run that skipped some),
 * which an index does not tell, the whole file is read from its start, and packets are found as they arrive.
 */

import {
  FOOTER_BYTES,
  type IndexEntry,
  indexEntries,
  indexOffset,
  packetSeconds,
  type StreamHeader,
  StreamReader,
  TIMED_BYTES,
} from "@structgstream/core";
import { joined } from "../source/joined.js";
import type { ByteClient, ReadingEvents } from "./byteClient.js";
import type { StreamEvents } from "./stream.js";

const HEAD_BYTES = 4096;
const TAIL_BYTES = 4096;
/** Largest number of entries of an index: 3 hours at 100 frames per second. */
const MAX_INDEX_BYTES = 2 ** 24;

/** Events of opening, in this order: progress, the header, then packets. */
export interface OpeningEvents extends Pick<StreamEvents, "waiting" | "failed"> {
  /** `ended`: the file ends within its header at present. */
  opening(loadedBytes: number, totalBytes: number | undefined, ended: boolean): void;
  /** `index` is defined if it has the positions of all packets, with the offset after the last one. */
  header(header: StreamHeader, ranged: boolean, index: { entries: IndexEntry[]; end: number } | undefined): void;
  /** The reader has new packets or has found damage; no event follows `ended`. */
  read(reader: StreamReader, ended: boolean): void;
}

export class Opening {
  private readonly reader: StreamReader;
  private ranged = true;
  private fileBytes: number | undefined;
  private loaded = 0;
  private index: { entries: IndexEntry[]; end: number; lastSeconds: number } | undefined;
  /** Decides between the index and a scan. */
  private lookedForIndex = false;
  private announced = false;
  private reading: number | undefined;
  private readonly troubles: Pick<ReadingEvents, "failed" | "waiting"> = {
    failed: ({ message }) => this.events.failed(message, true),
    waiting: ({ seconds, problem }) => this.events.waiting(seconds, problem),
  };

  constructor(
    private readonly client: ByteClient,
    private readonly events: OpeningEvents,
    name: string,
    private readonly fromStart: boolean,
  ) {
    this.reader = new StreamReader(name);
  }

  begin(): void {
    this.read(0, HEAD_BYTES, true, () => {
      if (!this.ranged || this.fileBytes === undefined || this.loaded >= this.fileBytes) this.scan();
      else this.readTail(Math.max(this.loaded, this.fileBytes - TAIL_BYTES), this.fileBytes);
    });
  }

  /** Reads from `start` on into the reader; calls `then` at the end. */
  private read(start: number, end: number, wholeIfNeeded: boolean, then: () => void): void {
    this.reading = this.client.read(start, end, wholeIfNeeded, {
      begin: ({ fileBytes, ranged }) => {
        this.fileBytes ??= fileBytes;
        this.ranged &&= ranged || !wholeIfNeeded;
        this.lookedForIndex ||= !this.ranged;
      },
      bytes: ({ bytes }) => this.take(bytes),
      end: then,
      ...this.troubles,
    });
  }

  private readTail(start: number, fileBytes: number): void {
    const parts: Uint8Array[] = [];
    this.client.read(start, fileBytes, false, {
      bytes: ({ bytes }) => parts.push(bytes),
      end: () => this.lookAtTail(joined(parts), start, fileBytes),
      ...this.troubles,
    });
  }

  private lookAtTail(tail: Uint8Array, start: number, fileBytes: number): void {
    const footer = tail.subarray(-FOOTER_BYTES);
    const offset = start + tail.length === fileBytes ? indexOffset(footer, fileBytes) : undefined;
    if (offset === undefined || fileBytes - offset > MAX_INDEX_BYTES) this.scan();
    else if (offset < start) this.readTail(offset, fileBytes);
    else this.useIndex(indexEntries(tail.subarray(offset - start, -FOOTER_BYTES), offset), offset);
  }

  private useIndex(entries: IndexEntry[] | undefined, offset: number): void {
    const [first, last] = [entries?.[0], entries?.at(-1)];
    if (!entries || !first || !last) {
      this.scan();
      return;
    }
    const parts: Uint8Array[] = [];
    const useTime = () => {
      const start = joined(parts);
      if (start.length < TIMED_BYTES) {
        this.scan();
        return;
      }
      this.index = { entries, end: offset, lastSeconds: packetSeconds(start) };
      this.lookedForIndex = true;
      const end = this.fromStart ? (entries[1]?.offset ?? offset) : first.offset;
      if (this.loaded >= end) this.headerByIndex(end);
      else this.read(this.loaded, end, false, () => this.headerByIndex(end));
    };
    this.client.read(last.offset, last.offset + TIMED_BYTES, false, {
      bytes: ({ bytes }) => parts.push(bytes),
      end: useTime,
      ...this.troubles,
    });
  }

  /** Called when all bytes up to `end` were read; with a damaged index the header may be missing. */
  private headerByIndex(end: number): void {
    if (this.announced) return;
    this.index = undefined;
    if (this.loaded >= end) this.scan();
  }

  /** Reads the remaining bytes and those that are appended. */
  private scan(): void {
    this.lookedForIndex = true;
    this.announceIfThere();
    this.reading = this.client.follow(this.loaded, {
      begin: ({ fileBytes }) => {
        this.fileBytes = fileBytes ?? this.fileBytes;
      },
      bytes: ({ bytes }) => this.take(bytes),
      end: () => this.finish(),
      ...this.troubles,
      waiting: ({ seconds, problem }) => {
        if (!this.announced && problem === undefined) this.events.opening(this.loaded, undefined, true);
        this.events.waiting(seconds, problem);
      },
    });
  }

  private finish(): void {
    this.guarded(() => {
      this.reader.finish();
      this.events.read(this.reader, true);
    });
  }

  private take(bytes: Uint8Array): void {
    this.loaded += bytes.length;
    this.guarded(() => {
      this.reader.push(bytes);
      const complete = this.reader.state === "complete";
      this.lookedForIndex ||= complete;
      if (!this.announced) this.events.opening(this.loaded, this.index?.entries[0]?.offset ?? this.fileBytes, false);
      this.announceIfThere();
      if (this.announced) this.events.read(this.reader, complete);
      if (complete) this.stop();
    });
  }

  private announceIfThere(): void {
    const { header } = this.reader;
    if (this.announced || !header || !this.lookedForIndex) return;
    if (this.index && !this.isEvenlySpaced(header.fps)) {
      this.index = undefined;
      this.stop();
      this.scan();
      return;
    }
    this.announced = true;
    this.events.header(header, this.ranged, this.index);
    this.events.read(this.reader, false);
  }

  /** Whether the last frame has the time that its number states, so that all times follow from numbers. */
  private isEvenlySpaced(fps: number): boolean {
    const { entries, lastSeconds } = this.index!;
    return Math.abs(lastSeconds * fps - entries.at(-1)!.index) < 0.5;
  }

  private guarded(action: () => void): void {
    try {
      action();
    } catch (error) {
      this.stop();
      this.events.failed(error instanceof Error ? error.message : String(error), true);
    }
  }

  private stop(): void {
    if (this.reading !== undefined) this.client.cancel(this.reading);
  }
}
