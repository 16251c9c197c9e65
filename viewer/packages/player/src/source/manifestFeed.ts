// SPDX-License-Identifier: Apache-2.0
/**
 * The manifest of a live stream, again whenever it has changed.
 *
 * Each request says which one is there (`?after=SEQUENCE`): a server that knows this answers when there is a newer one. Other
 * hosts answer at once with what they have, and are asked again after a while that grows while nothing new comes.
 */

import { SourceError } from "./byteSource.js";
import { answered, refusal } from "./httpSource.js";
import { joined } from "./joined.js";
import { type Manifest, MOST_MANIFEST_BYTES, manifestIn, type Quality } from "./manifest.js";
import { pause } from "./pause.js";
import type { RetryPolicy } from "./retryPolicy.js";

/** A server that waits for news lets go after this at the latest; an answer that takes longer never comes. */
const ANSWER_SECONDS = 45;
/** Answers without news, and with news, that came sooner were not held back until there were some. */
const WAITED_SECONDS = 2;
const HELD_SECONDS = 0.25;

/** So often a host that does not wait is asked for each frame, until one takes so many times as long as those before. */
const POLLS = 4;
const OVERDUE = 3;

export interface FeedEvents {
  manifest(manifest: Manifest): void;
  qualities(qualities: readonly Quality[]): void;
  /** The host does not answer, or has nonsense; it is asked again in so many seconds. */
  waiting(seconds: number, problem: string): void;
  /** It answers again. */
  recovered(): void;
}

export class ManifestFeed {
  private etag: string | undefined;
  private last: Manifest | undefined;

  /** @param own whether the host is the page's: it can be told which manifest is there without being asked for leave */
  constructor(
    private readonly url: string,
    private readonly name: string,
    private readonly request: typeof fetch,
    private readonly sameOrigin: boolean,
    private readonly own: boolean,
    private readonly retryPolicy: RetryPolicy,
  ) {}

  /**
   * Gives manifests until one is of a finished stream, or the address leads to a list of qualities. A run that ends
   * meanwhile may be resumed, so its host is asked a while longer; that of a live one for as long as it takes.
   *
   * @throws SourceError the first one cannot be had, or the stream was replaced
   */
  async follow(events: FeedEvents, signal: AbortSignal): Promise<void> {
    const { firstPoll, longestPoll, backOff, stillAfter } = this.retryPolicy;
    let [wait, troubled, fresh] = [firstPoll, false, performance.now()];
    while (!signal.aborted) {
      if (this.isOver && performance.now() - fresh > stillAfter * 1000) return;
      const began = performance.now();
      try {
        const asked = this.last;
        const found = await this.ask(signal);
        if (signal.aborted) return;
        if (troubled) events.recovered();
        troubled = false;
        if (found && !("sequence" in found)) return events.qualities(found);
        if (found) events.manifest(found);
        if (found && !found.live && !asked?.live) return;
        const took = (performance.now() - began) / 1000;
        if (found) fresh = performance.now();
        wait = found ? firstPoll : Math.min(wait * backOff, this.longest((performance.now() - fresh) / 1000));
        // A host that held the answer back is one that waits for news.
        if (!asked || took < (found ? HELD_SECONDS : WAITED_SECONDS)) await pause(wait, signal);
      } catch (error) {
        if (signal.aborted) return;
        if (this.isOver && !(error instanceof SourceError && error.final)) {
          await pause(longestPoll, signal); // what there is plays without the host
          continue;
        }
        if (!this.last || (error instanceof SourceError && error.final)) throw error;
        wait = troubled ? Math.min(wait * 2, longestPoll) : firstPoll;
        troubled = true;
        events.waiting(wait, (error as Error).message);
        await pause(wait, signal);
      }
    }
  }

  /** Whether the run has ended. */
  private get isOver(): boolean {
    return this.last?.live === false;
  }

  /** The longest wait for a frame that is expected soon; one that is overdue for long is asked for less often. */
  private longest(sinceNews: number): number {
    const { firstPoll, longestPoll } = this.retryPolicy;
    const pace = this.last?.frame_seconds ?? 0;
    return sinceNews > OVERDUE * pace ? longestPoll : Math.min(Math.max(pace / POLLS, firstPoll), longestPoll);
  }

  /** The next manifest; undefined where it is still the last one. */
  private async ask(signal: AbortSignal): Promise<Manifest | readonly Quality[] | undefined> {
    const { last } = this;
    const url = new URL(this.url);
    if (last) url.searchParams.set("after", String(last.sequence));
    const late = new AbortController();
    const end = () => late.abort();
    signal.addEventListener("abort", end);
    const timer = setTimeout(end, ANSWER_SECONDS * 1000);
    try {
      const headers: Record<string, string> = this.own && this.etag ? { "If-None-Match": this.etag } : {};
      const response = await answered(this.request, url.href, this.name, headers, this.sameOrigin, late.signal);
      if (response.status === 304) return undefined;
      if (response.status !== 200) throw refusal(this.name, response.status);
      const bytes = await limited(response, MOST_MANIFEST_BYTES, this.name);
      const found = manifestIn(bytes, this.name);
      this.etag = response.headers.get("ETag") ?? undefined;
      return "sequence" in found ? this.newer(found) : found;
    } catch (error) {
      if (!late.signal.aborted || signal.aborted) throw error;
      throw new SourceError(
        `The server has not answered for ${ANSWER_SECONDS} s where ${this.name} was asked for.`,
        true,
      );
    } finally {
      clearTimeout(timer);
      signal.removeEventListener("abort", end);
    }
  }

  private newer(found: Manifest): Manifest | undefined {
    const { last } = this;
    const replaced = last?.periods.some(({ period, sha256 }) =>
      found.periods.some((other) => other.period === period && other.sha256 !== sha256),
    );
    if (replaced)
      throw new SourceError(`${this.name} is of another stream now: it was replaced. Load it again.`, false, true);
    // A cache on the way may be behind.
    if (last && found.sequence <= last.sequence) return undefined;
    this.last = found;
    return found;
  }
}

/** The whole body, unless it has more bytes than may be. */
async function limited(response: Response, most: number, name: string): Promise<Uint8Array> {
  const reader = response.body!.getReader();
  const parts: Uint8Array[] = [];
  let bytes = 0;
  for (;;) {
    const { done, value } = await reader.read().catch(() => {
      throw new SourceError(`The connection broke while ${name} was read.`, true);
    });
    if (done) break;
    bytes += value.length;
    if (bytes > most) {
      await reader.cancel();
      throw new SourceError(`${name} has more than ${most} bytes, which no manifest has.`);
    }
    parts.push(value);
  }
  return joined(parts);
}
