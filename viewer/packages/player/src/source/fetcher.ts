// SPDX-License-Identifier: Apache-2.0
/** The fetch worker: readings of one source, with retries. */

import { BlobSource, blobOfBase64 } from "./blobSource.js";
import { type ByteSource, SourceError } from "./byteSource.js";
import type { ReadReply, ReadRequest, SourceDescription, StoredPlace } from "./description.js";
import { HttpSource } from "./httpSource.js";
import { joined } from "./joined.js";
import { MAX_MANIFEST_BYTES, type Manifest, pageIn, type Quality } from "./manifest.js";
import { ManifestFeed } from "./manifestFeed.js";
import { pause } from "./pause.js";
import type { Port } from "./port.js";
import { RETRY_POLICY, type RetryPolicy } from "./retryPolicy.js";
import { siblingUrl, verify } from "./storedFile.js";

/** Largest accepted size of an init record or a packet. */
const MAX_HELD_BYTES = 2 ** 28;

export class Fetcher {
  private description: SourceDescription | undefined;
  private source: ByteSource | undefined;
  private answered = false;
  private readonly readings = new Map<number, AbortController>();

  constructor(
    private readonly port: Port<ReadReply, ReadRequest>,
    private readonly request: typeof fetch,
    private readonly retryPolicy: RetryPolicy = RETRY_POLICY,
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

  private async perform(message: Exclude<ReadRequest, { type: "open" | "cancel" }>): Promise<void> {
    const { id } = message;
    const abort = new AbortController();
    this.readings.set(id, abort);
    try {
      await this.answer(message, abort.signal);
      if (!abort.signal.aborted) this.port.postMessage({ type: "end", id }, []);
    } catch (error) {
      if (abort.signal.aborted) return;
      const text = error instanceof Error ? error.message : String(error);
      const temporary = error instanceof SourceError && error.temporary;
      this.port.postMessage({ type: "failed", id, message: text, temporary }, []);
    } finally {
      this.readings.delete(id);
    }
  }

  private async answer(message: Exclude<ReadRequest, { type: "open" | "cancel" }>, signal: AbortSignal): Promise<void> {
    const { id } = message;
    if (message.type === "manifests") await this.feed(message, signal);
    else if (message.type === "page") {
      const { url, entry } = message;
      const bytes = await this.wholeOf(id, { url, entry, small: true }, MAX_MANIFEST_BYTES, signal);
      if (!signal.aborted) this.port.postMessage({ type: "page", id, content: pageIn(bytes, entry) }, []);
    } else if (message.type === "follow") await this.follow(id, message.start, signal);
    else if (message.of) await this.readStored(id, message.of, message.start, message.end, signal);
    else {
      const give = (bytes: Uint8Array) => this.give(id, bytes, signal);
      await this.read(this.opened(), id, message.start, signal, give, message.end, message.wholeIfNeeded);
    }
  }

  private give(id: number, bytes: Uint8Array, signal: AbortSignal): void {
    if (!signal.aborted) this.port.postMessage({ type: "bytes", id, bytes }, [bytes.buffer as ArrayBuffer]);
  }

  private async feed({ id, url, name }: ReadRequest & { type: "manifests" }, signal: AbortSignal): Promise<void> {
    const { sameOrigin, own } = this.description as SourceDescription & { kind: "segments" };
    const feed = new ManifestFeed(url, name, this.request, sameOrigin === true, own, this.retryPolicy);
    const events = {
      manifest: (manifest: Manifest) => {
        this.answered = true;
        this.port.postMessage({ type: "manifest", id, manifest }, []);
      },
      qualities: (qualities: readonly Quality[]) => this.port.postMessage({ type: "qualities", id, qualities }, []),
      waiting: (seconds: number, problem: string) =>
        this.port.postMessage({ type: "waiting", id, seconds, problem }, []),
      recovered: () => this.port.postMessage({ type: "recovered", id }, []),
    };
    await feed.follow(events, signal);
  }

  /** Bytes of an immutable file, which is compared with its stated size and hash. */
  private async readStored(
    id: number,
    of: StoredPlace,
    start: number,
    end: number,
    signal: AbortSignal,
  ): Promise<void> {
    if (of.small) return this.give(id, await this.wholeOf(id, of, MAX_HELD_BYTES, signal), signal);
    const parts: Uint8Array[] = [];
    const whole = start === 0 && end === of.entry.bytes;
    const give = (bytes: Uint8Array) => {
      if (whole) parts.push(bytes.slice());
      this.give(id, bytes, signal);
    };
    await this.read(this.stored(of), id, start, signal, give, end);
    if (whole && !signal.aborted) await verify(joined(parts), of.entry);
  }

  private async wholeOf(id: number, of: StoredPlace, most: number, signal: AbortSignal): Promise<Uint8Array> {
    const parts: Uint8Array[] = [];
    const { bytes: end, file } = of.entry;
    if (end > most) throw new SourceError(`${file} has ${end} bytes, more than this player takes at once (${most}).`);
    await this.read(this.stored(of), id, 0, signal, (bytes) => parts.push(bytes), end);
    const bytes = joined(parts);
    if (!signal.aborted) await verify(bytes, of.entry);
    return bytes;
  }

  private stored({ url, entry }: StoredPlace): ByteSource {
    const { sameOrigin } = this.description as SourceDescription & { kind: "segments" };
    return new HttpSource(siblingUrl(url, entry.file), entry.file, this.request, sameOrigin, true);
  }

  private opened(): ByteSource {
    this.source ??= this.newSource();
    return this.source;
  }

  private newSource(): ByteSource {
    const source = this.description!;
    if (source.kind === "url" || source.kind === "segments") {
      return new HttpSource(source.url, source.name, this.request, source.sameOrigin);
    }
    const blob = source.kind === "blob" ? source.blob : blobOfBase64(source.text, source.name);
    return new BlobSource(blob, source.name);
  }

  /**
   * Reads a range, with retries from where it broke off; returns the offset of the end. A server may answer with less than
   * was asked for, and a connection may end early without an error, so the rest is asked for until it has come.
   */
  private async read(
    source: ByteSource,
    id: number,
    start: number,
    signal: AbortSignal,
    give: (bytes: Uint8Array) => void,
    end?: number,
    wholeIfNeeded?: boolean,
  ): Promise<number> {
    let at = start;
    let begun = false;
    for (let attempt = 0; ; ) {
      try {
        const options = { end, wholeIfNeeded: wholeIfNeeded === true && !begun };
        let known = 0;
        let came = false;
        await source.read(
          at,
          options,
          {
            begin: ({ start: from, fileBytes, ranged }) => {
              at = from;
              known = fileBytes ?? 0;
              if (!begun && !signal.aborted) this.port.postMessage({ type: "begin", id, fileBytes, ranged }, []);
              begun = true;
              this.answered = true;
            },
            take: (bytes) => {
              at += bytes.length;
              attempt = 0;
              came = true;
              give(bytes);
            },
          },
          signal,
        );
        if (signal.aborted || at >= Math.min(end ?? known, known)) return at;
        if (!came) throw new SourceError("The server sends less than it announces.", true);
      } catch (error) {
        const wait = this.retryPolicy.retries[attempt++];
        const hopeless = !(error instanceof SourceError && error.temporary) || wait === undefined;
        // A source that never answered fails immediately, so that a wrong address is reported without delay.
        if (signal.aborted || hopeless || !this.answered) throw error;
        this.port.postMessage({ type: "waiting", id, seconds: wait, problem: error.message }, []);
        await pause(wait, signal);
      }
    }
  }

  private async follow(id: number, start: number, signal: AbortSignal): Promise<void> {
    const { firstPoll, longestPoll, backOff, stillAfter } = this.retryPolicy;
    const source = this.opened();
    let at = start;
    let wait = firstPoll;
    for (let still = 0; !signal.aborted && still < stillAfter; ) {
      const before = at;
      at = await this.read(source, id, at, signal, (bytes) => this.give(id, bytes, signal));
      if (!source.mayGrow || signal.aborted) return;
      wait = at > before ? firstPoll : Math.min(wait * backOff, longestPoll);
      still = at > before ? 0 : still + wait;
      this.port.postMessage({ type: "waiting", id, seconds: wait, problem: undefined }, []);
      await pause(wait, signal);
    }
  }
}
