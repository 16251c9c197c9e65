// SPDX-License-Identifier: Apache-2.0
/** What runs in the fetch worker: readings of one source, with patience. */

import { BlobSource, blobOfBase64 } from "./blobSource.js";
import { type ByteSource, SourceError } from "./byteSource.js";
import type { ReadReply, ReadRequest, SourceDescription } from "./description.js";
import { HttpSource } from "./httpSource.js";
import type { Port } from "./port.js";

/** How long is waited before looking again, in seconds. */
export interface Patience {
  /** After a connection broke; when all are used up, it failed. */
  readonly retries: readonly number[];
  /** For new bytes of a growing file: the first wait, the longest, and by how much each is longer than the last. */
  readonly firstPoll: number;
  readonly longestPoll: number;
  readonly backOff: number;
  /** A file that has not grown for so long is given up. */
  readonly stillAfter: number;
}

export const PATIENCE: Patience = {
  retries: [0.5, 1, 2, 4, 8],
  firstPoll: 0.5,
  longestPoll: 10,
  backOff: 1.4,
  stillAfter: 1800,
};

export class Fetcher {
  private description: SourceDescription | undefined;
  private source: ByteSource | undefined;
  private answered = false;
  private readonly readings = new Map<number, AbortController>();

  constructor(
    private readonly port: Port<ReadReply, ReadRequest>,
    private readonly request: typeof fetch,
    private readonly patience: Patience = PATIENCE,
  ) {
    port.onmessage = ({ data }) => this.obey(data);
  }

  private obey(message: ReadRequest): void {
    if (message.type === "cancel") this.readings.get(message.id)?.abort();
    else if (message.type === "open") {
      for (const reading of this.readings.values()) reading.abort();
      this.source = undefined;
      this.description = message.source;
      this.answered = false;
    } else void this.perform(message);
  }

  private async perform(message: ReadRequest & { type: "read" | "follow" }): Promise<void> {
    const { id } = message;
    const abort = new AbortController();
    this.readings.set(id, abort);
    try {
      this.source ??= this.opened();
      if (message.type === "read") {
        await this.read(id, message.start, abort.signal, message.end, message.wholeIfNeeded);
      } else await this.follow(id, message.start, abort.signal);
      if (!abort.signal.aborted) this.port.postMessage({ type: "end", id }, []);
    } catch (error) {
      if (abort.signal.aborted) return;
      const text = error instanceof Error ? error.message : String(error);
      this.port.postMessage({ type: "failed", id, message: text }, []);
    } finally {
      this.readings.delete(id);
    }
  }

  private opened(): ByteSource {
    const source = this.description!;
    if (source.kind === "url") return new HttpSource(source.url, source.name, this.request, source.sameOrigin);
    const blob = source.kind === "blob" ? source.blob : blobOfBase64(source.text, source.name);
    return new BlobSource(blob, source.name);
  }

  /** Reads a range, again from where it broke off while there is hope; gives back where the bytes ended. */
  private async read(
    id: number,
    start: number,
    signal: AbortSignal,
    end?: number,
    wholeIfNeeded?: boolean,
  ): Promise<number> {
    let at = start;
    let begun = false;
    for (let attempt = 0; ; ) {
      try {
        const options = { ...(end === undefined ? {} : { end }), wholeIfNeeded: wholeIfNeeded === true && !begun };
        await this.source!.read(
          at,
          options,
          {
            begin: (opening) => {
              at = opening.start;
              if (!begun && !signal.aborted) this.port.postMessage({ type: "begin", id, ...opening }, []);
              begun = true;
              this.answered = true;
            },
            take: (bytes) => {
              at += bytes.length;
              attempt = 0;
              if (!signal.aborted) this.port.postMessage({ type: "bytes", id, bytes }, [bytes.buffer as ArrayBuffer]);
            },
          },
          signal,
        );
        return at;
      } catch (error) {
        const wait = this.patience.retries[attempt++];
        const hopeless = !(error instanceof SourceError && error.temporary) || wait === undefined;
        // What never answered is told at once: a wrong address should not take half a minute to say so.
        if (signal.aborted || hopeless || !this.answered) throw error;
        this.port.postMessage({ type: "waiting", id, seconds: wait, problem: error.message }, []);
        await pause(wait, signal);
      }
    }
  }

  private async follow(id: number, start: number, signal: AbortSignal): Promise<void> {
    const { firstPoll, longestPoll, backOff, stillAfter } = this.patience;
    let at = start;
    let wait = firstPoll;
    for (let still = 0; !signal.aborted && still < stillAfter; ) {
      const before = at;
      at = await this.read(id, at, signal);
      if (!this.source!.mayGrow || signal.aborted) return;
      wait = at > before ? firstPoll : Math.min(wait * backOff, longestPoll);
      still = at > before ? 0 : still + wait;
      this.port.postMessage({ type: "waiting", id, seconds: wait, problem: undefined }, []);
      await pause(wait, signal);
    }
  }
}

function pause(seconds: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    const timer = setTimeout(done, seconds * 1000);
    function done(): void {
      clearTimeout(timer);
      signal.removeEventListener("abort", done);
      resolve();
    }
    signal.addEventListener("abort", done);
  });
}
