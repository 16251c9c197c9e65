// SPDX-License-Identifier: Apache-2.0
/**
 * What runs in the decode worker: frames in the order in which the engine wants them.
 *
 * One packet is decoded at a time, and messages are heard in between, so that a seek never waits for more than one.
 */

import { type Frame, fieldBytes, type Packet, SceneDecoder, StreamError, type StreamReader } from "@structgstream/core";
import type { ReadReply, ReadRequest } from "../source/description.js";
import type { Port } from "../source/port.js";
import { ByteClient } from "./byteClient.js";
import { Catalog } from "./catalog.js";
import { ChangedFields } from "./changedFields.js";
import type { Demand, FromDecoder, PacketFacts, ToDecoder } from "./messages.js";
import { Opening, type OpeningEvents } from "./opening.js";
import { PacketLoader } from "./packetLoader.js";
import { PacketStore } from "./packetStore.js";
import { Throttle } from "./throttle.js";

/** On a machine that decodes too slowly, a picture comes at least so often. */
const LATE_PICTURE_MILLISECONDS = 250;
/** What changes with every packet is told no more often. */
const TELL_MILLISECONDS = 100;

/** What is known of a stream once its header is there. */
interface Stream {
  readonly decoder: SceneDecoder;
  readonly catalog: Catalog;
  readonly store: PacketStore;
  readonly loader: PacketLoader;
  readonly changed: ChangedFields;
}

export class Decoding {
  private readonly client: ByteClient;
  private stream: Stream | undefined;
  private demand: Demand | undefined;
  private serial = -1;
  /** The next frame to give. */
  private next = 0;
  private seeking = false;
  private decoded: number | undefined;
  private packets: PacketFacts[] = [];
  private milliseconds = 0;
  private givenAt = 0;
  private readonly storedTold = new Throttle(TELL_MILLISECONDS, () => this.tellStored());
  private readonly catalogTold = new Throttle(TELL_MILLISECONDS, () => this.tellCatalog());
  private wake: (() => void) | undefined;

  constructor(
    private readonly port: Port<FromDecoder, ToDecoder>,
    bytes: Port<ReadRequest, ReadReply>,
    private readonly breathe: () => Promise<void>,
  ) {
    this.client = new ByteClient(bytes);
    port.onmessage = ({ data }) => this.obey(data);
    void this.work();
  }

  private obey(message: ToDecoder): void {
    if (message.type === "open") {
      this.client.open(message.source);
      new Opening(this.client, this.openingEvents(message.budgetBytes), message.source.name, message.fromStart).begin();
    } else if (message.type === "demand") this.demand = message.demand;
    else this.stream?.changed.forget();
    this.wake?.();
  }

  private openingEvents(budgetBytes: number): OpeningEvents {
    let indexed = false;
    let taken = 0;
    return {
      opening: (loadedBytes, totalBytes, ended) => this.tell({ type: "opening", loadedBytes, totalBytes, ended }),
      header: (header, ranged, index) => {
        const catalog = new Catalog(header.fps, header.codec === "raw");
        const store = new PacketStore(budgetBytes);
        if (index) catalog.fill(index.entries, index.end);
        indexed = index !== undefined;
        const loader = new PacketLoader(this.client, catalog, store, {
          changed: () => this.storeChanged(),
          damaged: (frame, offset) => this.lose(frame, `its record at byte ${offset} is damaged`),
          waiting: (seconds, problem) => this.tell({ type: "waiting", seconds, problem }),
          failed: (problem) => this.tell({ type: "failed", message: problem, fatal: false }),
        });
        const decoder = new SceneDecoder(header);
        this.stream = { decoder, catalog, store, loader, changed: new ChangedFields(header.dynamic) };
        this.tell({ type: "header", header, ranged });
        if (indexed) this.catalogTold.call();
      },
      read: (reader, ended) => {
        taken = this.takeFrom(reader, taken, indexed);
        if (ended && !indexed && this.stream) this.stream.catalog.complete = true;
        if (!indexed) this.catalogTold.call();
        this.wake?.();
      },
      waiting: (seconds, problem) => this.tell({ type: "waiting", seconds, problem }),
      failed: (problem) => this.tell({ type: "failed", message: problem, fatal: true }),
    };
  }

  /** Takes the packets that the reader found after the first `taken`. */
  private takeFrom(reader: StreamReader, taken: number, indexed: boolean): number {
    const { catalog, store } = this.stream!;
    const keepFrom = this.demand ? catalog.groupStart(this.demand.at) : 0;
    for (const info of reader.packets.slice(taken)) {
      const before = catalog.count;
      if (indexed) catalog.learn(info.index, info.ptsSeconds);
      else catalog.append(info);
      if (!indexed && info.index > before) this.tellDamage(before, info.index, "the record there is damaged");
      store.put(reader.take(info.index), keepFrom);
    }
    if (reader.packets.length > taken) this.storeChanged();
    return reader.packets.length;
  }

  private async work(): Promise<void> {
    for (;;) {
      if (this.step()) await this.breathe();
      else await this.sleep();
    }
  }

  private sleep(): Promise<void> {
    return new Promise((resolve) => {
      this.wake = resolve;
    });
  }

  /** Decodes one packet, if one is wanted and there. */
  private step(): boolean {
    const { stream, demand } = this;
    if (!stream || !demand || !stream.catalog.count) return false;
    if (demand.serial !== this.serial) {
      this.serial = demand.serial;
      this.next = demand.at;
      this.seeking = true;
    }
    if (!this.seeking && demand.at > this.next) this.next = demand.at;
    const target = this.seeking ? stream.catalog.shownFor(this.next) : this.next;
    if (target === undefined) return this.passLost(demand);
    if (!this.seeking && target >= Math.min(demand.until, stream.catalog.count)) {
      stream.loader.want(target, target, demand.ahead);
      return false;
    }
    if (!this.seeking && stream.catalog.isLost(target)) return this.passLost(demand);
    const key = stream.catalog.groupStart(target);
    const goesOn = this.decoded !== undefined && this.decoded >= key && this.decoded < target;
    const first = goesOn ? this.decoded! + 1 : key;
    stream.loader.want(first, target + 1, Math.max(demand.ahead, target + 1));
    const packet = stream.store.get(first);
    if (!packet) return false;
    this.decode(packet, target, key);
    return true;
  }

  private decode(packet: Packet, target: number, key: number): void {
    const { decoder, catalog } = this.stream!;
    const { index } = packet;
    const overdue = performance.now() - this.givenAt > LATE_PICTURE_MILLISECONDS;
    // Key frames are shown on the way: to what is sought, or to where the clock is by now.
    const given = index === target || index === key || (!this.seeking && overdue);
    const start = performance.now();
    let frame: Frame | undefined;
    this.decoded = undefined;
    try {
      if (given) frame = decoder.decode(packet);
      else decoder.advance(packet);
      this.decoded = index;
    } catch (error) {
      if (!(error instanceof StreamError)) throw error;
      catalog.markDamaged(index);
      this.lose(index, error.message.replace(/\.$/, ""));
      return;
    }
    this.milliseconds += performance.now() - start;
    this.packets.push({ index, isKey: packet.isKey, bytes: packet.payload.length + 12, byField: fieldBytes(packet) });
    if (frame) this.give(frame, index === target);
    if (index === target) {
      // A frame that stands for a lost one answers for all up to it.
      this.next = Math.max(index, this.seeking ? this.next : index) + 1;
      this.seeking = false;
    }
  }

  private give(frame: Frame, exact: boolean): void {
    const fields = this.stream!.changed.of(frame.fields);
    const update = { index: frame.index, ptsSeconds: frame.ptsSeconds, fields };
    const { serial, packets, milliseconds } = this;
    const transfer = [...fields.values()].map(({ data }) => data.buffer as ArrayBuffer);
    this.port.postMessage(
      { type: "frame", serial, update, exact, packets, decodeMilliseconds: milliseconds },
      transfer,
    );
    this.packets = [];
    this.milliseconds = 0;
    this.givenAt = performance.now();
  }

  /** Goes on after frames that cannot be shown. */
  private passLost(demand: Demand): boolean {
    const { catalog } = this.stream!;
    let end = this.next;
    while (end < catalog.count && catalog.isLost(end)) end++;
    if (end === this.next) return false;
    this.next = end;
    this.seeking = false;
    this.tell({ type: "gap", serial: demand.serial, end });
    return true;
  }

  private lose(index: number, reason: string): void {
    this.tellDamage(index, this.stream!.catalog.groupEnd(index), reason);
    this.catalogTold.call();
    this.wake?.();
  }

  private tellDamage(first: number, end: number, reason: string): void {
    const frames = end === first + 1 ? `Frame ${first} is` : `Frames ${first} to ${end - 1} are`;
    this.tell({ type: "damage", message: `${frames} lost: ${reason}.`, lost: [first, end] });
  }

  private storeChanged(): void {
    this.storedTold.call();
    this.wake?.();
  }

  private tellStored(): void {
    const ranges = this.stream!.store.ranges();
    this.tell({ type: "stored", ranges, fetchedBytes: this.client.fetchedBytes });
  }

  private tellCatalog(): void {
    this.tell({ type: "catalog", facts: this.stream!.catalog.facts() });
  }

  private tell(message: FromDecoder): void {
    this.port.postMessage(message, []);
  }
}
