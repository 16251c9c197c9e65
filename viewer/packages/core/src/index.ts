// SPDX-License-Identifier: Apache-2.0

export { ByteQueue } from "./byteQueue.js";
export type { Damage } from "./damage.js";
export { type Frame, fieldBytes, type Packet, packetOf, SceneDecoder } from "./decoder.js";
export { StreamError } from "./errors.js";
export { FIELD_NAMES, type FieldName, type Fields, OPTIONAL_FIELDS, type Tensor } from "./fields.js";
export { FOOTER_BYTES, type IndexEntry, indexEntries, indexOffset, packetSeconds, TIMED_BYTES } from "./fileIndex.js";
export { GaussianEvaluator, type GaussianOptions, type Gaussians, type Point } from "./gaussians.js";
export { type Camera, difference, type Period, type Similarity, type StreamHeader } from "./header.js";
export { unpackedHeader } from "./initRecord.js";
export { Playback, type PlaybackOptions } from "./playback.js";
export { type PacketInfo, type ReaderState, readStream, type StoredSound, StreamReader } from "./reader.js";
export { HEAD_BYTES, RecordType, recordBytes, recordIn } from "./records.js";
export { type FrameSound, PACKET_SAMPLES, SOUND_RATE, type SoundFormat, soundOf } from "./sound.js";
