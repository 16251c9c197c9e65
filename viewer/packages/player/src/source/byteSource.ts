// SPDX-License-Identifier: Apache-2.0
/** A file of bytes that can be read by ranges, independent of its location. */

/** Facts of the file at the start of a reading. */
export interface Opening {
  /** Offset of the first byte: that of the request, or 0 if the whole file comes. */
  readonly start: number;
  readonly fileBytes: number | undefined;
  /** Whether ranges can be requested. */
  readonly ranged: boolean;
}

/** Receives one reading: `begin` once, then its bytes in order. */
export interface ByteSink {
  begin(opening: Opening): void;
  take(bytes: Uint8Array): void;
}

export interface ReadOptions {
  /** Offset after the last byte; undefined: the present end of the file. */
  readonly end: number | undefined;
  /** Read the whole file from its first byte if ranges are not supported. */
  readonly wholeIfNeeded: boolean;
}

export interface ByteSource {
  /**
   * Reads bytes from `start` on; resolves when all were passed on.
   *
   * @throws SourceError with a sentence for the user; `temporary` ones may disappear without action
   */
  read(start: number, options: ReadOptions, sink: ByteSink, signal: AbortSignal): Promise<void>;
  /** Whether bytes may still be appended to the file. */
  readonly mayGrow: boolean;
}

/** Bytes that cannot be read. */
export class SourceError extends Error {
  override readonly name = "SourceError";
  constructor(
    message: string,
    readonly temporary = false,
    /** Whether another request cannot succeed. */
    readonly final = false,
  ) {
    super(message);
  }
}
