// SPDX-License-Identifier: Apache-2.0
/** Fetches missing packets by position, one run of neighbouring packets per request. */

import {
  ByteQueue,
  type FrameSound,
  HEAD_BYTES,
  type Packet,
  packetOf,
  RecordType,
  recordBytes,
  recordIn,
  soundOf,
} from "@structgstream/core";
import type { ByteClient, ReadingEvents } from "./byteClient.js";
import type { Catalog, Place } from "./catalog.js";
import type { PacketStore } from "./packetStore.js";
import { Throughput } from "./throughput.js";

/** Largest size of a request, so that a seek never waits long. */
const MAX_RUN_BYTES = 2 ** 22;
/** Number of concurrent requests of files: at the edge of a live stream every packet is a file. */
const MAX_RUNS = 4;
/** Share of the store for packets ahead; the remainder is for packets that were shown. */
const AHEAD_SHARE = 0.6;

export interface LoaderEvents {
  /** Packets have arrived, or one is damaged. */
  changed(): void;
  damaged(index: number, place: Place): void;
  waiting(seconds: number, problem: string | undefined): void;
  /** Frames from `first` to before `end` did not arrive; `file` is their file if there are several. */
  failed(problem: string, temporary: boolean, first: number, end: number, file: string): void;
}

/** Position of a packet, and its kind at the time of the request. */
interface Expected extends Place {
  readonly isKey: boolean;
}

/** An active reading; packets from `next` to before `end` are missing. */
interface Run {
  id: number;
  next: number;
  readonly end: number;
}

export class PacketLoader {
  private runs: Run[] = [];
  private first = 0;
  /** Whether there is no active request. */
  blocked = false;
  readonly throughput = new Throughput();

  /** @param url address of the manifest; files are relative to it */
  constructor(
    private readonly client: ByteClient,
    private readonly catalog: Catalog,
    private readonly store: PacketStore,
    private readonly events: LoaderEvents,
    private readonly url = "",
  ) {}

  /**
   * Requests packets.
   *
   * @param first the packet that is needed first; earlier ones may be removed
   * @param needed the frame after the last one that playback waits for
   * @param ahead the frame after the last one to prefetch if there is room; of a stream in one file, packets are requested
   *   when less than half of these remain
   */
  want(first: number, needed: number, ahead: number): void {
    this.first = first;
    if (this.blocked) return;
    for (;;) {
      const missing = this.firstMissing(first, Math.min(ahead, this.catalog.count));
      if (missing === undefined) return;
      const files = this.catalog.place(missing)!.entry !== undefined;
      const urgent = missing < needed;
      if (urgent && this.runs.some((run) => run.next < missing && run.end > first)) {
        // The packets before it are being fetched.
        if (!files || this.runs.length >= MAX_RUNS) return;
      } else if (urgent) this.cancel();
      else if (files ? this.runs.length >= MAX_RUNS : this.runs.length || missing - first > (ahead - first) / 2) return;
      const end = this.runEnd(missing, first, files && !urgent ? Number.POSITIVE_INFINITY : Math.max(ahead, needed));
      if (end <= missing) return;
      this.begin(missing, end);
      if (!files) return;
    }
  }

  /** Stops requesting. */
  cancel(): void {
    for (const { id } of this.runs) {
      this.client.cancel(id);
      this.throughput.end();
    }
    this.runs = [];
  }

  private firstMissing(first: number, end: number): number | undefined {
    for (let i = first; i < end; i++) if (this.wanted(i) && !this.comes(i)) return i;
    return undefined;
  }

  private comes(index: number): boolean {
    return this.runs.some(({ next, end }) => index >= next && index < end);
  }

  private wanted(index: number): boolean {
    return !this.store.has(index) && !this.catalog.isDamaged(index) && this.catalog.place(index) !== undefined;
  }

  /** The end of the run of missing packets from `from` on within the limit of bytes; at least one packet. */
  private runEnd(from: number, first: number, end: number): number {
    let room = AHEAD_SHARE * this.store.budgetBytes;
    for (let i = first; i < from; i++) room -= this.bytesOf(i);
    room = Math.min(room, MAX_RUN_BYTES);
    const file = this.catalog.place(from)?.entry?.file;
    let next = from;
    let at = this.catalog.place(from)?.start;
    while (next < Math.min(end, this.catalog.count) && this.wanted(next) && (next === first || room > 0)) {
      const place = this.catalog.place(next)!;
      // There is an init record between periods.
      if (place.entry?.file !== file || place.start !== at || this.comes(next)) break;
      at = place.end;
      room -= this.bytesOf(next++);
    }
    return next;
  }

  private bytesOf(index: number): number {
    const place = this.catalog.place(index);
    return place ? place.end - place.start : 0;
  }

  private begin(from: number, end: number): void {
    const queue = new ByteQueue();
    const places: Expected[] = [];
    for (let i = from; i < end; i++) places.push({ ...this.catalog.place(i)!, isKey: this.catalog.isKey(i) });
    const { start, entry } = places[0]!;
    let offset = start;
    const run: Run = { id: 0, next: from, end };
    const over = () => {
      this.runs = this.runs.filter((other) => other !== run);
      this.throughput.end();
    };
    this.throughput.begin();
    this.runs.push(run);
    const events: ReadingEvents = {
      bytes: ({ bytes }) => {
        this.throughput.take(bytes.length);
        queue.append(bytes);
        offset = this.packetsIn(queue, offset, run, places, false);
      },
      end: () => {
        over();
        this.packetsIn(queue, offset, run, places, true);
        this.events.changed();
      },
      failed: ({ message, temporary }) => {
        over();
        this.events.failed(message, temporary, run.next, end, entry?.file ?? "");
      },
      waiting: ({ seconds, problem }) => this.events.waiting(seconds, problem),
    };
    const of = entry && {
      url: this.url,
      entry,
      small: end === from + 1 && start === 0 && places[0]!.end === entry.bytes,
    };
    run.id = this.client.read(start, places.at(-1)!.end, false, events, of);
  }

  /** Removes complete packets from the queue, which begins at byte `offset`; returns its new offset. */
  private packetsIn(queue: ByteQueue, offset: number, run: Run, places: readonly Expected[], ended: boolean): number {
    let at = offset;
    const from = run.end - places.length;
    for (; run.next < run.end; run.next++) {
      const place = places[run.next - from]!;
      const { start, end } = place;
      const gap = Math.min(start - at, queue.length);
      if (gap) queue.skip(gap);
      at += gap;
      const head = queue.peek(HEAD_BYTES);
      const bytes = head.length === HEAD_BYTES ? recordBytes(head) : Number.POSITIVE_INFINITY;
      // What follows the packet up to the next one comes with it: its sound, and records that this version does not know.
      const isThere = at === start && queue.length >= (ended ? bytes : end - start);
      const cannotCome = head.length === HEAD_BYTES && bytes > end - start;
      if (!isThere && !cannotCome && !ended) return at;
      const packet = isThere && !cannotCome ? packetIn(queue.peek(bytes), start) : undefined;
      if (packet?.index === run.next && packet.isKey === place.isKey) {
        const all = Math.min(queue.length, end - start);
        const sound = soundIn(queue.peek(all).subarray(bytes), start + bytes);
        this.store.put(packet, this.first);
        if (sound?.index === packet.index) this.store.putSound(sound);
        queue.skip(all);
        at += all;
        this.events.changed();
      } else this.events.damaged(run.next, place);
    }
    return at;
  }
}

/** The sound in the records of `bytes`, behind layers, with a copy of its payload; undefined if there is none. */
function soundIn(bytes: Uint8Array, offset: number): FrameSound | undefined {
  let at = 0;
  while (bytes.length >= at + HEAD_BYTES && bytes[at] !== RecordType.sound) at += recordBytes(bytes.subarray(at));
  if (bytes.length < at + HEAD_BYTES) return undefined;
  const record = recordIn(bytes.subarray(at, at + recordBytes(bytes.subarray(at))), offset + at);
  return record && soundOf(record.payload.slice());
}

/** The packet of a complete record, with a copy of its payload; undefined if it is damaged or not a packet. */
function packetIn(bytes: Uint8Array, offset: number): Packet | undefined {
  const record = recordIn(bytes, offset);
  if (record?.type !== RecordType.key && record?.type !== RecordType.delta) return undefined;
  try {
    return packetOf(record.payload.slice(), record.type === RecordType.key);
  } catch {
    return undefined; // its checksum is correct but its content is invalid: lost, as a damaged packet
  }
}
