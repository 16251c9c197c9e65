// SPDX-License-Identifier: Apache-2.0
/**
 * The decode worker: decodes frames in the order that the engine requests.
 *
 * One packet is decoded at a time, and messages are handled in between, so a seek waits for at most one packet.
 */

import { type Frame, type FrameSound, fieldBytes, type Packet, StreamError } from "@structgstream/core";
import type { ReadReply, ReadRequest } from "../source/description.js";
import type { Port } from "../source/port.js";
import { ByteClient } from "./byteClient.js";
import { FileStream } from "./fileStream.js";
import type { Demand, FromDecoder, PacketFacts, ToDecoder } from "./messages.js";
import { SegmentedStreams } from "./segmentedStreams.js";
import type { Chapter, Stream, StreamEvents } from "./stream.js";
import { Throttle } from "./throttle.js";

const BUDGET_BYTES = 64 * 2 ** 20;
/** Longest interval between pictures on a machine that decodes too slowly. */
const LATE_PICTURE_MILLISECONDS = 250;
/** Shortest interval between messages about values that change with every packet. */
const POST_MILLISECONDS = 100;
/** Sound begins so many frames before the clock. */
const SOUND_LEAD_FRAMES = 8;

export class Decoding {
  private readonly client: ByteClient;
  private stream: Stream | undefined;
  /** Streams in segments folders. */
  private segmented: SegmentedStreams | undefined;
  private demand: Demand | undefined;
  private serial = -1;
  /** The next frame to send. */
  private next = 0;
  private seeking = false;
  private decoded: number | undefined;
  /** The chapter of the last decoded packet. */
  private chapter: Chapter | undefined;
  /** The chapter of the last sent frame. */
  private announced: Chapter | undefined;
  private packets: PacketFacts[] = [];
  private milliseconds = 0;
  private givenAt = 0;
  private readonly storedPosts = new Throttle(POST_MILLISECONDS, () => this.postStored());
  private readonly catalogPosts = new Throttle(POST_MILLISECONDS, () => this.postCatalog());
  private wake: (() => void) | undefined;
  /** The next frame whose sound is sent, for the demand of this serial. */
  private sound: { readonly serial: number; next: number } | undefined;

  /** @param budgetBytes largest number of bytes of stored packets */
  constructor(
    private readonly port: Port<FromDecoder, ToDecoder>,
    bytes: Port<ReadRequest, ReadReply>,
    private readonly breathe: () => Promise<void>,
    private readonly budgetBytes = BUDGET_BYTES,
  ) {
    this.client = new ByteClient(bytes);
    port.onmessage = ({ data }) => this.obey(data);
    void this.work();
  }

  private obey(message: ToDecoder): void {
    if (message.type === "open") this.open(message);
    else if (message.type === "demand") {
      this.demand = message.demand;
      this.sendSound();
    } else this.segmented?.choose(message.quality);
    this.wake?.();
  }

  private open({ source, fromStart }: ToDecoder & { type: "open" }): void {
    this.client.open(source);
    const common: StreamEvents = {
      changed: () => this.catalogChanged(),
      stored: () => this.storeChanged(),
      lost: (first, end, reason) => this.lose(first, end, reason),
      waiting: (seconds, problem) => this.post({ type: "waiting", seconds, problem }),
      failed: (message, fatal) => this.post({ type: "failed", message, fatal }),
    };
    if (source.kind === "segments") {
      this.segmented = new SegmentedStreams(this.client, source.url, source.name, this.budgetBytes, {
        ...common,
        begun: (stream) => this.begin(stream),
        notice: (message) => this.post({ type: "notice", message }),
        qualities: (names, at) => this.post({ type: "qualities", names, at }),
      });
      return;
    }
    FileStream.open(this.client, source.name, fromStart, this.budgetBytes, {
      ...common,
      opening: (loadedBytes, totalBytes, ended) => this.post({ type: "opening", loadedBytes, totalBytes, ended }),
      begun: (stream, header, ranged) => {
        this.begin(stream);
        this.announced = stream.chapter(0, 0);
        this.post({ type: "header", header, ranged });
      },
      wanted: () => (this.demand && this.stream ? this.stream.catalog.groupStart(this.demand.at) : 0),
    });
  }

  private begin(stream: Stream): void {
    this.stream = stream;
    this.decoded = undefined;
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

  /** Decodes one packet, if one is needed and available. */
  private step(): boolean {
    const { demand } = this;
    if (!this.stream?.catalog.count || !demand) return false;
    if (demand.serial !== this.serial) {
      this.serial = demand.serial;
      this.next = demand.at;
      this.seeking = true;
    }
    if (!this.seeking && demand.at > this.next) this.next = demand.at;
    const changed = this.segmented?.changed(this.next, demand, this.seeking);
    if (changed) {
      this.begin(changed);
      this.catalogChanged();
      this.storeChanged();
    }
    const { stream } = this;
    const target = this.seeking ? stream.catalog.shownFor(this.next) : this.next;
    if (target === undefined) return this.passLost(stream, demand);
    if (!this.seeking && target >= Math.min(demand.until, stream.catalog.count)) {
      if (stream.chapter(Math.min(target, stream.catalog.count - 1), demand.ahead)) {
        stream.loader.want(target, target, demand.ahead);
      }
      return false;
    }
    if (!this.seeking && stream.catalog.isLost(target)) return this.passLost(stream, demand);
    const chapter = stream.chapter(target, demand.ahead);
    if (!chapter) return false;
    const key = stream.catalog.groupStart(target);
    const isSame = chapter === this.chapter;
    const goesOn = isSame && this.decoded !== undefined && this.decoded >= key && this.decoded < target;
    const first = goesOn ? this.decoded! + 1 : key;
    stream.loader.want(first, target + 1, Math.max(demand.ahead, target + 1));
    const packet = stream.store.get(first);
    if (!packet) return false;
    this.decode(chapter, packet, target, key);
    return true;
  }

  private decode(chapter: Chapter, packet: Packet, target: number, key: number): void {
    const { index } = packet;
    const overdue = performance.now() - this.givenAt > LATE_PICTURE_MILLISECONDS;
    // Key frames are shown on the way to the target of a seek, or to the clock.
    const given = index === target || index === key || (!this.seeking && overdue);
    const start = performance.now();
    let frame: Frame | undefined;
    this.decoded = undefined;
    this.chapter = chapter;
    try {
      if (given) frame = chapter.decoder.decode(packet);
      else chapter.decoder.advance(packet);
      this.decoded = index;
    } catch (error) {
      if (!(error instanceof StreamError)) throw error;
      this.lose(index, undefined, error.message);
      return;
    }
    this.milliseconds += performance.now() - start;
    this.packets.push({ index, isKey: packet.isKey, bytes: packet.payload.length + 12, byField: fieldBytes(packet) });
    if (frame) this.give(chapter, frame, index === target);
    if (index === target) {
      // A frame that replaces a lost one counts for all frames up to it.
      this.next = Math.max(index, this.seeking ? this.next : index) + 1;
      this.seeking = false;
    }
  }

  private give(chapter: Chapter, frame: Frame, exact: boolean): void {
    const { announced } = this;
    if (chapter !== announced) chapter.changed.forget();
    if (!announced) this.post({ type: "header", header: chapter.header, ranged: true });
    this.announced = chapter;
    const fields = chapter.changed.of(frame.fields);
    const update = { index: frame.index, ptsSeconds: frame.ptsSeconds, fields };
    const { serial, packets, milliseconds } = this;
    const transfer = [...fields.values()].map(({ data }) => data.buffer as ArrayBuffer);
    const header = announced && chapter !== announced ? { header: chapter.header } : {};
    this.port.postMessage(
      { type: "frame", serial, update, exact, packets, decodeMilliseconds: milliseconds, ...header },
      transfer,
    );
    this.packets = [];
    this.milliseconds = 0;
    this.givenAt = performance.now();
  }

  /** Continues after frames that cannot be shown. */
  private passLost({ catalog }: Stream, demand: Demand): boolean {
    let end = this.next;
    while (end < catalog.count && catalog.isLost(end)) end++;
    if (end === this.next) return false;
    this.next = end;
    this.seeking = false;
    this.post({ type: "gap", serial: demand.serial, end });
    return true;
  }

  /** Reports that frames from `first` to before `end`, or all that need the first one, cannot be shown. */
  private lose(first: number, end: number | undefined, reason: string): void {
    const { catalog } = this.stream!;
    catalog.markDamaged(first, end);
    const last = (end ?? catalog.groupEnd(first)) - 1;
    const frames = last === first ? `Frame ${first} is` : `Frames ${first} to ${last} are`;
    this.post({ type: "damage", message: `${frames} lost: ${reason.replace(/\.$/, "")}.`, lost: [first, last + 1] });
    this.catalogPosts.call();
    this.wake?.();
  }

  /** Sends the sound that is there and was not sent yet. */
  private sendSound(): void {
    const { stream, demand } = this;
    if (!stream || !demand?.sound) return;
    const { serial, until } = demand.sound;
    const from = Math.max(demand.at - SOUND_LEAD_FRAMES, stream.catalog.first);
    if (this.sound?.serial !== serial) this.sound = { serial, next: from };
    this.sound.next = Math.max(this.sound.next, from);
    const sounds: FrameSound[] = [];
    for (; this.sound.next < Math.min(until, stream.catalog.count); this.sound.next++) {
      const { next } = this.sound;
      const sound = stream.store.sound(next);
      // Sound comes with the packet; of a lost frame there is none.
      const comes = next >= demand.at && !stream.store.has(next) && !stream.catalog.isDamaged(next);
      if (!sound && comes) break;
      if (sound) sounds.push(sound);
    }
    if (sounds.length) this.post({ type: "sound", serial, sounds });
  }

  private catalogChanged(): void {
    this.catalogPosts.call();
    this.wake?.();
  }

  private storeChanged(): void {
    this.sendSound();
    this.storedPosts.call();
    this.wake?.();
  }

  private postStored(): void {
    if (!this.stream) return;
    this.post({ type: "stored", ranges: this.stream.store.ranges(), fetchedBytes: this.client.fetchedBytes });
  }

  private postCatalog(): void {
    if (this.stream) this.post({ type: "catalog", facts: this.stream.catalog.facts() });
  }

  private post(message: FromDecoder): void {
    this.port.postMessage(message, []);
  }
}
