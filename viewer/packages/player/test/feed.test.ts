// SPDX-License-Identifier: Apache-2.0
/** Following a manifest: what hosts are asked, and how often. */

import { afterEach, beforeEach, expect, test, vi } from "vitest";
import { ManifestFeed } from "../src/source/manifestFeed.ts";
import { RETRY_POLICY } from "../src/source/retryPolicy.ts";
import { LiveRun } from "./liveRun.ts";
import { CLIP } from "./served.ts";

interface Asked {
  readonly at: number;
  readonly after: string | null;
  readonly match: string | null;
}

beforeEach(() => {
  vi.useFakeTimers({ toFake: ["setTimeout", "clearTimeout", "performance"] });
});

afterEach(() => {
  vi.useRealTimers();
});

/** Follows for so many seconds; `answer` is what the host says to each request. */
async function followed(
  seconds: number,
  own: boolean,
  answer: (asked: Asked, signal: AbortSignal) => Response | Promise<Response>,
) {
  const asked: Asked[] = [];
  const log: string[] = [];
  const began = performance.now();
  const request = async (input: RequestInfo | URL, init?: RequestInit): Promise<Response> => {
    const headers = new Headers(init?.headers);
    const after = new URL(String(input)).searchParams.get("after");
    asked.push({ at: (performance.now() - began) / 1000, after, match: headers.get("If-None-Match") });
    return answer(asked.at(-1)!, init!.signal!);
  };
  const feed = new ManifestFeed("http://test/m.json?x=1", "m.json", request as typeof fetch, false, own, RETRY_POLICY);
  const abort = new AbortController();
  const events = {
    manifest: ({ sequence }: { sequence: number }) => void log.push(`manifest ${sequence}`),
    qualities: () => void log.push("qualities"),
    waiting: (wait: number, problem: string) => void log.push(`waiting ${wait}: ${problem}`),
    recovered: () => void log.push("recovered"),
  };
  const done = feed.follow(events, abort.signal).catch((error: Error) => void log.push(`failed: ${error.message}`));
  await vi.advanceTimersByTimeAsync(seconds * 1000);
  abort.abort();
  await vi.advanceTimersByTimeAsync(60_000);
  await done;
  return { asked, log };
}

const bodyOf = (live: LiveRun) => live.files.get("manifest.json")!.slice();
const wait = (seconds: number) => new Promise((resolve) => setTimeout(resolve, 1000 * seconds));

test("a host that does not wait is asked a few times a frame, and less often when none comes for long", async () => {
  const live = new LiveRun(CLIP, { frameSeconds: 4 }).write(3);
  const { asked, log } = await followed(60, true, () => new Response(bodyOf(live), { headers: { ETag: '"1"' } }));
  expect(log).toEqual(["manifest 3"]);
  expect(asked.slice(0, 3).map(({ after, match }) => [after, match])).toEqual([
    [null, null],
    ["3", '"1"'],
    ["3", '"1"'],
  ]);
  const gaps = asked.slice(1).map(({ at }, i) => at - asked[i]!.at);
  expect(Math.max(...gaps.slice(0, 10))).toBeLessThanOrEqual(1.001);
  expect(Math.min(...gaps)).toBeGreaterThanOrEqual(0.5);
  expect(gaps.at(-1)!).toBeCloseTo(10);
  expect(asked.length).toBeLessThan(25);
});

test("a host that waits is asked again at once, and no more often", async () => {
  const live = new LiveRun(CLIP, { frameSeconds: 4 }).write(3);
  const { asked, log } = await followed(30, true, async ({ after }) => {
    if (after !== null) await wait(4);
    if (after !== null) live.write(1);
    return new Response(bodyOf(live));
  });
  expect(log.slice(0, 3)).toEqual(["manifest 3", "manifest 4", "manifest 5"]);
  expect(asked.length).toBe(9);
});

test("another origin is asked without headers that it would have to allow", async () => {
  const live = new LiveRun(CLIP).write(3);
  const { asked } = await followed(3, false, () => new Response(bodyOf(live), { headers: { ETag: '"1"' } }));
  expect(asked.length).toBeGreaterThan(2);
  expect(asked.every(({ match }) => match === null)).toBe(true);
});

test("nothing new, older manifests of a cache, and trouble", async () => {
  const live = new LiveRun(CLIP).write(3);
  const old = bodyOf(live);
  live.write(2);
  const answers: (() => Response)[] = [
    () => new Response(bodyOf(live)),
    () => new Response(null, { status: 304 }),
    () => new Response(old.slice()),
    () => new Response("", { status: 500 }),
    () => new Response("{"),
    () => new Response(bodyOf(live.write(1))),
    () => new Response(bodyOf(live.finish())),
  ];
  const { log } = await followed(60, true, () => answers.shift()!());
  expect(log).toEqual([
    "manifest 5",
    "waiting 0.5: The server answered the request for m.json with 500.",
    "waiting 1: m.json is no JSON: it was cut or changed, or is something else.",
    "recovered",
    "manifest 6",
    "manifest 7",
  ]);
});

test("after its end a run is asked for now and then for half an hour, as it may be resumed", async () => {
  const live = new LiveRun(CLIP).write(3);
  const answers = [() => new Response(bodyOf(live)), () => new Response(bodyOf(live.finish()))];
  const gone = () => new Response("", { status: 503 });
  const { asked, log } = await followed(3600, true, () => (answers.shift() ?? gone)());
  expect(log).toEqual(["manifest 3", "manifest 4"]);
  expect(asked.at(-1)!.at).toBeGreaterThan(1780);
  expect(asked.at(-1)!.at).toBeLessThan(1820);
  expect(asked.length).toBeLessThan(190);
  const recording = await followed(60, true, () => new Response(bodyOf(live)));
  expect(recording.asked.length).toBe(1);
});

test("a host that does not answer for hours is asked every 10 s, and playback continues", async () => {
  const live = new LiveRun(CLIP).write(3);
  const { asked, log } = await followed(2 * 3600 + 60, true, ({ at, after }) => {
    if (after !== null && at < 2 * 3600) return new Response("", { status: 503 });
    if (after !== null) live.write(1);
    return new Response(bodyOf(live));
  });
  expect(log.slice(-3)[0]).toMatch(/^manifest/);
  expect(log.filter((text) => text.startsWith("failed"))).toEqual([]);
  expect(log).toContain("recovered");
  const gaps = asked.slice(1, 700).map(({ at }, i) => at - asked[i]!.at);
  expect(Math.max(...gaps)).toBeCloseTo(10);
});

test("a host that never answers is given up for this time", async () => {
  const live = new LiveRun(CLIP).write(3);
  const { log } = await followed(50, true, ({ after }, signal) => {
    if (after === null) return new Response(bodyOf(live));
    return new Promise((_, refuse) => signal.addEventListener("abort", () => refuse(new Error("aborted"))));
  });
  expect(log.join()).toContain("The server has not answered the request for m.json for 45 s.");
});

test("a manifest without an end is not read on", async () => {
  const { log } = await followed(5, true, () => new Response(new Uint8Array(2 ** 22 + 1)));
  expect(log).toEqual(["failed: m.json has more than 4194304 bytes, which no manifest has."]);
});

test("the first manifest must be one", async () => {
  const { log, asked } = await followed(5, true, () => new Response("", { status: 404 }));
  expect(log).toEqual(["failed: m.json was not found on the server (404). Check the address."]);
  expect(asked.length).toBe(1);
});
