// SPDX-License-Identifier: Apache-2.0

export type { Damage } from "./damage.js";
export { type Frame, type Packet, packetOf, SceneDecoder } from "./decoder.js";
export { StreamError } from "./errors.js";
export { FIELD_NAMES, type FieldName, type Fields, type Tensor } from "./fields.js";
export { type Camera, type Similarity, type StreamHeader, unpackedHeader } from "./header.js";
export { FOOTER_BYTES, type IndexEntry, indexEntries, indexOffset } from "./index.js";
export { type PacketInfo, type ReaderState, readStream, StreamReader } from "./reader.js";
export { PREFIX_BYTES, RecordType, recordIn, type StreamRecord } from "./records.js";
