// SPDX-License-Identifier: Apache-2.0
/**
 * Reading a stream as it arrives, or a whole file at once.
 *
 * A reader keeps the payloads of packets, so that any frame can be asked for; `forget` lets go of old ones. Memory never
 * grows by what a record states, only by what has arrived.
 */

import { ByteQueue } from "./byteQueue.js";
import { checkFollows, type Frame, type Packet, packetOf, SceneDecoder } from "./decoder.js";
import { StreamError } from "./errors.js";
import { type StreamHeader, unpackedHeader } from "./header.js";
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

/** One packet's place in the stream: `bytes` counts the whole record from byte `offset` on. */
export interface PacketInfo {
  readonly isKey: boolean;
  readonly index: number;
  readonly ptsSeconds: number;
  readonly offset: number;
  readonly bytes: number;
}

/**
 * Where reading stands: more bytes may come; the index has come, so that the run that made the stream had come to its
 * end; or a record was damaged, and what follows it is not used.
 */
export type ReaderState = "reading" | "complete" | "damaged";

export class StreamReader {
  private readonly queue = new ByteQueue();
  private readonly payloads: (Uint8Array | undefined)[] = [];
  private readonly infos: PacketInfo[] = [];
  private offset = 0;
  private found: StreamHeader | undefined;
  private decoder: SceneDecoder | undefined;
  private failure: StreamError | undefined;
  private standing: ReaderState = "reading";
  private decoded: number | undefined;

  /** @param name what messages call the stream */
  constructor(readonly name = "The stream") {}

  /** What the init record says, as soon as it is there. */
  get header(): StreamHeader | undefined {
    return this.found;
  }

  /** Every whole packet so far, in order. */
  get packets(): readonly PacketInfo[] {
    return this.infos;
  }

  get state(): ReaderState {
    return this.standing;
  }

  /**
   * Takes the next bytes of the stream, however many.
   *
   * @throws StreamError not a stream, another major version, a damaged init record, or records that contradict each
   *   other; so does every later call
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
   * Says that no more bytes will come.
   *
   * @throws StreamError nothing of the stream can be shown
   */
  finish(): void {
    if (this.failure) throw this.failure;
    if (this.found) return;
    if (this.offset === 0) checkPrefix(this.queue.peek(PREFIX_BYTES), this.name);
    const end = this.offset + this.queue.length;
    throw new StreamError(`Nothing of ${this.name} can be shown: it is cut at byte ${end}, within the init record.`);
  }

  /**
   * The scene of one frame. The next frame after the last is decoded from it; any other from its key packet on.
   *
   * @throws StreamError there is no such frame, it was forgotten, or it is damaged
   */
  frame(index: number): Frame {
    if (!this.decoder || !this.infos[index]) {
      const have = this.infos.length ? `frames 0 to ${this.infos.length - 1}` : "no whole frame";
      throw new StreamError(`${this.name} has ${have}; there is no frame ${index}.`);
    }
    const first = this.decoded === index - 1 ? index : this.groupStart(index);
    this.decoded = undefined; // until a packet has been decoded
    for (let i = first; i < index; i++) this.decoder.decode(this.packet(i));
    const frame = this.decoder.decode(this.packet(index));
    this.decoded = index;
    return frame;
  }

  /** The first packet that frame `index` needs: a key packet; with codec `raw` its own. */
  groupStart(index: number): number {
    let first = index;
    while (this.found?.codec !== "raw" && first > 0 && !this.infos[first]?.isKey) first--;
    return first;
  }

  /** Lets go of the packets that no frame from `index` on needs. */
  forget(index: number): void {
    const end = this.groupStart(Math.min(index, this.infos.length - 1));
    for (let i = end - 1; i >= 0 && this.payloads[i]; i--) this.payloads[i] = undefined;
  }

  private packet(index: number): Packet {
    const payload = this.payloads[index];
    if (!payload) throw new StreamError(`Frame ${index} of ${this.name} has been let go of.`);
    return { ...this.infos[index]!, payload };
  }

  private advance(): void {
    if (this.offset === 0) {
      const prefix = this.queue.peek(PREFIX_BYTES);
      if (prefix.length === PREFIX_BYTES || !isSignature(prefix)) checkPrefix(prefix, this.name);
      if (prefix.length < PREFIX_BYTES) return;
      this.queue.take(PREFIX_BYTES);
      this.offset = PREFIX_BYTES;
    }
    while (this.standing === "reading" && this.queue.length >= HEAD_BYTES + CHECKSUM_BYTES) {
      const size = recordBytes(this.queue.peek(HEAD_BYTES));
      if (size > this.queue.length) return;
      const record = recordIn(this.queue.take(size), this.offset);
      if (record) this.add(record, size);
      else this.stop();
      this.offset += size;
    }
    if (this.standing !== "reading") this.queue.clear();
  }

  private stop(): void {
    if (!this.found) {
      throw new StreamError(`Nothing of ${this.name} can be shown: its init record is damaged.`);
    }
    this.standing = "damaged";
  }

  private add(record: StreamRecord, bytes: number): void {
    if (!this.found) {
      if (record.type !== RecordType.init) {
        throw new StreamError(`${this.name} begins with a record of type ${record.type}; expected an init record.`);
      }
      const header = unpackedHeader(record.payload);
      this.decoder = new SceneDecoder(header);
      this.found = header;
    } else if (record.type === RecordType.init) {
      throw new StreamError(`${this.name} has a second init record, at byte ${record.offset}.`);
    } else if (record.type === RecordType.index) {
      this.standing = "complete";
    } else if (record.type === RecordType.key || record.type === RecordType.delta) {
      this.addPacket(packetOf(record.payload, record.type === RecordType.key), record.offset, bytes);
    }
  }

  private addPacket({ payload, ...facts }: Packet, offset: number, bytes: number): void {
    checkFollows(facts, this.infos.at(-1), this.name);
    this.infos.push({ ...facts, offset, bytes });
    this.payloads.push(payload);
  }
}

/**
 * A reader of a whole file, or of one that was cut anywhere.
 *
 * @throws StreamError as {@link StreamReader.push} and {@link StreamReader.finish}
 */
export function readStream(bytes: Uint8Array, name?: string): StreamReader {
  const reader = new StreamReader(name);
  reader.push(bytes);
  reader.finish();
  return reader;
}
