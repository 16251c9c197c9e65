// SPDX-License-Identifier: Apache-2.0
/** A made-up live run: packets of stored streams as a segments folder that grows (docs/segments.md). */

import { createHash } from "node:crypto";
import { HEAD_BYTES, RecordType, recordBytes } from "@structgstream/core";
import { joined, piecesOf, record } from "../../core/test/streams.ts";

interface Made {
  readonly file: string;
  readonly bytes: number;
  readonly sha256: string;
}

interface Group {
  readonly period: number;
  readonly first: number;
  readonly times: readonly number[];
  readonly records: readonly Uint8Array[];
}

export interface RunOptions {
  readonly fps?: number;
  readonly frameSeconds?: number | null;
  readonly targetSeconds?: number;
  /** Segments that are kept, or all. */
  readonly windowSegments?: number;
  /** Segments of a page, and pages of a page of pages. */
  readonly pageSegments?: number;
}

/** The init record of a period, with the prefix, and the packets of a stream, each with its sound behind it. */
export function partsOf(stream: Uint8Array, period: number) {
  const [prefix, init, ...rest] = piecesOf(stream);
  const packets: Uint8Array[] = [];
  for (const piece of rest) {
    if (piece[0] === RecordType.sound) packets.push(joined(packets.pop()!, piece));
    else if (piece[0] !== RecordType.index) packets.push(piece);
  }
  return { init: joined(prefix!, record(RecordType.init, init!.slice(HEAD_BYTES, -4), period)), packets };
}

/** A packet with another number, time and period. */
export function renumbered(piece: Uint8Array, frame: number, seconds: number, period: number): Uint8Array {
  const bytes = recordBytes(piece);
  const payload = piece.slice(HEAD_BYTES, bytes - 4);
  const view = new DataView(payload.buffer);
  view.setUint32(0, frame, true);
  view.setFloat64(4, seconds, true);
  return joined(record(piece[0]!, payload, period), piece.subarray(bytes));
}

export class LiveRun {
  /** The folder, manifest included. */
  readonly files = new Map<string, Uint8Array>();
  live = true;
  sequence = 0;
  fps: number;
  frameSeconds: number | null;
  targetSeconds: number;
  /** What the manifest says instead, for what should be refused. */
  changed: Record<string, unknown> = {};
  private frame = 0;
  private segment = 0;
  private window = { first_frame: 0, first_segment: 0, seconds: null as number | null };
  private readonly periods: (Made & { period: number; first_frame: number; first_segment: number })[] = [];
  private segments: (Made & Record<string, unknown>)[] = [];
  private history: (Made & Record<string, unknown> & { level: number })[] = [];
  private parts: (Made & { frame: number; pts_seconds: number })[] = [];
  private outdated: Made[] = [];
  private group: Group | undefined;
  private packets: Uint8Array[] = [];
  private at = 0;

  constructor(
    stream: Uint8Array,
    private readonly options: RunOptions = {},
  ) {
    this.fps = options.fps ?? 30;
    this.frameSeconds = options.frameSeconds === undefined ? 1 / this.fps : options.frameSeconds;
    this.targetSeconds = options.targetSeconds ?? 0.1;
    this.begin(stream);
  }

  /** The frame that was written last. */
  get edge(): number {
    return this.frame - 1;
  }

  /** Goes on with the packets of another stream, as a period of its own. */
  begin(stream: Uint8Array): void {
    this.close();
    const period = this.periods.length;
    const { init, packets } = partsOf(stream, period);
    const name = `init-${String(period).padStart(4, "0")}`;
    this.periods.push({ ...this.put(name, init), period, first_frame: this.frame, first_segment: this.segment });
    this.packets = packets;
    this.at = 0;
  }

  /** Writes so many frames, and the manifest after the last; a stream that is over begins again. */
  write(frames: number): this {
    for (let i = 0; i < frames; i++) {
      const piece = this.packets[this.at++ % this.packets.length]!;
      const isKey = piece[0] === RecordType.key;
      if (isKey) this.close();
      const seconds = this.frame / this.fps;
      const bytes = renumbered(piece, this.frame, seconds, this.periods.length - 1);
      this.group ??= { period: this.periods.length - 1, first: this.frame, times: [], records: [] };
      this.group = { ...this.group, times: [...this.group.times, seconds], records: [...this.group.records, bytes] };
      const kind = isKey ? "key" : "delta";
      const part = { frame: this.frame, period: this.group.period, kind, pts_seconds: seconds };
      this.parts.push({ ...this.put(`part-${String(this.frame).padStart(8, "0")}`, bytes), ...part });
      this.frame++;
      this.counted();
    }
    this.publish();
    return this;
  }

  finish(): this {
    this.close();
    this.live = false;
    this.counted();
    this.publish();
    return this;
  }

  /** Goes on with what was finished, where the next packet is a key. */
  resume(): this {
    this.live = true;
    return this;
  }

  /** A rewriting of the manifest: its number rises, and the window moves. */
  private counted(): void {
    this.sequence++;
    const kept = this.options.windowSegments;
    if (kept !== undefined && this.segment > kept) this.forget(this.segment - kept);
  }

  /** Writes the manifest as it is now. */
  private publish(): void {
    const edge = this.edge;
    const manifest = {
      format: "structgstream-segments",
      version: 1,
      sequence: this.sequence,
      live: this.live,
      fps: this.fps,
      name: "made up",
      target_latency_seconds: this.targetSeconds,
      frame_seconds: this.frameSeconds,
      edge: {
        frame: edge,
        pts_seconds: edge / this.fps,
        captured_unix_seconds: null,
        published_unix_seconds: 1.7e9 + this.sequence,
      },
      window: this.window,
      periods: this.periods.filter(({ period }) => {
        const next = this.periods[period + 1];
        return !next || next.first_frame > this.window.first_frame;
      }),
      history: this.history,
      segments: this.segments,
      parts: this.parts,
      ...this.changed,
    };
    this.files.set("manifest.json", new TextEncoder().encode(JSON.stringify(manifest)));
  }

  /** The name of the newest file that begins like this. */
  newest(prefix: string): string {
    return [...this.files.keys()].filter((name) => name.startsWith(prefix)).at(-1)!;
  }

  /** Makes a segment of the group that is being written. */
  private close(): void {
    const { group } = this;
    this.group = undefined;
    if (!group) return;
    const stored = this.put(`segment-${String(this.segment).padStart(8, "0")}`, joined(...group.records));
    const frame_bytes = group.records.map((bytes) => bytes.length);
    this.segments.push({
      ...stored,
      segment: this.segment++,
      period: group.period,
      first_frame: group.first,
      frames: group.records.length,
      pts_seconds: [group.times[0]!, group.times.at(-1)!],
      key_bytes: frame_bytes[0],
      frame_bytes,
    });
    // Players whose manifest is an older one still ask for parts.
    for (const { file } of this.outdated.splice(0)) this.files.delete(file);
    this.outdated = this.parts;
    this.parts = [];
    const most = this.options.pageSegments;
    if (most === undefined) return;
    if (this.segments.length >= most + 2) {
      this.history.push(this.page(this.segments.splice(0, most), 0));
    }
    const first = this.history.findIndex(({ level }) => level === 0);
    if (this.history.length - first >= most + 2) {
      this.history.splice(first, most, this.page(this.history.slice(first, first + most), 1));
    }
  }

  private page(entries: Record<string, unknown>[], level: number) {
    const key = level ? "history" : "segments";
    const value = { format: "structgstream-segments", version: 1, [key]: entries };
    const [first, last] = [entries[0]!, entries.at(-1)!];
    const sum = (of: (entry: Record<string, unknown>) => number) => entries.reduce((all, entry) => all + of(entry), 0);
    const number = (level ? first.first_segment : first.segment) as number;
    return {
      ...this.put(
        `history-${String(number).padStart(8, "0")}`,
        new TextEncoder().encode(JSON.stringify(value)),
        "json",
      ),
      level,
      first_segment: number,
      segments: sum((entry) => (level ? (entry.segments as number) : 1)),
      first_frame: first.first_frame,
      frames: sum((entry) => entry.frames as number),
      pts_seconds: [(first.pts_seconds as number[])[0]!, (last.pts_seconds as number[])[1]!],
    };
  }

  /** Lets go of the segments before this one. */
  private forget(segment: number): void {
    const found = this.segments.find((entry) => entry.segment === segment);
    if (!found) return;
    this.window = { first_frame: found.first_frame as number, first_segment: segment, seconds: 1 };
    for (const name of this.files.keys()) {
      const number = /^segment-(\d+)/.exec(name)?.[1];
      if (number !== undefined && Number(number) < segment) this.files.delete(name);
    }
  }

  private put(name: string, bytes: Uint8Array, ending = "sgs"): Made {
    const sha256 = createHash("sha256").update(bytes).digest("hex");
    const file = `${name}-${sha256.slice(0, 16)}.${ending}`;
    this.files.set(file, bytes);
    return { file, bytes: bytes.length, sha256 };
  }
}

/** A host as a function: any number of folders, each below a path of its own. */
export class Host {
  readonly requests: { readonly path: string; readonly query: string; readonly range: string | null }[] = [];
  /** Whether it waits for news where it is asked to. */
  waits = false;
  /** Every request fails like this, while it does. */
  trouble: "offline" | number | undefined;
  /** Of a file; without it at once. */
  bytesPerSecond: number | undefined;
  /** What is there instead of a folder's own file. */
  readonly instead = new Map<string, Uint8Array>();

  constructor(readonly folders: Readonly<Record<string, Pick<LiveRun, "files" | "sequence" | "live">>>) {}

  asked(name: string): number {
    return this.requests.filter(({ path }) => path.includes(name)).length;
  }

  readonly fetch = async (input: RequestInfo | URL, init?: RequestInit): Promise<Response> => {
    const { pathname, search, searchParams } = new URL(String(input));
    const range = new Headers(init?.headers).get("Range");
    this.requests.push({ path: pathname, query: search, range });
    await new Promise((resolve) => setTimeout(resolve, 0));
    init?.signal?.throwIfAborted();
    if (this.trouble === "offline") throw new TypeError("fetch failed");
    if (this.trouble !== undefined) return new Response("", { status: this.trouble });
    const [, folder, name] = /^\/(?:(.*)\/)?([^/]*)$/.exec(pathname)!;
    const run = this.folders[folder ?? ""];
    const after = Number(searchParams.get("after") ?? -1);
    const isManifest = name === "manifest.json";
    while (this.waits && isManifest && run && run.sequence <= after && run.live) {
      await new Promise((resolve) => setTimeout(resolve, 2));
      init?.signal?.throwIfAborted();
    }
    const bytes = this.instead.get(pathname) ?? run?.files.get(name!);
    if (!bytes) return new Response("", { status: 404 });
    const etag = `"${createHash("sha256").update(bytes).digest("hex").slice(0, 12)}"`;
    if (new Headers(init?.headers).get("If-None-Match") === etag) return new Response(null, { status: 304 });
    const found = /^bytes=(\d+)-(\d*)$/.exec(range ?? "");
    if (!found) return new Response(bytes.slice(), { headers: { ETag: etag } });
    const start = Number(found[1]);
    const end = found[2] ? Math.min(Number(found[2]) + 1, bytes.length) : bytes.length;
    if (start >= bytes.length) return new Response("", { status: 416 });
    const headers = { "Content-Range": `bytes ${start}-${end - 1}/${bytes.length}` };
    return new Response(this.body(bytes.slice(start, end)), { status: 206, headers });
  };

  private body(bytes: Uint8Array<ArrayBuffer>): BodyInit {
    let at = 0;
    return new ReadableStream({
      pull: async (controller) => {
        const { bytesPerSecond } = this;
        if (bytesPerSecond !== undefined) await new Promise((resolve) => setTimeout(resolve, 20));
        const next = at + Math.max(Math.round((bytesPerSecond ?? Number.POSITIVE_INFINITY) / 50), 1);
        controller.enqueue(bytes.slice(at, next));
        at = next;
        if (at >= bytes.length) controller.close();
      },
    });
  }
}
