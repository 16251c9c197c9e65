// SPDX-License-Identifier: Apache-2.0
/**
 * The manifest of a live stream, and each newer version of it.
 *
 * Each request contains the present sequence (`?after=SEQUENCE`): the package's server answers when there is a newer one.
 * Other hosts answer immediately, and are asked again after intervals that grow while there is nothing new.
 */

import { SourceError } from "./byteSource.js";
import { answered, refusal } from "./httpSource.js";
import { joined } from "./joined.js";
import { MAX_MANIFEST_BYTES, type Manifest, manifestIn, type Quality } from "./manifest.js";
import { pause } from "./pause.js";
import type { RetryPolicy } from "./retryPolicy.js";

/** Longest time of a waiting request; a later answer will not come. */
const ANSWER_SECONDS = 45;
/** Answers without and with a newer manifest that come sooner show that the host does not wait. */
const WAITED_SECONDS = 2;
const HELD_SECONDS = 0.25;

/** Requests per frame to a host that does not wait, until a frame takes a multiple of the earlier ones' time. */
const POLLS = 4;
const OVERDUE = 3;

export interface FeedEvents {
  manifest(manifest: Manifest): void;
  qualities(qualities: readonly Quality[]): void;
  /** The host does not answer, or its answer is invalid; seconds until the next request. */
  waiting(seconds: number, problem: string): void;
  /** The host answers again. */
  recovered(): void;
}

export class ManifestFeed {
  private etag: string | undefined;
  private last: Manifest | undefined;

  /** @param own whether the host is the page's own, so that the query needs no preflight request */
  constructor(
    private readonly url: string,
    private readonly name: string,
    private readonly request: typeof fetch,
    private readonly sameOrigin: boolean,
    private readonly own: boolean,
    private readonly retryPolicy: RetryPolicy,
  ) {}

  /**
   * Passes on manifests until the stream is finished, or the address has a list of renditions. A run that ends
   * meanwhile may be resumed, so its host is asked for some time longer; that of a live one without limit.
   *
   * @throws SourceError the first one is not available, or the stream was replaced
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
        // A host that delayed its answer waits for newer manifests.
        if (!asked || took < (found ? HELD_SECONDS : WAITED_SECONDS)) await pause(wait, signal);
      } catch (error) {
        if (signal.aborted) return;
        if (this.isOver && !(error instanceof SourceError && error.final)) {
          await pause(longestPoll, signal); // existing frames are played without the host
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

  /** Longest interval of requests for a frame that is expected soon; they are less frequent for one long overdue. */
  private longest(sinceNews: number): number {
    const { firstPoll, longestPoll } = this.retryPolicy;
    const pace = this.last?.frame_seconds ?? 0;
    return sinceNews > OVERDUE * pace ? longestPoll : Math.min(Math.max(pace / POLLS, firstPoll), longestPoll);
  }

  /** The next manifest; undefined if it has not changed. */
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
      const bytes = await limited(response, MAX_MANIFEST_BYTES, this.name);
      const found = manifestIn(bytes, this.name);
      this.etag = response.headers.get("ETag") ?? undefined;
      return "sequence" in found ? this.newer(found) : found;
    } catch (error) {
      if (!late.signal.aborted || signal.aborted) throw error;
      throw new SourceError(`The server has not answered the request for ${this.name} for ${ANSWER_SECONDS} s.`, true);
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
    // A cache in between may be outdated.
    if (last && found.sequence <= last.sequence) return undefined;
    this.last = found;
    return found;
  }
}

/** The whole body, unless it exceeds the largest size. */
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
