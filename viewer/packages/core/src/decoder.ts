// SPDX-License-Identifier: Apache-2.0
/** From packets to scenes: everything that a receiver needs except a renderer. */

import { blocksIn, fieldsIn } from "./blocks.js";
import { CompactDecoder } from "./compact.js";
import { StreamError } from "./errors.js";
import { checkShapes, type FieldName, type Fields, mergedFields } from "./fields.js";
import type { StreamHeader } from "./header.js";
import { FRAME_BYTES, viewOf } from "./records.js";

/** One packet: a key packet needs only the header, a delta packet also the packet before it. */
export interface Packet {
  readonly isKey: boolean;
  readonly index: number;
  readonly ptsSeconds: number;
  readonly payload: Uint8Array;
}

/** One frame: every field of the scene, in scene units. Static fields are those of the header. */
export interface Frame {
  readonly index: number;
  readonly ptsSeconds: number;
  readonly fields: Fields;
}

/**
 * The packet in a key or delta record.
 *
 * @throws StreamError the payload contradicts the format
 */
export function packetOf(payload: Uint8Array, isKey: boolean): Packet {
  if (payload.length < FRAME_BYTES) throw new StreamError("A packet is too short to hold its index and time.");
  const view = viewOf(payload);
  const index = view.getUint32(0, true);
  const ptsSeconds = view.getFloat64(4, true);
  if (!Number.isFinite(ptsSeconds)) {
    throw new StreamError(`Packet ${index} has the presentation time ${ptsSeconds}, which is no time.`);
  }
  blocksIn(payload, FRAME_BYTES, `Packet ${index}`);
  return { isKey, index, ptsSeconds, payload };
}

/** Decodes the packets of one stream in order from any key packet; with codec `raw` in any order. */
export class SceneDecoder {
  private readonly compact: CompactDecoder | undefined;

  /** @throws StreamError the header does not fit its codec */
  constructor(private readonly header: StreamHeader) {
    this.compact = header.codec === "raw" ? undefined : new CompactDecoder(header);
  }

  /**
   * The scene of one frame.
   *
   * @throws StreamError the packet is damaged, contradicts the header, or needs one that has not been decoded
   */
  decode(packet: Packet): Frame {
    const { header } = this;
    const { index, ptsSeconds } = packet;
    const values = this.taken(packet);
    const fields = mergedFields(header.static, this.compact?.values() ?? values);
    checkShapes(fields, header, `Packet ${index}`);
    return { index, ptsSeconds, fields };
  }

  /**
   * Decodes a packet on the way to a later frame, without dequantizing it.
   *
   * @throws StreamError see {@link decode}
   */
  advance(packet: Packet): void {
    this.taken(packet);
  }

  /** The fields that a packet has as they are: all of them with codec `raw`, otherwise none. */
  private taken({ payload, isKey, index }: Packet): Fields {
    const where = `Packet ${index}`;
    const { values, coded } = fieldsIn(payload, FRAME_BYTES, where, () => this.compact !== undefined);
    checkNames([...values.keys(), ...coded.keys()], this.header, where);
    this.compact?.advance(coded, isKey, index);
    return values;
  }
}

function checkNames(names: FieldName[], header: StreamHeader, where: string): void {
  if (names.length !== header.dynamic.size || !names.every((name) => header.dynamic.has(name))) {
    throw new StreamError(
      `${where} holds ${names.sort().join(", ") || "no field"}; ` +
        `the header announces ${[...header.dynamic].sort().join(", ") || "none"}.`,
    );
  }
}

/**
 * Bytes of each field of a packet, heads of blocks included.
 *
 * @throws StreamError the payload contradicts the format
 */
export function fieldBytes({ payload, index }: Packet): Map<FieldName, number> {
  const blocks = blocksIn(payload, FRAME_BYTES, `Packet ${index}`);
  return new Map(blocks.map(({ name, start, end }) => [name, end - start]));
}
