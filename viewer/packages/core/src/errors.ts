// SPDX-License-Identifier: Apache-2.0

/** A stream that cannot be read: damaged, of another kind, or newer than this program. */
export class StreamError extends Error {
  override readonly name = "StreamError";
}
