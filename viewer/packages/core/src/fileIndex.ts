// SPDX-License-Identifier: Apache-2.0
/** Index and footer: positions of the packets in a stored file, without reading them (docs/bitstream.md). */

import { FRAME_BYTES, HEAD_BYTES, INDEX_ENTRY_BYTES, RecordType, recordIn, viewOf } from "./records.js";

export const FOOTER_BYTES = 16;
const FOOTER_MAGIC = "SGSINDEX";

/** Bytes at the start of a packet's record that {@link packetSeconds} reads. */
export const TIMED_BYTES = HEAD_BYTES + FRAME_BYTES;

/** The presentation time in the first bytes of a packet's record, unverified. */
export function packetSeconds(bytes: Uint8Array): number {
  return viewOf(bytes).getFloat64(HEAD_BYTES + 4, true);
}

/** Position of one packet, or of the init record before packet `index`. */
export interface IndexEntry {
  readonly index: number;
  readonly isKey: boolean;
  readonly isInit: boolean;
  readonly offset: number;
}

/** Offset of the index record from the last 16 bytes of a file of `fileBytes`; undefined if it must be scanned. */
export function indexOffset(footer: Uint8Array, fileBytes: number): number | undefined {
  if (footer.length !== FOOTER_BYTES || String.fromCharCode(...footer.subarray(8)) !== FOOTER_MAGIC) return undefined;
  const offset = Number(viewOf(footer).getBigUint64(0, true));
  return offset + FOOTER_BYTES < fileBytes ? offset : undefined;
}

/**
 * The packets of a file, and the init records after the first, from its index; undefined if the file must be scanned. The
 * records must be verified when they are read.
 *
 * @param bytes the index record: from its offset to the footer
 */
export function indexEntries(bytes: Uint8Array, offset: number): IndexEntry[] | undefined {
  const record = recordIn(bytes, offset);
  if (record?.type !== RecordType.index || record.payload.length % INDEX_ENTRY_BYTES) return undefined;
  const view = viewOf(record.payload);
  const entries: IndexEntry[] = [];
  let begins = true;
  for (let at = 0, before = 0, packets = 0; at < record.payload.length; at += INDEX_ENTRY_BYTES) {
    const type = view.getUint8(at + 4);
    const entry = {
      index: view.getUint32(at, true),
      isKey: type === RecordType.key,
      isInit: type === RecordType.init,
      offset: Number(view.getBigUint64(at + 5, true)),
    };
    const canBe = entry.isKey || (!begins && (entry.isInit || type === RecordType.delta));
    if (!canBe || entry.index !== packets || entry.offset <= before || entry.offset >= offset) return undefined;
    begins = entry.isInit;
    if (!begins) packets++;
    before = entry.offset;
    entries.push(entry);
  }
  return begins && entries.length ? undefined : entries;
}
