// SPDX-License-Identifier: Apache-2.0
/** The golden stream with sound, of a second with a clap and a white picture in its middle, as often as a test wants. */

import { HEAD_BYTES, RecordType, viewOf } from "../../core/src/records.ts";
import { bytesOf, type IndexRow, indexOf, joined, piecesOf, record, VECTORS } from "../../core/test/streams.ts";

export const FPS = 12;

/** A file of so many seconds, each frame with its sound record, and with its index. */
export function clappingFile(seconds: number): Uint8Array {
  const [prefix, init, ...pieces] = piecesOf(bytesOf(VECTORS, "version-2-sound.sgs"));
  const frames: (readonly [Uint8Array, Uint8Array])[] = [];
  for (let second = 0; second < seconds; second++) {
    for (let frame = 0; frame < FPS; frame++) {
      const index = second * FPS + frame;
      const packet = payload(pieces[2 * frame]!);
      viewOf(packet).setUint32(0, index, true);
      viewOf(packet).setFloat64(4, index / FPS, true);
      // A second has 50 packets; the one before its first is that of the last second.
      const sound = second && !frame ? withoutFirst(payload(pieces[1]!)) : payload(pieces[2 * frame + 1]!);
      viewOf(sound).setUint32(0, index, true);
      viewOf(sound).setFloat64(4, viewOf(sound).getFloat64(4, true) + second, true);
      frames.push([record(pieces[2 * frame]![0]!, packet), record(RecordType.sound, sound)]);
    }
  }
  const head = joined(prefix!, init!);
  let at = head.length;
  const entries = frames.map(([packet, sound], index): IndexRow => {
    const offset = at;
    at += packet.length + sound.length;
    return [index, packet[0]!, offset];
  });
  return joined(head, ...frames.flat(), indexOf(entries, at));
}

function payload(piece: Uint8Array): Uint8Array {
  return piece.slice(HEAD_BYTES, -4);
}

/** A sound record's payload without its first packet. */
function withoutFirst(given: Uint8Array): Uint8Array {
  const view = viewOf(given);
  const [count, first] = [view.getUint16(12, true), view.getUint16(14, true)];
  const packets = given.subarray(14 + 2 * count + first);
  const made = joined(given.subarray(0, 14), given.subarray(16, 14 + 2 * count), packets);
  viewOf(made).setUint16(12, count - 1, true);
  viewOf(made).setFloat64(4, view.getFloat64(4, true) + 0.02, true);
  return made;
}
