// SPDX-License-Identifier: Apache-2.0
/** Statistics of the last decoded packets. */

import type { PacketFacts } from "../decode/messages.js";

const REMEMBERED_PACKETS = 4096;

export class PacketLog {
  private readonly facts = new Map<number, PacketFacts>();
  /** Decoding time per packet in the worker, for the packets of the last frame. */
  decodeMilliseconds = 0;

  /** Adds the packets of a frame. */
  take(packets: readonly PacketFacts[], milliseconds: number): void {
    for (const packet of packets) this.facts.set(packet.index, packet);
    while (this.facts.size > REMEMBERED_PACKETS) this.facts.delete(this.facts.keys().next().value as number);
    this.decodeMilliseconds = milliseconds / Math.max(packets.length, 1);
  }

  of(index: number): PacketFacts | undefined {
    return this.facts.get(index);
  }
}
