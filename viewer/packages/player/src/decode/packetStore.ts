// SPDX-License-Identifier: Apache-2.0
/** A store of fetched packets with a limited number of bytes. */

import type { FrameSound, Packet } from "@structgstream/core";
import type { FrameRange } from "./messages.js";

/** Share of the store that is freed at once, so that not every packet starts a search. */
const LEFT = 0.9;

export class PacketStore {
  private readonly packets = new Map<number, Packet>();
  private readonly sounds = new Map<number, FrameSound>();
  private bytes = 0;

  /** @param budgetBytes limit of the payloads' size, except for the one packet that is needed at present */
  constructor(readonly budgetBytes: number) {}

  has(index: number): boolean {
    return this.packets.has(index);
  }

  get(index: number): Packet | undefined {
    return this.packets.get(index);
  }

  /**
   * Stores a packet. If there is no room, packets are removed, perhaps this one: first those before frame `first`, then the
   * farthest after it.
   */
  put(packet: Packet, first: number): void {
    if (this.packets.has(packet.index)) return;
    this.packets.set(packet.index, packet);
    this.bytes += packet.payload.length;
    if (this.bytes > this.budgetBytes) this.makeRoom(first);
  }

  /** Stores the sound of a frame whose packet is there; it is removed with that. */
  putSound(sound: FrameSound): void {
    if (!this.packets.has(sound.index) || this.sounds.has(sound.index)) return;
    this.sounds.set(sound.index, sound);
    this.bytes += soundBytes(sound);
  }

  sound(index: number): FrameSound | undefined {
    return this.sounds.get(index);
  }

  /** Frames whose packets are available. */
  ranges(): FrameRange[] {
    const ranges: FrameRange[] = [];
    for (const index of [...this.packets.keys()].sort((a, b) => a - b)) {
      const last = ranges.at(-1);
      if (last?.[1] === index) ranges[ranges.length - 1] = [last[0], index + 1];
      else ranges.push([index, index + 1]);
    }
    return ranges;
  }

  private makeRoom(first: number): void {
    const distance = (index: number) => (index < first ? Number.MAX_SAFE_INTEGER - index : index - first);
    const farthest = [...this.packets.keys()].sort((a, b) => distance(b) - distance(a));
    for (const index of farthest) {
      if (this.bytes <= LEFT * this.budgetBytes || index === first) return;
      this.bytes -= this.packets.get(index)!.payload.length;
      this.packets.delete(index);
      const sound = this.sounds.get(index);
      if (sound) this.bytes -= soundBytes(sound);
      this.sounds.delete(index);
    }
  }
}

function soundBytes({ packets }: FrameSound): number {
  return packets.reduce((sum, { length }) => sum + length, 0);
}
