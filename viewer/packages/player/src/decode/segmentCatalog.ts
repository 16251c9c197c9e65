// SPDX-License-Identifier: Apache-2.0
/** The packets of a segments folder, from its manifests and the pages that are needed. */

import type { Manifest, PageContent, PageEntry, PartEntry, PeriodEntry, SegmentEntry } from "../source/manifest.js";
import { Catalog, type Place } from "./catalog.js";
import type { CatalogFacts, LiveFacts } from "./messages.js";

/** Largest number of cached pages; the ones used last are retained. */
const MAX_PAGES = 12;
/** Minimum number of last frames over which the pace of the media is measured, as writers do. */
const PACE_FRAMES = 8;

export class SegmentCatalog extends Catalog {
  private manifest: Manifest | undefined;
  private readonly pages = new Map<string, PageContent>();
  /** The last result of a search and its first frame, because frames are requested in order. */
  private found: { readonly segment: SegmentEntry; readonly offsets: Float64Array } | undefined;

  get count(): number {
    return this.manifest ? this.manifest.edge.frame + 1 : 0;
  }

  get live(): boolean {
    return this.manifest?.live === true;
  }

  /** The period that begins with the frame after the edge, if the writer has named one. */
  get nextPeriod(): PeriodEntry | undefined {
    const newest = this.manifest?.periods.at(-1);
    return newest && newest.first_frame >= this.count ? newest : undefined;
  }

  take(manifest: Manifest): void {
    this.manifest = manifest;
    this.first = manifest.window.first_frame;
    this.complete = !manifest.live;
    this.found = undefined;
    this.forgetDamage(this.first);
    const reached = new Set(manifest.history.map(({ file }) => file));
    for (const { pages } of this.pages.values()) for (const { file } of pages) reached.add(file);
    for (const file of this.pages.keys()) if (!reached.has(file)) this.pages.delete(file);
  }

  /** The page that must be read to locate a frame; undefined if none is missing. */
  missingPage(index: number): PageEntry | undefined {
    let entry = covering(this.manifest?.history, index);
    while (entry) {
      const page = this.pages.get(entry.file);
      if (!page) return entry;
      // The most recently used ones are at the end.
      this.pages.delete(entry.file);
      this.pages.set(entry.file, page);
      entry = covering(page.pages, index);
    }
    return undefined;
  }

  takePage(entry: PageEntry, content: PageContent): void {
    this.pages.set(entry.file, content);
    while (this.pages.size > MAX_PAGES) this.pages.delete(this.pages.keys().next().value as string);
  }

  /** The period of a frame, if known. */
  period(index: number): PeriodEntry | undefined {
    const number = (this.part(index) ?? this.segment(index)?.segment)?.period;
    return this.manifest?.periods.find(({ period }) => period === number);
  }

  /** The frame after the last of a period so far. */
  periodEnd(number: number): number {
    return this.manifest?.periods.find(({ period }) => period > number)?.first_frame ?? this.count;
  }

  place(index: number): Place | undefined {
    if (index < this.first) return undefined;
    const part = this.part(index);
    if (part) return { start: 0, end: part.bytes, entry: part };
    const found = this.segment(index);
    if (!found) return undefined;
    const at = index - found.segment.first_frame;
    return { start: found.offsets[at]!, end: found.offsets[at + 1]!, entry: found.segment };
  }

  isKey(index: number): boolean {
    const part = this.part(index);
    return part ? part.kind === "key" : this.segment(index)?.segment.first_frame === index;
  }

  groupStart(index: number): number {
    const parts = this.manifest?.parts ?? [];
    if (this.part(index)) {
      let first = index;
      while (first > parts[0]!.frame && !this.isKey(first)) first--;
      return first;
    }
    return this.segment(index)?.segment.first_frame ?? index;
  }

  groupEnd(index: number): number {
    let end = index + 1;
    if (this.part(index)) while (end < this.count && !this.isKey(end)) end++;
    else {
      const segment = this.segment(index)?.segment;
      if (segment) end = segment.first_frame + segment.frames;
    }
    return end;
  }

  facts(): CatalogFacts {
    const frames: number[] = [];
    const times: number[] = [];
    const keys: number[] = [];
    const knot = (frame: number, ptsSeconds: number) => {
      if (frame <= (frames.at(-1) ?? -1)) return;
      frames.push(frame);
      // Times of a manifest may be wrong, but must increase.
      times.push(Math.max(ptsSeconds, (times.at(-1) ?? Number.NEGATIVE_INFINITY) + 1e-9));
    };
    const run = (entry: PageEntry | SegmentEntry) => {
      const end = entry.first_frame + entry.frames;
      if (end <= this.first) return;
      knot(entry.first_frame, entry.pts_seconds[0]);
      knot(end - 1, entry.pts_seconds[1]);
    };
    const page = (entry: PageEntry) => {
      const content = this.pages.get(entry.file);
      if (!content) return run(entry);
      for (const one of content.pages) page(one);
      for (const one of content.segments) segment(one);
    };
    const segment = (entry: SegmentEntry) => {
      run(entry);
      if (entry.first_frame >= this.first) keys.push(entry.first_frame);
    };
    const { manifest } = this;
    for (const entry of manifest?.history ?? []) page(entry);
    for (const entry of manifest?.segments ?? []) segment(entry);
    for (const { frame, pts_seconds, kind } of manifest?.parts ?? []) {
      knot(frame, pts_seconds);
      if (kind === "key") keys.push(frame);
    }
    return {
      first: this.first,
      count: this.count,
      frames: Float64Array.from(frames),
      ptsSeconds: Float64Array.from(times),
      keys: Uint32Array.from(keys),
      lost: this.lost(),
      complete: this.complete,
      ...(manifest ? { live: liveFacts(manifest) } : {}),
    };
  }

  private part(index: number): PartEntry | undefined {
    const parts = this.manifest?.parts;
    return parts?.length ? parts[index - parts[0]!.frame] : undefined;
  }

  private segment(index: number) {
    const { found } = this;
    if (found && index >= found.segment.first_frame && index < found.segment.first_frame + found.segment.frames) {
      return found;
    }
    let content: PageContent | undefined;
    for (let entry = covering(this.manifest?.history, index); entry; entry = covering(content?.pages, index)) {
      content = this.pages.get(entry.file);
    }
    const segment = covering(content ? content.segments : this.manifest?.segments, index);
    if (!segment) return undefined;
    const offsets = new Float64Array(segment.frames + 1);
    for (const [i, bytes] of segment.frame_bytes.entries()) offsets[i + 1] = offsets[i]! + bytes;
    this.found = { segment, offsets };
    return this.found;
  }
}

/** The entry of consecutive ones that contains a frame. */
function covering<Entry extends PageEntry | SegmentEntry>(
  entries: readonly Entry[] | undefined,
  index: number,
): Entry | undefined {
  let [low, high] = [0, (entries?.length ?? 0) - 1];
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (entries![middle]!.first_frame <= index) low = middle;
    else high = middle - 1;
  }
  const entry = entries?.[low];
  return entry && index >= entry.first_frame && index < entry.first_frame + entry.frames ? entry : undefined;
}

function liveFacts(manifest: Manifest): LiveFacts {
  const { live, target_latency_seconds, frame_seconds, fps, edge } = manifest;
  return {
    live,
    targetSeconds: target_latency_seconds,
    frameSeconds: frame_seconds ?? undefined,
    mediaSeconds: mediaPace(manifest) ?? 1 / fps,
    fps,
    filmedAtZero: edge.captured_unix_seconds === null ? undefined : edge.captured_unix_seconds - edge.pts_seconds,
  };
}

/** Media time from frame to frame, over at least the last few frames if there are so many. */
function mediaPace({ parts, segments, edge }: Manifest): number | undefined {
  const since =
    [...segments].reverse().find(({ first_frame }) => edge.frame - first_frame >= PACE_FRAMES) ?? segments[0];
  const part = parts[parts.length - 1 - PACE_FRAMES] ?? (since ? undefined : parts[0]);
  const [frame, seconds] = part
    ? [part.frame, part.pts_seconds]
    : [since?.first_frame ?? 0, since?.pts_seconds[0] ?? 0];
  const pace = (edge.pts_seconds - seconds) / (edge.frame - frame);
  return pace > 0 && Number.isFinite(pace) ? pace : undefined;
}
