// SPDX-License-Identifier: Apache-2.0
/** A stream in a segments folder: follows its manifest and fetches pages and init records on demand. */

import { ByteQueue, StreamError, StreamReader } from "@structgstream/core";
import type { Manifest, PageEntry, PeriodEntry, Quality } from "../source/manifest.js";
import type { ByteClient, ReadingEvents } from "./byteClient.js";
import type { Place } from "./catalog.js";
import { PacketLoader } from "./packetLoader.js";
import { PacketStore } from "./packetStore.js";
import { SegmentCatalog } from "./segmentCatalog.js";
import { type Chapter, Chapters, type Stream, type StreamEvents } from "./stream.js";

/** Seconds to wait after a file could not be fetched. */
const AGAIN_MILLISECONDS = 1000;
/** Number of requests of a file that is missing or wrong; while the stream goes on, of manifests that name it. */
const ATTEMPTS = 3;

export interface SegmentEvents extends Omit<StreamEvents, "failed"> {
  qualities(qualities: readonly Quality[]): void;
  notice(message: string): void;
  /** A `temporary` failure may disappear without action. */
  failed(message: string, temporary?: boolean): void;
}

export class SegmentStream implements Stream {
  readonly catalog = new SegmentCatalog();
  readonly store: PacketStore;
  readonly loader: PacketLoader;
  /** By number of the period. */
  private readonly chapters = new Chapters();
  /** Files that are being fetched, except those with packets. */
  private readonly coming = new Set<string>();
  private readonly failures = new Map<string, { readonly count: number; readonly manifest: number }>();
  /** Manifests so far. */
  private manifests = 0;
  private following: number | undefined;
  private troubled = false;

  /**
   * @param url of its manifest
   * @param name what messages call that
   */
  constructor(
    private readonly client: ByteClient,
    readonly url: string,
    private readonly name: string,
    budgetBytes: number,
    private readonly events: SegmentEvents,
  ) {
    this.store = new PacketStore(budgetBytes);
    const loading = {
      changed: () => events.stored(),
      damaged: (index: number, { entry, start }: Place) =>
        events.lost(index, undefined, `its record at byte ${start} of ${entry?.file} is damaged`),
      // While the manifest is followed, it reports the state of the connection.
      waiting: (seconds: number, problem: string | undefined) => {
        if (!this.catalog.live) events.waiting(seconds, problem);
      },
      failed: (problem: string, temporary: boolean, first: number, end: number, file: string) =>
        this.packetsFailed(problem, temporary, first, end, file),
    };
    this.loader = new PacketLoader(client, this.catalog, this.store, loading, url);
  }

  /** Starts following the manifest. */
  follow(): void {
    this.following ??= this.client.manifests(this.url, this.name, {
      manifest: ({ manifest }) => this.take(manifest),
      qualities: ({ qualities }) => this.events.qualities(qualities),
      end: () => {},
      failed: ({ message, temporary }) => this.events.failed(message, temporary),
      waiting: ({ seconds, problem }) => {
        // Report it only once.
        if (!this.troubled) this.events.waiting(seconds, problem);
        this.troubled = true;
      },
      recovered: () => {
        this.troubled = false;
        this.events.notice("The stream can be reached again.");
      },
    });
  }

  /** Stops all requests until it is followed again. */
  leave(): void {
    if (this.following !== undefined) this.client.cancel(this.following);
    this.following = undefined;
    this.loader.cancel();
  }

  chapter(index: number, ahead: number): Chapter | undefined {
    const last = Math.min(ahead, this.catalog.count) - 1;
    const isThere = this.known(index);
    // The next period's init record is fetched in advance.
    if (this.known(last)) this.opened(last);
    const { nextPeriod } = this.catalog;
    if (isThere && nextPeriod && ahead >= this.catalog.count) this.openedPeriod(nextPeriod, false);
    return isThere ? this.opened(index) : undefined;
  }

  private take(manifest: Manifest): void {
    this.manifests++;
    this.catalog.take(manifest);
    this.loader.blocked = false;
    this.events.changed();
  }

  /** Whether a frame's position is known; requests missing pages. */
  private known(index: number): boolean {
    const page = this.catalog.missingPage(index);
    if (page && !this.catalog.isLost(index)) this.fetchPage(page);
    return page === undefined;
  }

  private opened(index: number): Chapter | undefined {
    const entry = this.catalog.period(index);
    return entry && this.openedPeriod(entry, this.catalog.isLost(index));
  }

  /** @param lost whether the frame that needs it is lost; one that is written later requests it again */
  private openedPeriod(entry: PeriodEntry, lost: boolean): Chapter | undefined {
    const found = this.chapters.get(entry.period);
    if (!found && !lost) this.fetchInit(entry);
    return found;
  }

  private fetchPage(entry: PageEntry): void {
    const { first_frame: first, frames } = entry;
    const lose = (problem: string) => this.lose(first, first + frames, problem);
    this.fetch(entry.file, lose, (events) => {
      this.client.page(this.url, entry, {
        ...events,
        page: ({ content }) => {
          this.catalog.takePage(entry, content);
          this.events.changed();
        },
      });
    });
  }

  private fetchInit(entry: PeriodEntry): void {
    const lose = (problem: string) => this.lose(entry.first_frame, this.catalog.periodEnd(entry.period), problem);
    this.fetch(entry.file, lose, (events, refuse) => {
      const queue = new ByteQueue();
      const own: ReadingEvents = {
        ...events,
        bytes: ({ bytes }) => queue.append(bytes),
        end: (reply) => {
          const reader = new StreamReader(entry.file);
          try {
            reader.push(queue.peek(queue.length));
            if (!reader.header) reader.finish();
            this.chapters.put(entry.period, reader.header!);
          } catch (error) {
            if (!(error instanceof StreamError)) throw error;
            return refuse(error.message);
          }
          events.end(reply);
        },
      };
      this.client.read(0, entry.bytes, false, own, { url: this.url, entry, small: true });
    });
  }

  /** Requests a file once, and again some time after a failure; loses the frames that need it after the last attempt. */
  private fetch(
    file: string,
    lose: (problem: string) => void,
    ask: (events: ReadingEvents, refuse: (problem: string) => void) => void,
  ): void {
    if (this.coming.has(file)) return;
    this.coming.add(file);
    const over = () => {
      this.coming.delete(file);
      this.events.stored();
    };
    const again = () => setTimeout(over, AGAIN_MILLISECONDS);
    const refuse = (problem: string) => {
      lose(problem);
      again();
    };
    const failed: ReadingEvents["failed"] = ({ message, temporary }) => {
      if (this.attempt(file, temporary) >= ATTEMPTS) refuse(message);
      else again();
    };
    ask({ end: over, failed }, refuse);
  }

  private lose(first: number, end: number, problem: string): void {
    let from = Math.max(first, this.catalog.first);
    // The first frames of a period that goes on may be lost since an earlier attempt.
    while (from < end && this.catalog.isDamaged(from)) from++;
    if (from < end) this.events.lost(from, end, problem);
  }

  private packetsFailed(problem: string, temporary: boolean, first: number, end: number, file: string): void {
    // Parts are removed when they become a segment; the next manifest has the positions of their frames.
    const same = this.catalog.place(first)?.entry?.file === file;
    if (first < end && same && this.attempt(file, temporary) >= ATTEMPTS) {
      this.events.lost(first, end, problem);
      return;
    }
    if (first === end) this.events.notice(problem);
    this.loader.blocked = true;
    setTimeout(() => {
      this.loader.blocked = false;
      this.events.stored();
    }, AGAIN_MILLISECONDS);
  }

  /** Number of permanent failures of a file. Until the next manifest one that was removed cannot be found elsewhere. */
  private attempt(file: string, temporary: boolean): number {
    const before = this.failures.get(file);
    const same = this.catalog.live && before?.manifest === this.manifests;
    const count = (before?.count ?? 0) + Number(!temporary && !same);
    this.failures.set(file, { count, manifest: temporary ? (before?.manifest ?? -1) : this.manifests });
    if (this.failures.size > 64) this.failures.delete(this.failures.keys().next().value as string);
    return count;
  }
}
