// SPDX-License-Identifier: Apache-2.0
/** A stream in a segments folder, or in several renditions, of which one is decoded at a time. */

import type { Quality } from "../source/manifest.js";
import { siblingUrl } from "../source/storedFile.js";
import { AbrController } from "./abrController.js";
import type { ByteClient } from "./byteClient.js";
import type { Demand } from "./messages.js";
import { type SegmentEvents, SegmentStream } from "./segmentStream.js";
import type { StreamEvents } from "./stream.js";

export interface SegmentedEvents extends StreamEvents {
  /** The first manifest is available. */
  begun(stream: SegmentStream): void;
  notice(message: string): void;
  /** Names of the renditions, and the one in use. */
  qualities(names: readonly string[], at: number): void;
}

/** Interval between requests of a live stream's list of renditions. */
const LIST_MILLISECONDS = 30_000;

export class SegmentedStreams {
  private active: SegmentStream;
  private abr: AbrController | undefined;
  /** Time of the last request of the list of renditions. */
  private listed = 0;
  /** The rendition to switch to as soon as possible. */
  private pending: { readonly stream: SegmentStream; readonly step: number } | undefined;

  constructor(
    private readonly client: ByteClient,
    private readonly url: string,
    private readonly name: string,
    private readonly budgetBytes: number,
    private readonly events: SegmentedEvents,
  ) {
    this.active = this.followed(url, name);
  }

  /** Sets the rendition, or automatic selection. */
  choose(quality: number | undefined): void {
    if (this.abr) this.abr.choice = quality;
  }

  /**
   * Must be called before a frame is decoded.
   *
   * @returns the stream of another rendition, if frames from `next` on belong to it
   */
  changed(next: number, demand: Demand, seeking: boolean): SegmentStream | undefined {
    const { abr, active } = this;
    if (!abr) return undefined;
    if (active.catalog.live) this.listAgain();
    const { bitsPerSecond, busyShare } = active.loader.throughput;
    const step = abr.wanted(bitsPerSecond, busyShare);
    if (this.pending && this.pending.step !== step) this.drop();
    if (step === abr.at) return undefined;
    this.pending ??= {
      step,
      stream: this.qualityOf(abr.steps[step]!),
    };
    const { stream } = this.pending;
    const { catalog, store } = stream;
    if (step > abr.at && catalog.live && !seeking && next >= catalog.count - 1) {
      return this.atEdge(stream, next, demand) ? this.change() : undefined;
    }
    if (next >= catalog.count || !stream.chapter(next, demand.ahead)) return undefined;
    // Playback cannot continue without the frame that is needed at present.
    const starved = step < abr.at && !active.store.has(next);
    if (seeking || starved) return this.change();
    const key = catalog.groupStart(next) === next ? next : catalog.groupEnd(next);
    if (key >= catalog.count) return undefined;
    stream.loader.want(key, key + 1, Math.max(demand.ahead, key + 1));
    return key === next && store.has(key) ? this.change() : undefined;
  }

  /**
   * Whether a finer rendition can be used at its edge. Its frames are published after those of a coarser one,
   * so waiting for its next key frame would be too late: the newest group is fetched up to the edge instead.
   */
  private atEdge(stream: SegmentStream, next: number, demand: Demand): boolean {
    const { catalog, store, loader } = stream;
    const last = catalog.count - 1;
    if (next > last + 1 || last < 0 || !stream.chapter(last, demand.ahead)) return false;
    const first = catalog.groupStart(last);
    loader.want(first, last + 1, Math.max(demand.ahead, last + 1));
    for (let index = first; index <= last; index++) if (!store.has(index)) return false;
    return true;
  }

  private change(): SegmentStream {
    const { stream, step } = this.pending!;
    this.active.leave();
    this.active = stream;
    this.pending = undefined;
    this.abr!.change(step);
    this.postQualities();
    return stream;
  }

  private drop(): void {
    this.pending?.stream.leave();
    this.pending = undefined;
  }

  private followed(url: string, name: string): SegmentStream {
    let begun = false;
    const { events } = this;
    const isActive = () => stream === this.active;
    const forwarded: SegmentEvents = {
      changed: () => {
        if (!isActive()) events.stored();
        else {
          if (!begun) events.begun(stream);
          events.changed();
        }
        begun = true; // a rendition that is used later starts there
      },
      stored: () => events.stored(),
      qualities: (qualities) => {
        if (isActive() && !this.abr) this.begin(qualities);
        else forwarded.failed(`${name} leads to a list of qualities where a manifest belongs.`);
      },
      lost: (first, end, reason) => {
        if (isActive()) return events.lost(first, end, reason);
        stream.catalog.markDamaged(first, end);
        if (stream.catalog.shownFor(0) === undefined) forwarded.failed(reason);
      },
      notice: (message) => {
        if (isActive()) events.notice(message);
      },
      waiting: (seconds, problem) => {
        if (isActive()) events.waiting(seconds, problem);
      },
      failed: (message, temporary) => {
        if (isActive()) events.failed(message, !begun);
        else if (stream === this.pending?.stream) this.refuse(message, temporary);
      },
    };
    const stream: SegmentStream = new SegmentStream(this.client, url, name, this.budgetBytes, forwarded);
    stream.follow();
    return stream;
  }

  private begin(qualities: readonly Quality[]): void {
    this.abr = new AbrController(qualities, () => performance.now() / 1000);
    this.listed = performance.now();
    this.active.leave();
    this.active = this.qualityOf(this.abr.steps[0]!);
    this.postQualities();
  }

  private listAgain(): void {
    const now = performance.now();
    if (now - this.listed < LIST_MILLISECONDS) return;
    this.listed = now;
    const id = this.client.manifests(this.url, this.name, {
      qualities: ({ qualities }) => this.abr!.measured(qualities),
      manifest: () => this.client.cancel(id), // The address has another content by now.
      end: () => {},
      failed: () => {}, // The played stream reports outages.
    });
  }

  private refuse(message: string, temporary = false): void {
    this.abr!.refuse(this.pending!.step, temporary);
    this.drop();
    // The played stream reports outages.
    if (!temporary) this.events.notice(message);
  }

  private qualityOf({ manifest }: Quality): SegmentStream {
    return this.followed(siblingUrl(this.url, manifest), manifest);
  }

  private postQualities(): void {
    const { steps, at } = this.abr!;
    this.events.qualities(
      steps.map(({ name }) => name),
      at,
    );
  }
}
