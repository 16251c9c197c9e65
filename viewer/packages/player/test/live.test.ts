// SPDX-License-Identifier: Apache-2.0
/** Live streams from segments folders: engine, decoder and fetcher together, without a browser. */

import { existsSync, readdirSync, readFileSync } from "node:fs";
import { HEAD_BYTES } from "@structgstream/core";
import { afterEach, describe, expect, test, vi } from "vitest";
import { PREFIX_BYTES } from "../../core/src/records.ts";
import { AbrController } from "../src/decode/abrController.ts";
import { Throughput } from "../src/decode/throughput.ts";
import { Host, LiveRun, type RunOptions } from "./liveRun.ts";
import { CLIP, type Playing, playing } from "./served.ts";

vi.setConfig({ testTimeout: 60_000 });

const ADDRESS = "http://test/manifest.json";

afterEach(() => void vi.restoreAllMocks());

function run(frames: number, options: RunOptions = {}): LiveRun {
  return new LiveRun(CLIP, options).write(frames);
}

function opened(host: Host, startSeconds?: number, url = ADDRESS, own = true, options = {}): Playing {
  const found = playing(host.fetch as typeof fetch, options);
  found.engine.load({ kind: "segments", url, name: "manifest.json", own }, startSeconds);
  return found;
}

/** Time goes on: the clock's, and with a run that of the run, which is slower because hosts and workers take real time. */
function goingOn(play: Playing, live?: LiveRun): () => boolean {
  let due = play.seconds;
  return () => {
    play.seconds += live ? 1 / 240 : 1 / 60;
    for (; live && play.seconds >= due; due += 1 / 30) live.write(1);
    return true;
  };
}

/** So many ticks, in each of which workers may work. */
function ticks(play: Playing, count: number, on: () => boolean = () => true): Promise<void> {
  let left = count;
  return play.until(() => on() && left-- <= 0);
}

test("begins with the last key frame that is far enough behind the edge", async () => {
  const host = new Host({ "": run(40, { targetSeconds: 0.5 }) });
  const play = opened(host);
  await play.settled();
  // The edge is frame 39, at 1.3 s; keys are every three frames.
  expect(play.engine.frames.count).toBe(40);
  expect(play.shown).toEqual([24]);
  expect(play.engine.edge.following).toBe(true);
  expect(play.engine.behindSeconds).toBeCloseTo(0.5, 1);
  // Nothing was fetched but what is needed for that.
  expect(host.asked("init-")).toBe(1);
  expect(host.asked("segment-")).toBe(1);
  expect(host.asked("part-")).toBe(0);
  expect(play.errors).toEqual([]);
});

test("frames are exact, those of parts too", async () => {
  const live = run(10, { frameSeconds: 4 });
  const play = opened(new Host({ "": live }), 0);
  await play.settled();
  for (const index of [0, 9, 4, 9, 2]) await play.seeksExactly(index);
});

test.each([true, false])("keeps to the edge of a stream at full speed, waiting host: %s", async (waits) => {
  const live = run(30);
  const host = new Host({ "": live });
  host.waits = waits;
  const play = opened(host);
  await play.settled();
  play.engine.play();
  const on = goingOn(play, live);
  await play.until(() => on() && play.shown.at(-1)! > 90, "frames");
  expect(play.shown).toEqual([...play.shown].sort((a, b) => a - b));
  expect(play.engine.edge.following).toBe(true);
  expect(play.engine.behindSeconds).toBeLessThan(5);
  expect(play.errors).toEqual([]);
});

test("a stream slower than its media: each frame when it comes, and when the next one will", async () => {
  const live = run(8, { frameSeconds: 4 });
  const play = opened(new Host({ "": live }));
  play.engine.play();
  const on = goingOn(play);
  await play.until(() => on() && play.shown.at(-1) === 7, "edge");
  // It begins with the last key frame.
  expect(play.shown[0]).toBe(6);
  await play.until(() => on() && play.engine.stalled, "stall");
  for (const frame of [8, 9, 10]) {
    live.write(1);
    await play.until(() => on() && play.shown.at(-1) === frame, `frame ${frame}`);
  }
  expect(play.engine.edge.grows).toBe(true);
  expect(play.engine.nextFrameSeconds).toBeGreaterThan(2);
  expect(play.engine.nextFrameSeconds).toBeLessThanOrEqual(4);
  expect(play.errors).toEqual([]);
});

test("frames at intervals of seconds are shown as soon as they are there", async () => {
  const live = run(8, { fps: 0.5, frameSeconds: 2, targetSeconds: 6 });
  const play = opened(new Host({ "": live }));
  play.engine.play();
  const on = goingOn(play);
  await play.until(() => on() && play.shown.at(-1) === 7, "newest frame");
  for (const frame of [8, 9, 10]) {
    await play.until(() => on() && play.engine.stalled, "stall");
    const before = play.seconds;
    live.write(1);
    await play.until(() => on() && play.shown.at(-1) === frame, `frame ${frame}`);
    // Its turn by the media would have been two seconds after the one before.
    expect(play.seconds - before).toBeLessThan(1.5);
  }
  expect(play.notices).toEqual([]);
  expect(play.errors).toEqual([]);
});

test("frames that are decoded before the page has heard of them are no reason to go back to their key frame", async () => {
  const live = run(8, { fps: 0.5, frameSeconds: 2, targetSeconds: 6 });
  const play = opened(new Host({ "": live }));
  play.engine.play();
  const on = goingOn(play);
  await play.until(() => on() && play.shown.at(-1) === 7, "newest frame");
  // The decoder learns of both at once, and the page, which is informed ten times a second, of the second one later.
  for (let frame = 8; frame < 26; frame += 2) {
    live.write(1);
    await play.until(() => on() && play.shown.at(-1) === frame, `frame ${frame}`);
    live.write(1);
    await play.until(() => on() && play.shown.at(-1) === frame + 1, `frame ${frame + 1}`);
  }
  expect(play.shown).toEqual([...play.shown].sort((a, b) => a - b));
  expect(play.errors).toEqual([]);
});

test("who is far behind jumps to a key frame, who is a little behind goes a little faster", async () => {
  const live = run(60);
  const play = opened(new Host({ "": live }));
  await play.settled();
  play.engine.play();
  const on = goingOn(play, live);
  await play.until(() => on() && play.shown.length > 10, "frames");
  live.write(60); // two seconds at once
  await play.until(() => play.engine.frames.count >= 120);
  const from = play.engine.currentTime;
  const at = play.seconds;
  await play.until(() => on() && play.engine.currentTime > from + 2, "two seconds");
  expect((play.engine.currentTime - from) / (play.seconds - at)).toBeGreaterThan(1.03);
  expect((play.engine.currentTime - from) / (play.seconds - at)).toBeLessThan(1.12);
  expect(play.notices).toEqual([]);
  live.write(600);
  await play.until(() => on() && play.notices.length > 0, "jump");
  expect(play.notices[0]).toContain("continues with the newest frames");
  await play.until(() => on() && !play.engine.seeking && play.shown.at(-1)! > 600, "edge");
  expect(play.engine.behindSeconds).toBeLessThan(5);
});

test("who plays up to the edge follows it", async () => {
  const live = run(12, { frameSeconds: 2 });
  const play = opened(new Host({ "": live }), 0);
  play.engine.play();
  await play.settled();
  expect(play.engine.edge.following).toBe(false);
  const on = goingOn(play);
  await play.until(() => on() && play.engine.stalled && play.shown.at(-1) === 11, "edge");
  expect(play.engine.edge.following).toBe(true);
});

test("scrubbing back leaves the edge, and LIVE goes back to it", async () => {
  const live = run(90, { pageSegments: 4 });
  const host = new Host({ "": live });
  const play = opened(host);
  await play.settled();
  play.engine.play();
  expect(host.asked("history-")).toBe(0);
  play.engine.seek(0.5);
  await play.until(() => play.shown.at(-1) === 15, "frame 15");
  expect(host.asked("history-")).toBeGreaterThan(0);
  expect(play.engine.edge.following).toBe(false);
  const on = goingOn(play, live);
  await play.until(() => on() && play.shown.at(-1)! >= 40, "frames");
  expect(play.engine.behindSeconds).toBeGreaterThan(1);
  expect(play.engine.playbackRate).toBe(1);
  play.engine.goLive();
  await play.until(
    () => on() && !play.engine.seeking && play.engine.behindSeconds < play.engine.edge.distance + 1,
    "edge",
  );
  expect(play.engine.edge.following).toBe(true);
  expect(play.errors).toEqual([]);
});

test("every frame of a long recording can be reached over pages of pages", async () => {
  const live = run(240, { pageSegments: 3 }).finish();
  const host = new Host({ "": live });
  const play = opened(host);
  await play.settled();
  // A run that is over is a recording: from its first frame.
  expect(play.shown).toEqual([0]);
  expect(play.engine.edge.grows).toBe(false);
  for (const index of [239, 100, 17, 181, 3]) {
    play.engine.seekFrame(index);
    await play.until(() => play.shown.at(-1) === index, `frame ${index}`);
  }
  play.engine.seekFrame(225);
  play.engine.play();
  await play.toEnd();
  expect(play.shown.at(-1)).toBe(239);
  expect(play.errors).toEqual([]);
});

test("playback continues after what has left the window", async () => {
  const live = run(30, { windowSegments: 8 });
  const play = opened(new Host({ "": live }));
  await play.settled();
  play.engine.seek(0);
  expect(play.engine.frames.first).toBe(3);
  await play.until(() => play.shown.at(-1) === 3, "oldest frame");
  live.write(30);
  play.engine.play();
  const on = goingOn(play);
  await play.until(() => on() && play.shown.at(-1)! >= 33, "a frame of the window");
  expect(play.notices.join()).toContain("no longer has this part");
  expect(play.errors).toEqual([]);
});

test("the end of the run makes it a recording", async () => {
  const live = run(20);
  const play = opened(new Host({ "": live }));
  play.engine.play();
  const on = goingOn(play);
  await play.until(() => on() && play.shown.at(-1) === 19, "edge");
  expect(play.engine.ended).toBe(false);
  live.finish();
  await play.until(() => on() && play.engine.ended, "end");
  expect(play.notices).toEqual(["The stream has ended; it is a recording now."]);
  expect(play.engine.edge.live).toBe(false);
  play.engine.play();
  await play.until(() => play.shown.at(-1) === 0, "first frame");
});

test("a run that is resumed after its end is followed again", async () => {
  const live = run(21);
  const play = opened(new Host({ "": live }));
  play.engine.play();
  const on = goingOn(play);
  await play.until(() => on() && play.shown.at(-1) === 20, "edge");
  live.finish();
  await play.until(() => on() && play.engine.ended, "end");
  live.resume().write(3);
  await play.until(() => on() && play.shown.at(-1) === 23, "newest frame");
  expect(play.notices).toEqual(["The stream has ended; it is a recording now.", "The stream continues."]);
  expect(play.engine.edge.following).toBe(true);
  expect(play.errors).toEqual([]);
});

test("how long ago a picture was filmed is known by the newest frame", async () => {
  const live = run(4);
  live.changed = { edge: { frame: 4, pts_seconds: 4 / 30, captured_unix_seconds: 1000, published_unix_seconds: 1001 } };
  live.write(1);
  const play = opened(new Host({ "": live }));
  await play.settled();
  expect(play.engine.frames.live?.filmedAtZero).toBeCloseTo(1000 - 4 / 30, 9);
});

describe("a host in trouble", () => {
  test.each(["offline", 503, 404] as const)("%s for a while is reported once", async (trouble) => {
    const live = run(12, { frameSeconds: 1 });
    const host = new Host({ "": live });
    const play = opened(host);
    play.engine.play();
    const on = goingOn(play);
    await play.until(() => on() && play.shown.at(-1) === 11 && play.engine.stalled, "edge");
    host.trouble = trouble;
    live.write(9);
    await play.until(() => on() && play.notices.length > 0, "notice");
    await ticks(play, 50, on);
    expect(play.notices.length).toBe(1);
    expect(play.notices[0]).toContain("The next attempt is in");
    host.trouble = undefined;
    await play.until(() => on() && play.shown.at(-1) === 20, "newest frame");
    expect(play.notices.at(-1)).toBe("The stream can be reached again.");
    expect(play.errors).toEqual([]);
  });

  test("a file that is another costs its group, and is reported", async () => {
    const live = run(30, {}).finish();
    const host = new Host({ "": live });
    const bad = [...live.files.keys()].find((name) => name.startsWith("segment-00000003"))!;
    host.instead.set(`/${bad}`, new Uint8Array(live.files.get(bad)!.length));
    const play = opened(host, 0.2);
    await play.settled();
    play.engine.play();
    await play.toEnd();
    expect(play.shown.filter((index) => index >= 9 && index < 12)).toEqual([]);
    expect(play.errors.length).toBeGreaterThan(0);
    expect(play.errors.join()).toMatch(/Frames? 9.* lost/);
  });

  test("a file that is not there is asked for again, and then reported", async () => {
    const live = run(30, {}).finish();
    const host = new Host({ "": live });
    const gone = [...live.files.keys()].find((name) => name.startsWith("segment-00000003"))!;
    live.files.delete(gone);
    const play = opened(host, 0.2);
    await play.settled();
    play.engine.play();
    await play.toEnd();
    expect(host.asked(gone)).toBe(3);
    expect(play.errors).toEqual([
      `Frames 9 to 11 are lost: ${gone} was not found on the server (404). Check the address.`,
    ]);
  });

  test.each([
    { manifest: "prompt", requests: 1 },
    { manifest: "late", requests: 5 },
  ])("a part that became a segment is taken from there, with a $manifest manifest", async ({ manifest, requests }) => {
    const live = run(13, { frameSeconds: 1 });
    const host = new Host({ "": live });
    const part = live.newest("part-");
    const play = opened(host, 0);
    await play.settled();
    live.files.delete(part);
    if (manifest === "late") host.instead.set("/manifest.json", live.files.get("manifest.json")!);
    play.engine.seekFrame(12);
    await play.until(() => host.asked(part) >= requests, "requests");
    expect(play.errors).toEqual([]);
    live.write(4);
    host.instead.delete("/manifest.json");
    await play.until(() => play.shown.at(-1) === 12, "frame 12");
    expect(play.errors).toEqual([]);
  });

  test("a replaced stream is reported", async () => {
    const live = run(10);
    const host = new Host({ "": live });
    const play = opened(host);
    await play.settled();
    const other = new LiveRun(CLIP.slice());
    other.sequence = 100;
    other.write(3);
    const text = new TextDecoder().decode(other.files.get("manifest.json")!);
    const sha256 = /"sha256":"([\da-f]{64})","period":0/.exec(text)![1]!;
    host.instead.set("/manifest.json", new TextEncoder().encode(text.replace(sha256, "0".repeat(64))));
    await play.until(() => play.errors.length > 0, "error");
    expect(play.errors[0]).toContain("it was replaced. Load it again");
  });
});

test("periods are crossed without a break, in both directions", async () => {
  const live = run(12, { frameSeconds: 1 / 30 });
  live.begin(CLIP);
  live.write(12).finish();
  const host = new Host({ "": live });
  const play = opened(host, 0);
  await play.settled();
  const stalls: boolean[] = [];
  play.engine.on("stall", ({ stalled }) => stalls.push(stalled));
  play.engine.play();
  await play.until(() => (play.engine.stored.times.at(-1)?.[1] ?? 0) > 0.7, "buffer");
  await play.toEnd();
  expect(play.shown.filter((index, i) => index !== play.shown[i - 1]).slice(-3)).toEqual([21, 22, 23]);
  expect(play.headers).toEqual([12]);
  expect(stalls).toEqual([]);
  await play.seeksExactly(5);
  expect(play.headers).toEqual([12, 3]);
  expect(host.asked("init-0000")).toBe(1);
  expect(host.asked("init-0001")).toBe(1);
});

describe("an init record that cannot be had costs its period", () => {
  /** A stream whose init record has the right checksum, and states a longer description than it holds. */
  const unreadable = CLIP.slice();
  new DataView(unreadable.buffer).setUint32(PREFIX_BYTES + HEAD_BYTES, 2 ** 31, true);

  test.each([
    { problem: "missing", period: 0, requests: 3, reason: /not found on the server/ },
    { problem: "missing", period: 1, requests: 3, reason: /not found on the server/ },
    { problem: "another", period: 1, requests: 3, reason: /not the file that the manifest states/ },
    { problem: "unreadable", period: 1, requests: 1, reason: /longer description than it holds/ },
  ])("of period $period of a recording: $problem", async ({ problem, period, requests, reason }) => {
    const live = run(12);
    for (const next of [1, 2]) {
      live.begin(next === period && problem === "unreadable" ? unreadable : CLIP);
      live.write(12);
    }
    live.finish();
    const host = new Host({ "": live });
    const file = [...live.files.keys()].find((name) => name.startsWith(`init-000${period}`))!;
    if (problem === "missing") live.files.delete(file);
    else if (problem === "another") host.instead.set(`/${file}`, new Uint8Array(live.files.get(file)!.length));
    // Not all of a period is fetched in advance.
    const play = opened(host, 0, ADDRESS, true, { budgetBytes: 4000 });
    await play.settled();
    play.engine.play();
    await play.toEnd();
    const [first, end] = [12 * period, 12 * period + 12];
    expect(play.errors.length).toBe(1);
    expect(play.errors[0]).toMatch(new RegExp(`^Frames ${first} to ${end - 1} are lost: `));
    expect(play.errors[0]).toMatch(reason);
    expect(play.shown.filter((index) => index >= first && index < end)).toEqual([]);
    expect(play.shown.at(-1)).toBe(35);
    expect(host.asked(file)).toBe(requests);
  });

  test("of a period without a frame: requested once a second", async () => {
    const live = run(6);
    live.begin(unreadable);
    live.write(0);
    const host = new Host({ "": live });
    const play = opened(host, 0);
    play.engine.play();
    await play.until(() => host.asked("init-0001") > 0, "request");
    await ticks(play, 300, goingOn(play));
    expect(host.asked("init-0001")).toBeLessThan(4);
    expect(play.errors).toEqual([]);
  });

  test.each(["missing", "unreadable"])(
    "of a live stream, where later frames have another chance: %s",
    async (problem) => {
      const live = run(6);
      live.begin(problem === "unreadable" ? unreadable : CLIP);
      live.write(3);
      const host = new Host({ "": live });
      const file = live.newest("init-0001");
      const bytes = live.files.get(file)!;
      if (problem === "missing") live.files.delete(file);
      const play = opened(host, 0);
      play.engine.play();
      const on = goingOn(play);
      let count = 0;
      const grows = () => {
        if (++count % 300 === 0) live.write(1);
        return on();
      };
      await play.until(() => grows() && play.errors.length > 0, "loss");
      expect(play.errors[0]).toMatch(/^Frames 6 to \d+ are lost: /);
      await ticks(play, 1000, grows);
      expect(play.shown.at(-1)).toBe(5);
      expect(host.asked(file)).toBeLessThan(10);
      expect(new Set(play.errors).size).toBe(play.errors.length);
      if (problem === "unreadable") return;
      live.files.set(file, bytes);
      await play.until(() => grows() && play.shown.at(-1)! > 5, "later frames");
    },
  );
});

test("a page that cannot be had costs its frames", async () => {
  const live = run(90, { pageSegments: 4 }).finish();
  const host = new Host({ "": live });
  const gone = [...live.files.keys()].filter((name) => name.startsWith("history-"))[1]!;
  live.files.delete(gone);
  const play = opened(host, 0);
  await play.settled();
  play.engine.play();
  await play.toEnd();
  expect(play.errors).toEqual([
    `Frames 12 to 23 are lost: ${gone} was not found on the server (404). Check the address.`,
  ]);
  expect(host.asked(gone)).toBe(3);
  expect(play.shown.at(-1)).toBe(89);
});

test("memory is bounded: packets that are far away are dropped", async () => {
  const live = run(180, { pageSegments: 8 }).finish();
  const play = opened(new Host({ "": live }), 0, ADDRESS, true, { budgetBytes: 20_000 });
  await play.settled();
  play.engine.play();
  const on = goingOn(play);
  let most = 0;
  play.engine.on("progress", ({ buffered }) => {
    most = Math.max(
      most,
      buffered.reduce((sum, [start, end]) => sum + (end - start) * 30, 0),
    );
  });
  await play.until(() => on() && play.engine.ended, "end");
  expect(play.errors).toEqual([]);
  expect(most).toBeLessThan(100);
});

describe("qualities", () => {
  const LIST = "http://test/qualities.json";
  const listed = (entries: unknown[]) =>
    new TextEncoder().encode(JSON.stringify({ format: "structgstream-qualities", version: 1, qualities: entries }));
  const ENTRIES = [
    { manifest: "high/manifest.json", bits_per_second: 4e6, name: "high" },
    { manifest: "low/manifest.json", bits_per_second: 2e5, name: "low" },
  ];

  test("of one stream: begins low, goes up at a key frame, keeps frame numbers", async () => {
    const [high, low] = [run(60).finish(), run(60).finish()];
    const host = new Host({ high, low });
    host.instead.set("/qualities.json", listed(ENTRIES));
    const play = opened(host, 0, LIST);
    await play.settled();
    expect(play.engine.qualities).toMatchObject({ names: ["low", "high"], at: 0 });
    expect(host.asked("/high/")).toBe(0);
    play.engine.play();
    await play.until(() => {
      play.seconds += 1 / 400;
      return play.engine.frameIndex >= 7;
    }, "frame 7");
    play.engine.chooseQuality(1);
    await play.toEnd(1 / 400);
    const { headers } = play;
    expect(play.engine.qualities.at).toBe(1);
    expect(headers.length).toBe(1);
    expect(headers[0]! % 3).toBe(0);
    expect(play.shown).toEqual([...Array(60).keys()].filter((index) => play.shown.includes(index)));
    expect(play.shown.length).toBeGreaterThan(50);
    expect(play.errors).toEqual([]);
  });

  test("follow the throughput of the connection, up and down", async () => {
    const [high, low] = [run(900).finish(), run(900).finish()];
    const host = new Host({ high, low });
    host.instead.set("/qualities.json", listed([{ ...ENTRIES[0], bits_per_second: 5e5 }, ENTRIES[1]]));
    const play = opened(host, 0, LIST);
    await play.settled();
    play.engine.play();
    const began = performance.now();
    const on = () => {
      play.seconds = 100 + (performance.now() - began) / 1000;
      return true;
    };
    await play.until(() => on() && play.engine.qualities.at === 1, "higher quality");
    expect(performance.now() - began).toBeGreaterThan(3000);
    host.bytesPerSecond = 4000;
    await play.until(() => on() && play.engine.qualities.at === 0, "lower quality");
    host.bytesPerSecond = undefined;
    const at = play.shown.at(-1)!;
    await play.until(() => on() && play.shown.at(-1)! > at + 10, "frames");
    // Nor does a change on a connection that stalls, which decodes from the key frame of the group that is shown.
    expect(play.shown).toEqual([...play.shown].sort((a, b) => a - b));
    expect(play.errors).toEqual([]);
  });

  test("throughput is what comes while anything is waited for", () => {
    const clock = { seconds: 0 };
    const throughput = new Throughput(() => clock.seconds);
    expect(throughput.bitsPerSecond).toBeUndefined();
    throughput.begin();
    clock.seconds = 1;
    throughput.begin();
    throughput.take(25_000);
    throughput.end();
    expect(throughput.bitsPerSecond).toBeUndefined(); // too little to know
    clock.seconds = 2;
    throughput.take(25_000);
    throughput.end();
    expect(throughput.bitsPerSecond).toBe(2e5);
    clock.seconds = 100; // nothing was waited for
    expect(throughput.bitsPerSecond).toBeCloseTo(2e5);
    throughput.begin();
    clock.seconds = 120; // and now nothing comes
    expect(throughput.bitsPerSecond).toBeLessThan(2e4);
    throughput.end();
  });

  test("of a small stream throughput is known after a while, and a slow phase is forgotten", () => {
    const clock = { seconds: 0 };
    const throughput = new Throughput(() => clock.seconds);
    const packet = (seconds: number) => {
      throughput.begin();
      clock.seconds += seconds;
      throughput.take(1000);
      throughput.end();
      clock.seconds += 5;
    };
    packet(0.01);
    expect(throughput.bitsPerSecond).toBeUndefined();
    for (let i = 0; i < 2; i++) packet(0.01);
    expect(throughput.bitsPerSecond).toBeCloseTo(8e5);
    for (let i = 0; i < 8; i++) packet(0.7);
    expect(throughput.bitsPerSecond).toBeLessThan(1.3e4);
    for (let i = 0; i < 8; i++) packet(0.01);
    expect(throughput.bitsPerSecond).toBeGreaterThan(1e5);
  });

  test("bit rates that are measured while a live run goes on are learned from the list", async () => {
    const runs = { high: run(12, { frameSeconds: 1 }), low: run(12, { frameSeconds: 1 }) };
    const { host, play, on } = await both(runs, 1e12);
    await play.until(() => on() && play.shown.at(-1) === 11 && play.engine.stalled, "edge");
    expect(play.engine.qualities.at).toBe(0);
    host.instead.set("/qualities.json", listed([{ ...ENTRIES[0], bits_per_second: 3e5 }, ENTRIES[1]]));
    const now = performance.now.bind(performance);
    vi.spyOn(performance, "now").mockImplementation(() => now() + 40_000);
    let count = 0;
    await play.until(() => {
      if (++count % 100 === 0) for (const one of [runs.high, runs.low]) one.write(1);
      return on() && play.engine.qualities.at === 1;
    }, "higher quality");
    expect(play.errors).toEqual([]);
  });

  test.each(["manifest", "init"])("one without its %s is reported once and left out", async (missing) => {
    const [high, low] = [run(30).finish(), run(30).finish()];
    for (const name of high.files.keys()) if (name.startsWith(missing)) high.files.delete(name);
    const host = new Host({ high, low });
    host.instead.set("/qualities.json", listed(ENTRIES));
    const play = opened(host, 0, LIST);
    await play.settled();
    play.engine.chooseQuality(1);
    await play.until(() => play.notices.length > 0, "notice");
    play.engine.play();
    await play.toEnd();
    expect(play.errors).toEqual([]);
    expect(play.notices.length).toBe(1);
    expect(play.notices[0]).toMatch(new RegExp(`^\\S*${missing}\\S* was not found on the server \\(404\\)`));
    expect(play.engine.qualities.at).toBe(0);
    expect(play.shown.at(-1)).toBe(29);
  });

  /** Both qualities of a stream, which plays. */
  async function both(runs: Record<"high" | "low", LiveRun>, bits_per_second = 4e6) {
    const host = new Host(runs);
    host.instead.set("/qualities.json", listed([{ ...ENTRIES[0], bits_per_second }, ENTRIES[1]]));
    const play = opened(host, 0, LIST);
    await play.settled();
    play.engine.play();
    return { host, play, on: goingOn(play) };
  }

  /** The same, of which the higher one was chosen and is shown. */
  async function high(runs: Record<"high" | "low", LiveRun>, bits_per_second = 4e6) {
    const { host, play, on } = await both(runs, bits_per_second);
    play.engine.chooseQuality(1);
    await play.until(() => on() && play.engine.qualities.at === 1, "higher quality");
    return { host, play, on };
  }

  test("an outage is reported once, and the quality that could not be read in it is taken later", async () => {
    const runs = { high: run(12, { frameSeconds: 1 }), low: run(12, { frameSeconds: 1 }) };
    const { host, play, on } = await high(runs, 1e12);
    await play.until(() => on() && play.shown.at(-1) === 11 && play.engine.stalled, "edge");
    host.trouble = "offline";
    play.engine.chooseQuality(undefined); // no connection is fast enough for the higher one
    await ticks(play, 1500, on);
    host.trouble = undefined;
    let count = 0;
    await play.until(() => {
      // Each frame is an occasion to change.
      if (++count % 100 === 0) for (const one of [runs.high, runs.low]) one.write(1);
      return on() && play.engine.qualities.at === 0;
    }, "lower quality");
    expect(play.notices.filter((text) => text.includes("cannot be fetched")).length).toBeLessThanOrEqual(1);
    expect(play.errors).toEqual([]);
  });

  test("a file that another quality lacks is asked for as often as any other", async () => {
    const runs = { high: run(30).finish(), low: run(30).finish() };
    const gone = [...runs.high.files.keys()].find((name) => name.startsWith("segment-00000002"))!;
    runs.high.files.delete(gone);
    const host = new Host(runs);
    host.instead.set("/qualities.json", listed(ENTRIES));
    const play = opened(host, 0, LIST);
    await play.settled();
    play.engine.seekFrame(3);
    await play.until(() => !play.engine.seeking, "frame 3");
    for (let i = 0; i < 40; i++) {
      play.engine.chooseQuality(1); // an occasion to change
      await ticks(play, 50);
    }
    expect(host.asked(gone)).toBe(3);
    play.engine.play();
    const on = goingOn(play);
    await play.until(() => on() && play.engine.qualities.at === 1, "higher quality");
    expect(play.errors).toEqual([]);
  });

  test("what is lost in one quality is not in another", async () => {
    const runs = { high: run(30).finish(), low: run(30).finish() };
    runs.low.files.delete([...runs.low.files.keys()].find((name) => name.startsWith("segment-00000001"))!);
    const { play, on } = await both(runs);
    await play.until(() => on() && play.engine.frames.lost.length > 0, "lost frames");
    play.engine.chooseQuality(1);
    await play.until(() => on() && play.engine.qualities.at === 1, "higher quality");
    await ticks(play, 200);
    expect(play.engine.frames.lost).toEqual([]);
  });

  test("news of the quality that was changed to are no reason to begin anew", async () => {
    const runs = { high: run(13, { frameSeconds: 1 }), low: run(13, { frameSeconds: 1 }) };
    const { host, play, on } = await high(runs);
    await play.until(() => on() && play.shown.at(-1) === 12 && play.engine.stalled, "edge");
    const decoded: number[] = [];
    const { packets } = play.engine;
    const take = packets.take.bind(packets);
    packets.take = (facts, milliseconds) => {
      decoded.push(...facts.map(({ index }) => index));
      take(facts, milliseconds);
    };
    for (const frame of [13, 14, 15]) {
      runs.high.write(1);
      await play.until(() => on() && play.shown.at(-1) === frame, `frame ${frame}`);
    }
    expect(decoded).toEqual([13, 14, 15]);
    const fatal: boolean[] = [];
    play.engine.on("error", (event) => fatal.push(event.fatal));
    const text = new TextDecoder().decode(runs.high.write(1).files.get("manifest.json")!);
    const sha256 = /"sha256":"([\da-f]{64})","period":0/.exec(text)![1]!;
    host.instead.set("/high/manifest.json", new TextEncoder().encode(text.replaceAll(sha256, "0".repeat(64))));
    await play.until(() => fatal.length > 0, "error");
    expect(fatal).toEqual([false]); // what is there can still be seen
  });

  test("are changed by throughput, and not back and forth", () => {
    const clock = { seconds: 0 };
    const abr = new AbrController(
      [1e6, 4e6, 2e6].map((bits_per_second) => ({ manifest: "m.json", bits_per_second, name: `${bits_per_second}` })),
      () => clock.seconds,
    );
    const at = (seconds: number, bits: number | undefined) => {
      clock.seconds = seconds;
      const step = abr.wanted(bits, 1);
      if (step !== abr.at) abr.change(step);
      return step;
    };
    expect(abr.steps.map(({ name }) => name)).toEqual(["1000000", "2000000", "4000000"]);
    expect(at(0, undefined)).toBe(0);
    expect(at(1, 9e6)).toBe(0); // not before it has held
    expect(at(5, 9e6)).toBe(1);
    expect(at(6, 9e6)).toBe(1);
    expect(at(10, 9e6)).toBe(2);
    expect(at(11, 4.5e6)).toBe(2); // not at once
    expect(at(13, 4.7e6)).toBe(2);
    expect(at(14, 1.2e6)).toBe(0);
    expect(at(20, 9e6)).toBe(0); // having fallen it waits for longer
    expect(at(35, 3e6)).toBe(0); // not enough to go up
    expect(at(35, 3.3e6)).toBe(1);
    abr.choice = 0;
    expect(at(36, 9e6)).toBe(0);
  });

  test("where a connection is hardly used the next one is tried, ever less often if in vain", () => {
    const clock = { seconds: 0 };
    const entries = [1e4, 2e5].map((bits_per_second) => ({ manifest: "m.json", bits_per_second, name: "x" }));
    const abr = new AbrController(entries, () => clock.seconds);
    const at = (seconds: number, busyShare: number, bits = 2e4) => {
      clock.seconds = seconds;
      return abr.wanted(bits, busyShare);
    };
    expect(at(9, 0.1)).toBe(0);
    expect(at(11, 0.5)).toBe(0); // it has enough to do
    expect(at(11, 0.1, 1e4)).toBe(0); // nor can it be that much better than it seems
    expect(at(12, 0.1)).toBe(1);
    expect(at(13, 0.9)).toBe(1); // by the trial itself
    expect(at(28, 0.1)).toBe(0); // not there in time
    expect(at(47, 0.1)).toBe(0);
    expect(at(49, 0.1)).toBe(1);
    abr.change(1);
    expect(at(50, 0.1, 3e5)).toBe(1);
    expect(at(52, 0.1)).toBe(0); // it is too slow for it
    abr.change(0);
    expect(at(91, 0.1)).toBe(0);
    expect(at(93, 0.1)).toBe(1);
    abr.change(1);
    expect(at(500, 0.1)).toBe(0); // after a long time in it
    abr.change(0);
    expect(at(509, 0.1)).toBe(0);
    expect(at(511, 0.1)).toBe(1);
  });

  test("at the edge a finer quality is gone up to though its frames are published later", async () => {
    const runs = { high: run(12, { frameSeconds: 1 }), low: run(13, { frameSeconds: 1 }) };
    const { play, on } = await both(runs);
    await play.until(() => on() && play.shown.at(-1) === 12 && play.engine.stalled, "edge");
    play.engine.chooseQuality(1);
    let count = 0;
    await play.until(() => {
      // Low is always a frame ahead.
      if (++count % 50 === 0) runs.low.write(1);
      if (count % 50 === 40) runs.high.write(1);
      return on() && play.engine.qualities.at === 1;
    }, "higher quality");
    const before = play.shown.at(-1)!;
    for (let i = 0; i < 3; i++) runs.high.write(1);
    await play.until(() => on() && play.shown.at(-1)! > before + 1, "frames of the higher quality");
    expect(play.shown).toEqual([...play.shown].sort((a, b) => a - b));
    expect(play.errors).toEqual([]);
  });
});

test("the address's token goes along with every file, and news are asked for by number", async () => {
  const live = run(10, { pageSegments: 1 });
  const host = new Host({ "": live });
  const play = opened(host, 0, `${ADDRESS}?token=secret`);
  await play.settled();
  live.write(1);
  await play.until(() => play.engine.frames.count === 11);
  expect(host.requests.every(({ query }) => new URLSearchParams(query).get("token") === "secret")).toBe(true);
  expect(host.requests.some(({ query }) => new URLSearchParams(query).get("after") === "10")).toBe(true);
});

const GOLDEN = new URL("../../../../tests/vectors/segments-1/", import.meta.url);

test.skipIf(!existsSync(GOLDEN))("the golden folder of the writer is played to its edge", async () => {
  const files = new Map(readdirSync(GOLDEN).map((name) => [name, new Uint8Array(readFileSync(new URL(name, GOLDEN)))]));
  const host = new Host({ "": { files, live: false, sequence: 0 } });
  const play = opened(host, 0);
  await play.settled();
  play.engine.play();
  const on = goingOn(play);
  await play.until(() => on() && play.shown.at(-1) === play.engine.frames.count - 1, "edge");
  expect(play.shown.slice(0, 1)).toEqual([0]);
  expect(play.shown.length).toBe(play.engine.frames.count);
  expect(play.errors).toEqual([]);
});
