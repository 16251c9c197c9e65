// SPDX-License-Identifier: Apache-2.0
/** What the packets decoded lately took. */

import type { PacketFacts } from "../decode/messages.js";

const REMEMBERED_PACKETS = 4096;

export class PacketLog {
  private readonly facts = new Map<number, PacketFacts>();
  /** A packet took so long in the worker, on the way to the last frame. */
  decodeMilliseconds = 0;

  /** Takes what came with a frame. */
  take(packets: readonly PacketFacts[], milliseconds: number): void {
    for (const packet of packets) this.facts.set(packet.index, packet);
    while (this.facts.size > REMEMBERED_PACKETS) this.facts.delete(this.facts.keys().next().value as number);
    this.decodeMilliseconds = milliseconds / Math.max(packets.length, 1);
  }

  of(index: number): PacketFacts | undefined {
    return this.facts.get(index);
  }
}
