// SPDX-License-Identifier: Apache-2.0
/** Fetches packets by their places, one run of neighbours with each request, and nothing that is there already. */

import { ByteQueue, HEAD_BYTES, type Packet, packetOf, RecordType, recordBytes, recordIn } from "@structgstream/core";
import type { ByteClient } from "./byteClient.js";
import type { Catalog } from "./catalog.js";
import type { PacketStore } from "./packetStore.js";

/** One request asks for no more than this, so that a seek never has to wait for long. */
const MOST_RUN_BYTES = 2 ** 22;
/** Of the store, so much is for packets ahead; the rest keeps what was shown. */
const AHEAD_SHARE = 0.6;

export interface LoaderEvents {
  /** Packets have come, or one has been found damaged. */
  changed(): void;
  damaged(index: number, offset: number): void;
  waiting(seconds: number, problem: string | undefined): void;
  failed(message: string): void;
}

/** A reading that goes on: packets from `next` to before `end` are still to come. */
interface Run {
  readonly id: number;
  next: number;
  readonly end: number;
}

export class PacketLoader {
  private run: Run | undefined;
  private first = 0;

  constructor(
    private readonly client: ByteClient,
    private readonly catalog: Catalog,
    private readonly store: PacketStore,
    private readonly events: LoaderEvents,
  ) {}

  /**
   * Sees to it that packets come.
   *
   * @param first the packet that is needed first; those before it may be let go of
   * @param needed the frame after the last that is waited for
   * @param ahead the frame after the last that is wanted, as far as there is room; they are asked for when less than
   *   half of them is left
   */
  want(first: number, needed: number, ahead: number): void {
    this.first = first;
    const missing = this.firstMissing(first, Math.min(ahead, this.catalog.count));
    if (missing === undefined) return;
    if (this.run && missing >= this.run.next && missing < this.run.end) return;
    if (missing >= needed && (this.run || missing - first > (ahead - first) / 2)) return;
    if (this.run) this.client.cancel(this.run.id);
    this.run = undefined;
    const end = this.runEnd(missing, first, Math.max(ahead, needed));
    if (end > missing) this.begin(missing, end);
  }

  private firstMissing(first: number, end: number): number | undefined {
    for (let i = first; i < end; i++) if (this.wanted(i)) return i;
    return undefined;
  }

  private wanted(index: number): boolean {
    return !this.store.has(index) && !this.catalog.isDamaged(index) && this.catalog.place(index) !== undefined;
  }

  /** The end of the run of missing packets that begins with `from`, as far as bytes allow; one always goes. */
  private runEnd(from: number, first: number, end: number): number {
    let room = AHEAD_SHARE * this.store.budgetBytes;
    for (let i = first; i < from; i++) room -= this.bytesOf(i);
    room = Math.min(room, MOST_RUN_BYTES);
    let next = from;
    while (next < Math.min(end, this.catalog.count) && this.wanted(next) && (next === first || room > 0)) {
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
    let offset = this.catalog.place(from)!.start;
    const id = this.client.read(offset, this.catalog.place(end - 1)!.end, false, {
      bytes: (bytes) => {
        queue.append(bytes);
        offset = this.packetsIn(queue, offset, run, false);
      },
      end: () => {
        this.packetsIn(queue, offset, run, true);
        if (this.run === run) this.run = undefined;
        this.events.changed();
      },
      failed: (message) => {
        if (this.run === run) this.run = undefined;
        this.events.failed(message);
      },
      waiting: (seconds, problem) => this.events.waiting(seconds, problem),
    });
    const run: Run = { id, next: from, end };
    this.run = run;
  }

  /** Takes whole packets from the queue, which begins at byte `offset`; gives back where it begins then. */
  private packetsIn(queue: ByteQueue, offset: number, run: Run, ended: boolean): number {
    let at = offset;
    for (; run.next < run.end; run.next++) {
      const { start, end } = this.catalog.place(run.next)!;
      const gap = Math.min(start - at, queue.length);
      if (gap) queue.skip(gap);
      at += gap;
      const head = queue.peek(HEAD_BYTES);
      const bytes = head.length === HEAD_BYTES ? recordBytes(head) : Number.POSITIVE_INFINITY;
      const isThere = at === start && queue.length >= bytes;
      const cannotCome = head.length === HEAD_BYTES && bytes > end - start;
      if (!isThere && !cannotCome && !ended) return at;
      const packet = isThere && !cannotCome ? packetIn(queue.peek(bytes), start) : undefined;
      if (packet?.index === run.next && packet.isKey === this.catalog.isKey(run.next)) {
        this.catalog.learn(packet.index, packet.ptsSeconds);
        this.store.put(packet, this.first);
        queue.skip(bytes);
        at += bytes;
        this.events.changed();
      } else {
        this.catalog.markDamaged(run.next);
        this.events.damaged(run.next, start);
      }
    }
    return at;
  }
}

/** The packet of a whole record, its payload copied; undefined when it is damaged or something else. */
function packetIn(bytes: Uint8Array, offset: number): Packet | undefined {
  const record = recordIn(bytes, offset);
  if (record?.type !== RecordType.key && record?.type !== RecordType.delta) return undefined;
  try {
    return packetOf(record.payload.slice(), record.type === RecordType.key);
  } catch {
    return undefined; // its checksum is right and it follows no format: lost like any other that is damaged
  }
}
