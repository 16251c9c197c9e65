// SPDX-License-Identifier: Apache-2.0
/** The decode worker's interface to the fetch worker. */

import type { ReadReply, ReadRequest, SourceDescription, StoredPlace } from "../source/description.js";
import type { PageEntry } from "../source/manifest.js";
import type { Port } from "../source/port.js";

type AnyReply = { readonly [Type in ReadReply["type"]]: (reply: ReadReply & { readonly type: Type }) => void };

/** What is done with the replies of one reading; none follows `end` or `failed`. */
export type ReadingEvents = Partial<AnyReply> & Pick<AnyReply, "end" | "failed">;

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
    if (reply.type === "end" || reply.type === "failed") this.readings.delete(reply.id);
    (events[reply.type] as ((reply: ReadReply) => void) | undefined)?.(reply);
  }
}
