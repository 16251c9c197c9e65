// SPDX-License-Identifier: Apache-2.0
/** The description in the init record: JSON in one zstd frame of stated size. */

import { decompress } from "fzstd";
import { StreamError } from "./errors.js";
import { viewOf } from "./records.js";

const MAX_JSON_BYTES = 2 ** 20;
export const ZSTD_MAGIC = 0xfd2fb528;

/**
 * The value in the frame; its stated size is checked before decompression.
 *
 * @throws StreamError it is not a zstd frame, states no size or too large a one, or contains no JSON
 */
export function unpackedJson(frame: Uint8Array): unknown {
  const size = contentSize(frame);
  if (size === undefined || size > MAX_JSON_BYTES) {
    throw new StreamError(
      `The init record's description states ${size ?? "no"} bytes unpacked; expected at most ${MAX_JSON_BYTES}.`,
    );
  }
  try {
    // With a given buffer the decoder allocates neither the window nor the size that the frame states.
    const bytes = decompress(frame, new Uint8Array(size));
    return JSON.parse(new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(bytes));
  } catch (error) {
    const reason = error instanceof Error ? error.message : String(error);
    throw new StreamError(`The init record's description cannot be read (${reason}).`, { cause: error });
  }
}

/** The content size that a zstd frame states (RFC 8878, section 3.1.1.1); undefined if it states none. */
function contentSize(frame: Uint8Array): number | undefined {
  if (frame.length < 5) return undefined;
  const view = viewOf(frame);
  if (view.getUint32(0, true) !== ZSTD_MAGIC) return undefined;
  const descriptor = frame[4]!;
  const singleSegment = (descriptor >> 5) & 1;
  const code = descriptor >> 6;
  const width = code === 0 ? singleSegment : 1 << code;
  const at = 5 + (1 - singleSegment) + [0, 1, 2, 4][descriptor & 3]!;
  if (width === 0 || at + width > frame.length) return undefined;
  if (width === 1) return frame[at]!;
  if (width === 2) return view.getUint16(at, true) + 256;
  if (width === 4) return view.getUint32(at, true);
  return view.getUint32(at, true) + view.getUint32(at + 4, true) * 2 ** 32;
}
