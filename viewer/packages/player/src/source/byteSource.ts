// SPDX-License-Identifier: Apache-2.0
/** A file of bytes that can be read by ranges, wherever it is. */

/** What is known of the file when a reading begins. */
export interface Opening {
  /** Where the first byte given is in the file: 0 instead of what was asked for when the whole file comes. */
  readonly start: number;
  readonly fileBytes: number | undefined;
  /** Whether other ranges can be asked for. */
  readonly ranged: boolean;
}

/** Takes one reading: `begin` once, then its bytes in order. */
export interface ByteSink {
  begin(opening: Opening): void;
  take(bytes: Uint8Array): void;
}

export interface ReadOptions {
  /** Byte after the last one; without it up to the end of the file as it is now. */
  readonly end?: number;
  /** Give the whole file, from its first byte on, where only that can be had. */
  readonly wholeIfNeeded?: boolean;
}

export interface ByteSource {
  /**
   * Reads bytes from `start` on; resolves when they all were given.
   *
   * @throws SourceError with a sentence for the user; `temporary` ones may go away by themselves
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
    /** Whether asking again cannot help, whatever was there before. */
    readonly final = false,
  ) {
    super(message);
  }
}
