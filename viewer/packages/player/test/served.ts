// SPDX-License-Identifier: Apache-2.0
/** Streams as tests see them: a server that is a function, and an engine with its workers in this very thread. */

import { readFileSync } from "node:fs";
import { type FieldName, readStream, type Tensor } from "@structgstream/core";
import { afterEach } from "vitest";
import { expectSame } from "../../core/test/streams.ts";
import { Decoding } from "../src/decode/decoding.ts";
import type { FromDecoder, ToDecoder } from "../src/decode/messages.ts";
import { Engine } from "../src/engine/engine.ts";
import type { Sound } from "../src/sound/sound.ts";
import type { ReadReply, ReadRequest } from "../src/source/description.ts";
import { Fetcher } from "../src/source/fetcher.ts";
import type { Port } from "../src/source/port.ts";
import type { RetryPolicy } from "../src/source/retryPolicy.ts";

export const CLIP = new Uint8Array(readFileSync(new URL("./fixtures/clip.sgs", import.meta.url)));
export const URL_OF_CLIP = "http://test/clip.sgs";

export const QUICK: RetryPolicy = {
  retries: [0.01, 0.01],
  firstPoll: 0.01,
  longestPoll: 0.02,
  backOff: 1.4,
  stillAfter: 0.2,
};

/** A file on a server; `bytes` may be replaced by longer ones. */
export class ServedFile {
  readonly requests: [start: number, end: number][] = [];
  ranges = true;
  status: number | undefined;
  /** Answers fail so many times. */
  failures = 0;
  lastModified = new Date().toUTCString();
  chunkBytes = 5000;
  /** Most bytes of an answer to a request for a range. */
  mostBytes = Number.POSITIVE_INFINITY;
  /** Bytes from this one on do not arrive until it is raised. */
  heldFrom = Number.POSITIVE_INFINITY;

  constructor(public bytes: Uint8Array) {}

  readonly fetch = async (_: RequestInfo | URL, init?: RequestInit): Promise<Response> => {
    await new Promise((resolve) => setTimeout(resolve, 0));
    init?.signal?.throwIfAborted();
    if (this.failures > 0) {
      this.failures--;
      throw new TypeError("fetch failed");
    }
    if (this.status !== undefined) return new Response("", { status: this.status });
    const range = /^bytes=(\d+)-(\d*)$/.exec(new Headers(init?.headers).get("Range") ?? "");
    const size = this.bytes.length;
    const headers = { "Last-Modified": this.lastModified, Date: new Date().toUTCString() };
    if (!range || !this.ranges) {
      this.requests.push([0, size]);
      return new Response(this.body(0, size), { headers: { ...headers, "Content-Length": `${size}` } });
    }
    const start = Number(range[1]);
    const end = Math.min(range[2] ? Number(range[2]) + 1 : size, size, start + this.mostBytes);
    this.requests.push([start, end]);
    if (start >= size) {
      return new Response("", { status: 416, headers: { ...headers, "Content-Range": `bytes */${size}` } });
    }
    const found = { ...headers, "Content-Range": `bytes ${start}-${end - 1}/${size}` };
    return new Response(this.body(start, end), { status: 206, headers: found });
  };

  private body(start: number, end: number): ReadableStream<Uint8Array> {
    let at = start;
    let cancelled = false;
    const { bytes, chunkBytes } = this;
    return new ReadableStream({
      pull: async (controller) => {
        do await new Promise((resolve) => setTimeout(resolve, 0));
        while (!cancelled && at < end && at >= this.heldFrom);
        if (cancelled) return;
        if (at >= end) return controller.close();
        const next = Math.min(at + chunkBytes, end, this.heldFrom);
        controller.enqueue(bytes.slice(at, next));
        at = next;
      },
      cancel: () => {
        cancelled = true;
      },
    });
  }
}

/** An engine whose clock moves only when a test says so. */
export interface Playing {
  readonly engine: Engine;
  readonly errors: string[];
  readonly notices: string[];
  /** Frames given by `tick`, in order. */
  readonly shown: number[];
  /** Those that came with another header. */
  readonly headers: number[];
  /** What was given adds up to these, since the last header. */
  readonly fields: Map<FieldName, Tensor>;
  seconds: number;
  /** Decoded frames do not reach the engine until the function that it gives back is called. */
  holdFrames(): () => void;
  /** Ticks, letting workers work in between, until `reached`. */
  until(reached: () => boolean, what?: string): Promise<void>;
  /** Until the stream is there and nothing is sought; what was found has been given. */
  settled(): Promise<void>;
  /** Plays on to the end, so many seconds a tick. */
  toEnd(step?: number): Promise<void>;
  /** Seeks to a frame of the clip, and compares what is given with it. */
  seeksExactly(index: number): Promise<void>;
  close(): void;
}

export interface PlayingOptions {
  /** Of stored packets. */
  readonly budgetBytes?: number;
  readonly sound?: Sound;
}

let open: Playing[] = [];

afterEach(() => {
  for (const play of open) play.close();
  open = [];
});

/** Compares what was given with a frame of the clip. */
export function expectClip({ fields }: Playing, index: number): void {
  const reader = readStream(CLIP);
  const expected = reader.frame(index).fields;
  for (const name of reader.header!.dynamic) expectSame(fields.get(name), expected.get(name)!);
}

/** An engine that opens a file, which is closed after the test. */
export function playingFile(file: ServedFile, startSeconds = 0, options: PlayingOptions = {}): Playing {
  const play = playing(file.fetch as typeof fetch, options);
  play.engine.load({ kind: "url", url: URL_OF_CLIP, name: "clip.sgs" }, startSeconds);
  return play;
}

export function playing(request: typeof fetch, options: PlayingOptions = {}): Playing {
  const [engineLine, fetchLine] = [new MessageChannel(), new MessageChannel()];
  new Fetcher(fetchLine.port1 as unknown as Port<ReadReply, ReadRequest>, request, QUICK);
  new Decoding(
    engineLine.port1 as unknown as Port<FromDecoder, ToDecoder>,
    fetchLine.port2 as unknown as Port<ReadRequest, ReadReply>,
    () => new Promise((resolve) => setImmediate(resolve)),
    options.budgetBytes,
  );
  const pipeline = {
    onmessage: undefined as ((message: FromDecoder) => void) | undefined,
    send: (message: ToDecoder) => engineLine.port2.postMessage(message),
    close: () => {
      for (const { port1, port2 } of [engineLine, fetchLine]) {
        port1.close();
        port2.close();
      }
    },
  };
  let held: FromDecoder[] | undefined;
  engineLine.port2.onmessage = ({ data }: MessageEvent<FromDecoder>) => {
    if (held && data.type === "frame") held.push(data);
    else pipeline.onmessage?.(data);
  };
  const found: Playing = {
    engine: new Engine(pipeline, () => found.seconds, options.sound),
    errors: [],
    notices: [],
    shown: [],
    headers: [],
    fields: new Map(),
    seconds: 100,
    async until(reached, what = "what was waited for") {
      const give = performance.now() + 50_000;
      while (!reached()) {
        if (performance.now() > give) throw new Error(`In 50 s there was no ${what}; errors: ${found.errors}`);
        found.engine.tick();
        await new Promise((resolve) => setTimeout(resolve, 1));
      }
    },
    holdFrames() {
      const late: FromDecoder[] = [];
      held = late;
      return () => {
        held = undefined;
        for (const message of late) pipeline.onmessage?.(message);
      };
    },
    async settled() {
      await found.until(() => found.engine.frames.count > 0 && !found.engine.seeking, "frame that was sought");
      found.engine.tick();
    },
    toEnd(step = 1 / 60) {
      return found.until(() => {
        found.seconds += step;
        return found.engine.ended;
      }, "end");
    },
    async seeksExactly(index) {
      found.engine.seekFrame(index);
      await found.until(() => !found.engine.seeking && found.shown.at(-1) === index, `frame ${index}`);
      expectClip(found, index);
    },
    close: () => found.engine.destroy(),
  };
  open.push(found);
  const tick = found.engine.tick.bind(found.engine);
  found.engine.tick = () => {
    const update = tick();
    if (update?.header) {
      found.headers.push(update.index);
      found.fields.clear();
    }
    for (const [name, tensor] of update?.fields ?? []) found.fields.set(name, tensor);
    return update;
  };
  found.engine.on("error", ({ message }) => found.errors.push(message));
  found.engine.on("notice", ({ message }) => found.notices.push(message));
  found.engine.on("frame", ({ index }) => found.shown.push(index));
  return found;
}
