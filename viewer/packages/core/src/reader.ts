// SPDX-License-Identifier: Apache-2.0
/**
 * Reads a stream as it arrives, or a whole file at once.
 *
 * A reader stores the payloads of packets, so that any frame can be decoded; `forget` removes old ones. Memory depends
 * only on the bytes that have arrived, never on sizes that a record states.
 */

import { ByteQueue } from "./byteQueue.js";
import { type Damage, lastFrame, Search, type Standing } from "./damage.js";
import { type Frame, type Packet, packetOf, SceneDecoder } from "./decoder.js";
import { StreamError } from "./errors.js";
import { difference, type Period, type StreamHeader } from "./header.js";
import { unpackedHeader } from "./initRecord.js";
import {
  CHECKSUM_BYTES,
  checkPrefix,
  HEAD_BYTES,
  isSignature,
  PREFIX_BYTES,
  RecordType,
  recordBytes,
  recordIn,
  type StreamRecord,
} from "./records.js";
import { type FrameSound, soundOf } from "./sound.js";

/** One packet's position in the stream: `bytes` is the length of the record at byte `offset`. */
export interface PacketInfo {
  readonly isKey: boolean;
  readonly index: number;
  readonly ptsSeconds: number;
  readonly offset: number;
  readonly bytes: number;
}

/**
 * State of reading: more bytes may come; the index has come, so the run that wrote the stream finished; or a record was
 * damaged, and nothing after it can be used.
 */
export type ReaderState = "reading" | "complete" | "damaged";

/** A period; its header is undefined if it was removed. */
interface Begun extends Period {
  header: StreamHeader | undefined;
}

/** A complete packet; its payload is undefined if it was removed. */
interface Kept {
  readonly info: PacketInfo;
  payload: Uint8Array | undefined;
  /** Whether no packet that it needs is lost. */
  readonly shown: boolean;
}

/** The sound of a frame; its record ends at byte `end` of the stream. */
export interface StoredSound extends FrameSound {
  readonly end: number;
}

export class StreamReader {
  private readonly queue = new ByteQueue();
  private readonly search = new Search();
  /** By frame; undefined for lost packets. */
  private readonly frames: (Kept | undefined)[] = [];
  private sounds: StoredSound[] = [];
  private readonly whole: PacketInfo[] = [];
  private readonly damaged: Standing[] = [];
  private searching: Standing | undefined;
  /** Damage since the last complete packet; the number of lost frames is not known before the next one. */
  private open: Standing | undefined;
  private readonly begun: Begun[] = [];
  /** The next packet is the first of its period. */
  private begins = true;
  private afterSeconds = Number.NEGATIVE_INFINITY;
  private forgotten = 0;
  private offset = 0;
  private decoder: { readonly of: StreamHeader; readonly scenes: SceneDecoder } | undefined;
  private failure: StreamError | undefined;
  private standing: ReaderState = "reading";
  private decoded: number | undefined;

  /** @param name name of the stream in messages */
  constructor(readonly name = "The stream") {}

  /** The header of the first init record; undefined until it has arrived. */
  get header(): StreamHeader | undefined {
    return this.begun[0]?.header;
  }

  /** The periods; one without a packet yet begins with the next packet. */
  get periods(): readonly Period[] {
    return this.begun;
  }

  /** The header of a period, by its index in {@link periods}; undefined if it was removed. */
  headerOf(place: number): StreamHeader | undefined {
    return this.begun[place]?.header;
  }

  /** Removes the headers of all periods except the first and the last. */
  forgetHeaders(): void {
    for (const period of this.begun.slice(1, -1)) period.header = undefined;
  }

  /** Every complete packet so far, in order; indices have gaps where packets are lost. */
  get packets(): readonly PacketInfo[] {
    return this.whole;
  }

  /** Damaged records that others follow, with their lost frames as far as known. */
  get damage(): readonly Damage[] {
    return this.damaged.map(({ offset, expected }) => {
      const shown = this.frames.findIndex((kept, index) => index >= expected && kept?.shown);
      return { offset, first: expected, end: shown < 0 ? this.frames.length : shown };
    });
  }

  get state(): ReaderState {
    return this.standing;
  }

  /**
   * Adds the next bytes of the stream, any number of them.
   *
   * @throws StreamError not a stream, another major version, a damaged init record, or inconsistent records; every later
   *   call throws, too
   */
  push(bytes: Uint8Array): void {
    if (this.failure) throw this.failure;
    if (this.standing !== "reading") return;
    this.queue.append(bytes);
    try {
      this.advance();
    } catch (error) {
      if (error instanceof StreamError) this.failure = error;
      this.queue.clear();
      throw error;
    }
  }

  /**
   * States that no more bytes will come.
   *
   * @throws StreamError nothing of the stream can be shown
   */
  finish(): void {
    if (this.failure) throw this.failure;
    if (this.header) {
      try {
        this.goOn();
      } catch (error) {
        if (error instanceof StreamError) this.failure = error;
        throw error;
      } finally {
        this.queue.clear();
      }
      return;
    }
    if (this.offset === 0) checkPrefix(this.queue.peek(PREFIX_BYTES), this.name);
    const end = this.offset + this.queue.length;
    throw new StreamError(`Nothing of ${this.name} can be shown: it is cut at byte ${end}, within the init record.`);
  }

  /**
   * The scene of one frame, decoded from the last one if that is in the same group and earlier, else from its key packet on.
   *
   * @throws StreamError there is no such frame, or it was removed, lost or damaged
   */
  frame(index: number): Frame {
    if (!this.frames[index]?.shown) throw this.missing(index);
    const scenes = this.decoderOf(index);
    const [start, after] = [this.groupStart(index), (this.decoded ?? index) + 1];
    const first = start < after && after <= index ? after : start;
    this.decoded = undefined; // until a packet has been decoded
    for (let i = first; i < index; i++) scenes.advance(this.packet(i));
    const frame = scenes.decode(this.packet(index));
    this.decoded = index;
    return frame;
  }

  /** The first packet that frame `index` needs: a key packet; with codec `raw` its own. */
  groupStart(index: number): number {
    let first = index;
    while (this.header?.codec !== "raw" && first > 0 && !this.frames[first]?.info.isKey) first--;
    return first;
  }

  /** Removes the packets that no frame from `index` on needs. */
  forget(index: number): void {
    const end = this.groupStart(Math.min(index, this.frames.length - 1));
    for (; this.forgotten < end; this.forgotten++) this.remove(this.forgotten);
    this.sounds = this.sounds.filter((sound) => sound.index >= end);
  }

  /**
   * Removes and returns the packet of one frame, for callers that store packets themselves.
   *
   * @throws StreamError there is no such packet, or it was removed before
   */
  take(index: number): Packet {
    const packet = this.packet(index);
    this.remove(index);
    return packet;
  }

  /** Removes and returns the sound that has been read since the last call, in order. */
  takeSounds(): StoredSound[] {
    const { sounds } = this;
    this.sounds = [];
    return sounds;
  }

  private decoderOf(index: number): SceneDecoder {
    const header = this.begun.filter(({ first }) => first <= index).at(-1)?.header;
    if (!header) throw new StreamError(`The header of frame ${index} of ${this.name} is no longer in memory.`);
    if (this.decoder?.of !== header) this.decoder = { of: header, scenes: new SceneDecoder(header) };
    return this.decoder.scenes;
  }

  private missing(index: number): StreamError {
    for (const { offset, first, end } of this.damage) {
      if (index < first || index >= end) continue;
      return new StreamError(
        `Frame ${index} of ${this.name} is lost: the record at byte ${offset}, where frame ${first} should be, is damaged.`,
      );
    }
    const have = this.frames.length ? `frames 0 to ${this.frames.length - 1}` : "no whole frame";
    return new StreamError(`${this.name} has ${have}; there is no frame ${index}.`);
  }

  private packet(index: number): Packet {
    const kept = this.frames[index];
    if (!kept?.payload) throw new StreamError(`Frame ${index} of ${this.name} is no longer in memory.`);
    return { ...kept.info, payload: kept.payload };
  }

  private remove(index: number): void {
    const kept = this.frames[index];
    if (kept) kept.payload = undefined;
  }

  private advance(): void {
    if (this.offset === 0) {
      const prefix = this.queue.peek(PREFIX_BYTES);
      if (prefix.length === PREFIX_BYTES || !isSignature(prefix)) checkPrefix(prefix, this.name);
      if (prefix.length < PREFIX_BYTES) return;
      this.skip(PREFIX_BYTES);
    }
    while (this.standing === "reading") {
      if (this.searching && !this.searched(this.searching, true)) break;
      if (this.queue.length < HEAD_BYTES + CHECKSUM_BYTES) break;
      const size = recordBytes(this.queue.peek(HEAD_BYTES));
      if (size > this.queue.length) break;
      const record = recordIn(this.queue.peek(size), this.offset);
      if (record) {
        // The payload is copied, so that the queue's memory can be released.
        this.add({ ...record, payload: record.payload.slice() }, size);
        this.skip(size);
      } else this.stop();
    }
    if (this.standing !== "reading") this.queue.clear();
  }

  /** All bytes have arrived; searches them for the record after an incomplete one. */
  private goOn(): void {
    while (this.standing === "reading") {
      const cut = this.searching === undefined;
      if (cut && this.queue.length === 0) return;
      if (cut) this.stop();
      const { searching } = this;
      if (!searching || !this.searched(searching, false)) {
        // An incomplete record that nothing follows is truncated.
        if (!cut && this.standing === "reading") this.standing = "damaged";
        return;
      }
      this.advance();
    }
  }

  /** Whether reading can continue; if not, bytes that need not be searched again were removed. */
  private searched(damaged: Standing, more: boolean): boolean {
    const found = this.search.next(this.queue.peek(this.queue.length), this.offset, damaged, more);
    if (found === undefined) this.standing = "damaged";
    if (typeof found === "number") this.skip(Math.min(found, this.queue.length));
    if (typeof found !== "object") return false;
    this.skip(found.at);
    this.damaged.push(damaged);
    this.open = damaged;
    this.loseUpTo(found.next ?? 0);
    this.searching = undefined;
    return true;
  }

  private loseUpTo(next: number): void {
    while (this.frames.length < next) this.frames.push(undefined);
  }

  private skip(count: number): void {
    this.queue.skip(count);
    this.offset += count;
  }

  /** Handles an incomplete or damaged record. */
  private stop(): void {
    const { begun, offset, afterSeconds } = this;
    if (!begun.length) {
      throw new StreamError(`Nothing of ${this.name} can be shown: its init record is damaged.`);
    }
    const period = begun.at(-1)!.number;
    const since = this.open?.since ?? offset;
    this.searching = { offset, expected: this.frames.length, afterSeconds, period, since };
    this.skip(1);
  }

  private add(record: StreamRecord, bytes: number): void {
    if (record.type === RecordType.init) this.addInit(record, bytes);
    else if (!this.begun.length) {
      throw new StreamError(`${this.name} begins with a record of type ${record.type}; expected an init record.`);
    } else if (record.type === RecordType.index) {
      this.standing = "complete";
    } else if (record.type === RecordType.key || record.type === RecordType.delta) {
      const last = this.begun.at(-1)!.number;
      if (record.period !== last) {
        throw new StreamError(
          `${this.name} has a packet of period ${record.period}, at byte ${record.offset}, after the init record of period ${last}.`,
        );
      }
      this.addPacket(packetOf(record.payload, record.type === RecordType.key), record.offset, bytes);
    } else if (record.type === RecordType.sound && this.header?.sound?.codec === "opus") {
      const sound = soundOf(record.payload);
      if (!this.open && sound?.index === this.frames.length - 1) {
        this.sounds.push({ ...sound, end: record.offset + bytes });
      }
    }
  }

  private addInit({ period, payload, offset }: StreamRecord, bytes: number): void {
    const { begun, header: first } = this;
    const expected = (begun.at(-1)?.number ?? period - 1) + 1;
    if (first && !this.open && (this.begins || period !== expected)) {
      throw new StreamError(
        `${this.name} has an init record of period ${period}, at byte ${offset}, where a packet${this.begins ? "" : ` or one of period ${expected}`} belongs.`,
      );
    }
    const header = unpackedHeader(payload);
    const differing = first && difference(first, header);
    if (differing) throw new StreamError(`Period ${period} of ${this.name} does not belong to it: ${differing}.`);
    if (this.begins && first) begun.pop(); // a period without a complete packet
    begun.push({ number: period, first: this.frames.length, offset, bytes, header });
    this.begins = true;
  }

  private addPacket({ payload, ...facts }: Packet, offset: number, bytes: number): void {
    const { index, isKey } = facts;
    const { open, begins } = this;
    if (open && index <= lastFrame(open, offset)) this.loseUpTo(index);
    this.checkFollows(facts);
    if (begins) this.begun.push({ ...this.begun.pop()!, first: this.begun.length ? index : 0 });
    this.open = undefined;
    this.begins = false;
    const info = { ...facts, offset, bytes };
    const shown = isKey || this.header?.codec === "raw" || (!begins && this.frames[index - 1]?.shown === true);
    this.frames.push({ info, payload, shown });
    this.whole.push(info);
    this.afterSeconds = facts.ptsSeconds;
  }

  /** Checks that a packet can come next. */
  private checkFollows({ index, isKey, ptsSeconds }: Omit<Packet, "payload">): void {
    const { name } = this;
    const expected = this.frames.length;
    if (index !== expected) throw new StreamError(`${name} has packet ${index} where packet ${expected} belongs.`);
    if ((index === 0 || (this.begins && !this.open)) && !isKey) {
      const what = expected ? `A period of ${name}` : name;
      throw new StreamError(`${what} begins with a delta packet; the first must be a key packet.`);
    }
    if (ptsSeconds <= this.afterSeconds) {
      throw new StreamError(`In ${name} packet ${index} is not presented after the one before it.`);
    }
  }
}

/**
 * A reader of a whole file, or of one that was truncated anywhere.
 *
 * @throws StreamError see {@link StreamReader.push} and {@link StreamReader.finish}
 */
export function readStream(bytes: Uint8Array, name?: string): StreamReader {
  const reader = new StreamReader(name);
  reader.push(bytes);
  reader.finish();
  return reader;
}
