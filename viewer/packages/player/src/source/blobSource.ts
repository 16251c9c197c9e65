// SPDX-License-Identifier: Apache-2.0
/** A file of the user, or bytes that a page contains. */

import { type ByteSink, type ByteSource, type ReadOptions, SourceError } from "./byteSource.js";

export class BlobSource implements ByteSource {
  /** A browser provides a chosen file only with its content at that time. */
  readonly mayGrow = false;

  constructor(
    private readonly blob: Blob,
    private readonly name: string,
  ) {}

  async read(start: number, options: ReadOptions, sink: ByteSink, signal: AbortSignal): Promise<void> {
    const end = Math.min(options.end ?? this.blob.size, this.blob.size);
    let bytes: Uint8Array;
    try {
      bytes = new Uint8Array(await this.blob.slice(start, end).arrayBuffer());
    } catch {
      throw new SourceError(`${this.name} can no longer be read: it was moved or changed. Choose the file again.`);
    }
    if (signal.aborted) return;
    sink.begin({ start, fileBytes: this.blob.size, ranged: true });
    if (bytes.length) sink.take(bytes);
  }
}

/**
 * The bytes of a base64 text; white space is ignored.
 *
 * @throws SourceError it is not base64
 */
export function blobOfBase64(text: string, name: string): Blob {
  let binary: string;
  try {
    binary = atob(text);
  } catch {
    throw new SourceError(`${name} is no base64 text: the page was cut or changed. Export it again.`);
  }
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return new Blob([bytes]);
}
