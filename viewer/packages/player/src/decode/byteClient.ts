// SPDX-License-Identifier: Apache-2.0
/** The decode worker's side of the line to the fetch worker. */

import type { ReadReply, ReadRequest, SourceDescription } from "../source/description.js";
import type { Port } from "../source/port.js";

/** What becomes of one reading; after `end` or `failed` nothing more comes. */
export interface ReadingEvents {
  begin?(reply: ReadReply & { type: "begin" }): void;
  bytes(bytes: Uint8Array): void;
  end(): void;
  failed(message: string): void;
  waiting?(seconds: number, problem: string | undefined): void;
}

export class ByteClient {
  private readonly readings = new Map<number, ReadingEvents>();
  private made = 0;
  /** Bytes that have come so far. */
  fetchedBytes = 0;

  constructor(private readonly port: Port<ReadRequest, ReadReply>) {
    port.onmessage = ({ data }) => this.hear(data);
  }

  open(source: SourceDescription): void {
    this.readings.clear();
    this.port.postMessage({ type: "open", source }, []);
  }

  /** Begins to read; the number is for {@link cancel}. */
  read(start: number, end: number, wholeIfNeeded: boolean, events: ReadingEvents): number {
    const id = this.remember(events);
    this.port.postMessage({ type: "read", id, start, end, wholeIfNeeded }, []);
    return id;
  }

  follow(start: number, events: ReadingEvents): number {
    const id = this.remember(events);
    this.port.postMessage({ type: "follow", id, start }, []);
    return id;
  }

  cancel(id: number): void {
    if (this.readings.delete(id)) this.port.postMessage({ type: "cancel", id }, []);
  }

  private remember(events: ReadingEvents): number {
    this.readings.set(++this.made, events);
    return this.made;
  }

  private hear(reply: ReadReply): void {
    if (reply.type === "bytes") this.fetchedBytes += reply.bytes.length;
    const events = this.readings.get(reply.id);
    if (!events) return;
    if (reply.type === "begin") events.begin?.(reply);
    else if (reply.type === "bytes") events.bytes(reply.bytes);
    else if (reply.type === "waiting") events.waiting?.(reply.seconds, reply.problem);
    else {
      this.readings.delete(reply.id);
      if (reply.type === "end") events.end();
      else events.failed(reply.message);
    }
  }
}
