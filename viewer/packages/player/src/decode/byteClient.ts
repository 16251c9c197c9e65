// SPDX-License-Identifier: Apache-2.0
/** The decode worker's interface to the fetch worker. */

import type { ReadReply, ReadRequest, SourceDescription, StoredPlace } from "../source/description.js";
import type { Manifest, PageContent, PageEntry, Quality } from "../source/manifest.js";
import type { Port } from "../source/port.js";

/** Events of one reading; none follows `end` or `failed`. */
export interface ReadingEvents {
  begin?(reply: ReadReply & { type: "begin" }): void;
  bytes?(bytes: Uint8Array): void;
  manifest?(manifest: Manifest): void;
  qualities?(qualities: readonly Quality[]): void;
  page?(content: PageContent): void;
  end(): void;
  /** A `temporary` failure may disappear without action. */
  failed(message: string, temporary: boolean): void;
  waiting?(seconds: number, problem: string | undefined): void;
  recovered?(): void;
}

export class ByteClient {
  private readonly readings = new Map<number, ReadingEvents>();
  private made = 0;
  /** Number of bytes received so far. */
  fetchedBytes = 0;

  constructor(private readonly port: Port<ReadRequest, ReadReply>) {
    port.onmessage = ({ data }) => this.hear(data);
  }

  open(source: SourceDescription): void {
    this.readings.clear();
    this.port.postMessage({ type: "open", source }, []);
  }

  /** Starts reading; returns the number for {@link cancel}. `of` is a file next to a manifest instead of the source. */
  read(start: number, end: number, wholeIfNeeded: boolean, events: ReadingEvents, of?: StoredPlace): number {
    return this.ask(events, (id) => ({ type: "read", id, start, end, wholeIfNeeded, of }));
  }

  manifests(url: string, name: string, events: ReadingEvents): number {
    return this.ask(events, (id) => ({ type: "manifests", id, url, name }));
  }

  page(url: string, entry: PageEntry, events: ReadingEvents): number {
    return this.ask(events, (id) => ({ type: "page", id, url, entry }));
  }

  follow(start: number, events: ReadingEvents): number {
    return this.ask(events, (id) => ({ type: "follow", id, start }));
  }

  cancel(id: number): void {
    if (this.readings.delete(id)) this.port.postMessage({ type: "cancel", id }, []);
  }

  private ask(events: ReadingEvents, request: (id: number) => ReadRequest): number {
    const id = ++this.made;
    this.readings.set(id, events);
    this.port.postMessage(request(id), []);
    return id;
  }

  private hear(reply: ReadReply): void {
    if (reply.type === "bytes") this.fetchedBytes += reply.bytes.length;
    const events = this.readings.get(reply.id);
    if (!events) return;
    if (reply.type === "begin") events.begin?.(reply);
    else if (reply.type === "bytes") events.bytes?.(reply.bytes);
    else if (reply.type === "manifest") events.manifest?.(reply.manifest);
    else if (reply.type === "qualities") events.qualities?.(reply.qualities);
    else if (reply.type === "page") events.page?.(reply.content);
    else if (reply.type === "recovered") events.recovered?.();
    else if (reply.type === "waiting") events.waiting?.(reply.seconds, reply.problem);
    else {
      this.readings.delete(reply.id);
      if (reply.type === "end") events.end();
      else events.failed(reply.message, reply.temporary);
    }
  }
}
