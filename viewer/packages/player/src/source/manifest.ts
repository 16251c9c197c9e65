// SPDX-License-Identifier: Apache-2.0
/** The manifest of a segments folder and its pages (docs/segments.md); fields have the names that they have there. */

import { SourceError } from "./byteSource.js";
import {
  type Check,
  fieldOf,
  flag,
  like,
  list,
  number,
  orNull,
  parsedJson,
  refuse,
  shaped,
  span,
  text,
  whole,
} from "./checks.js";

export const MAX_MANIFEST_BYTES = 2 ** 22;
const FORMAT = "structgstream-segments";
const QUALITIES = "structgstream-qualities";
const MAX_ENTRIES = 4096;
const MAX_GROUP_FRAMES = 65_536;
const MAX_RECORD_BYTES = 2 ** 33;
const MAX_QUALITIES = 8;
const MAX_LIST_BYTES = 2 ** 16;

const count = whole(1);
const storedFile = {
  file: like(/^[\w-][\w.-]{0,127}$/, "the plain name of a file in its folder"),
  bytes: whole(1, 2 ** 40),
  sha256: like(/^[\da-f]{64}$/, "64 hex digits"),
};
const period = shaped({ ...storedFile, period: whole(), first_frame: whole(), first_segment: whole() });
const page = shaped({
  ...storedFile,
  bytes: whole(1, MAX_MANIFEST_BYTES),
  level: whole(0, 8),
  first_segment: whole(),
  segments: count,
  first_frame: whole(),
  frames: count,
  pts_seconds: span,
});
const anySegment = shaped({
  ...storedFile,
  segment: whole(),
  period: whole(),
  first_frame: whole(),
  frames: whole(1, MAX_GROUP_FRAMES),
  pts_seconds: span,
  key_bytes: whole(1, MAX_RECORD_BYTES),
  frame_bytes: list(whole(1, MAX_RECORD_BYTES), MAX_GROUP_FRAMES),
});
const part = shaped({
  ...storedFile,
  frame: whole(),
  period: whole(),
  kind: like(/^(key|delta)$/, '"key" or "delta"'),
  pts_seconds: number(),
  bytes: whole(1, MAX_RECORD_BYTES),
});
const segment: Check<SegmentEntry> = (value, where) => {
  const found = anySegment(value, where);
  const { frame_bytes: lengths } = found;
  const sum = lengths.reduce((all, bytes) => all + bytes, 0);
  if (lengths.length !== found.frames || sum !== found.bytes || lengths[0] !== found.key_bytes)
    refuse(fieldOf(where, "frame_bytes"), lengths, "the lengths of its frames");
  return found;
};
const manifest = shaped({
  sequence: whole(0, 2 ** 53 - 1),
  live: flag,
  fps: number(1e-9),
  name: text,
  target_latency_seconds: number(0),
  frame_seconds: orNull(number(0)),
  edge: shaped({
    frame: whole(),
    pts_seconds: number(),
    captured_unix_seconds: orNull(number()),
    published_unix_seconds: number(),
  }),
  window: shaped({ first_frame: whole(), first_segment: whole(), seconds: orNull(number()) }),
  periods: list(period, MAX_ENTRIES),
  history: list(page, MAX_ENTRIES),
  segments: list(segment, MAX_ENTRIES),
  parts: list(part, MAX_GROUP_FRAMES),
});
const qualities = list(
  shaped({
    manifest: like(/^([\w-][\w.-]{0,127}\/){0,4}[\w-][\w.-]{0,127}$/, "the plain path of a manifest below it"),
    bits_per_second: number(1),
    name: text,
  }),
  MAX_QUALITIES,
);

/** Facts that every entry states about its file. */
export type FileEntry = { readonly file: string; readonly bytes: number; readonly sha256: string };
export type PeriodEntry = ReturnType<typeof period>;
export type PageEntry = ReturnType<typeof page>;
export type SegmentEntry = ReturnType<typeof anySegment>;
export type PartEntry = ReturnType<typeof part>;
export type Manifest = ReturnType<typeof manifest>;
/** Entries of a page: pages of the level below, or segments. */
export type PageContent = { readonly pages: readonly PageEntry[]; readonly segments: readonly SegmentEntry[] };
/** One of several manifests of the same frames. */
export type Quality = ReturnType<typeof qualities>[number];

/**
 * The content of a JSON file: a manifest, or a list of several for one stream.
 *
 * @throws SourceError it is neither, has a newer version, is inconsistent, or exceeds the format's bounds
 */
export function manifestIn(bytes: Uint8Array, name: string): Manifest | readonly Quality[] {
  const value = parsedJson(bytes, name);
  const listed = (value as { format?: unknown } | null)?.format === QUALITIES;
  const most = listed ? MAX_LIST_BYTES : MAX_MANIFEST_BYTES;
  if (bytes.length > most) throw new SourceError(`${name} has ${bytes.length} bytes; expected at most ${most}.`);
  if (listed) {
    const found = shaped({ version: only(1), qualities })(value, name).qualities;
    return found.length ? found : refuse(fieldOf(name, "qualities"), [], "at least one");
  }
  checkHead(value, name);
  const found = manifest(value, name);
  checkWhole(found, name);
  return found;
}

/**
 * The entries of a history page.
 *
 * @throws SourceError it differs from what its entry states
 */
export function pageIn(bytes: Uint8Array, entry: PageEntry): PageContent {
  const { file, level } = entry;
  const value = parsedJson(bytes, file);
  checkHead(value, file);
  const pages = level ? shaped({ history: list(page, MAX_ENTRIES) })(value, file).history : [];
  const segments = level ? [] : shaped({ segments: list(segment, MAX_ENTRIES) })(value, file).segments;
  if (pages.some((one) => one.level !== level - 1)) throw new SourceError(`${file} lists pages of a wrong level.`);
  const end = runEnd(segments, runEnd(pages, [entry.first_segment, entry.first_frame], file), file);
  if (end[0] !== entry.first_segment + entry.segments || end[1] !== entry.first_frame + entry.frames)
    throw new SourceError(`${file} does not list the frames that are announced.`);
  return { pages, segments };
}

function only(expected: number): Check<number> {
  return (value, where) => (value === expected ? expected : refuse(where, value, `${expected}; use a newer player`));
}

function checkHead(value: unknown, name: string): void {
  const format: Check<string> = (found, where) => (found === FORMAT ? FORMAT : refuse(where, found, `"${FORMAT}"`));
  shaped({ format, version: only(1) })(value, name);
}

function checkWhole(found: Manifest, name: string): void {
  const { edge, window, periods, parts, live } = found;
  const wrong = (what: string) => new SourceError(`${name} contradicts itself: ${what}.`);
  const [segments, frames] = runEnd(found.segments, runEnd(found.history, [0, 0], name), name);
  if (parts.some((entry, i) => entry.frame !== frames + i)) throw wrong("its parts do not follow its segments");
  if (parts.length && (!live || parts[0]!.kind !== "key")) throw wrong("it has parts where none can be");
  const end = frames + parts.length;
  if (edge.frame !== end - 1) throw wrong(`it lists ${end} frames, and its edge is frame ${edge.frame}`);
  if (window.first_frame >= end || window.first_segment > segments) throw wrong("its window begins after its edge");
  const ordered = periods.every((entry, i) => {
    const before = periods[i - 1];
    return !before || (entry.period === before.period + 1 && entry.first_frame > before.first_frame);
  });
  if (!periods.length || periods[0]!.first_frame > window.first_frame || !ordered) {
    throw wrong("its periods are not those of its window");
  }
  const known = new Set(periods.map((entry) => entry.period));
  const used = [...found.segments.filter((entry) => entry.segment >= window.first_segment), ...parts];
  if (used.some((entry) => !known.has(entry.period))) throw wrong("it lacks the init record of a period");
}

/** Checks that entries are consecutive from this segment and frame on; returns the segment and frame after the last. */
function runEnd(
  entries: readonly (PageEntry | SegmentEntry)[],
  [segment, frame]: readonly [segment: number, frame: number],
  name: string,
): readonly [segment: number, frame: number] {
  let [nextSegment, nextFrame] = [segment, frame];
  for (const entry of entries) {
    const isPage = "segments" in entry;
    if (entry.first_frame !== nextFrame || (isPage ? entry.first_segment : entry.segment) !== nextSegment)
      throw new SourceError(`${name} lists ${entry.file} where frame ${nextFrame} of segment ${nextSegment} belongs.`);
    nextSegment += isPage ? entry.segments : 1;
    nextFrame += entry.frames;
  }
  return [nextSegment, nextFrame];
}
