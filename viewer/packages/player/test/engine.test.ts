// SPDX-License-Identifier: Apache-2.0
/** Engine, decoder and fetcher together, without a browser. */

import { readStream } from "@structgstream/core";
import { describe, expect, test, vi } from "vitest";
import { record } from "../../core/test/streams.ts";
import type { FromDecoder } from "../src/decode/messages.ts";
import { Engine } from "../src/engine/engine.ts";
import type { Pipeline } from "../src/engine/pipeline.ts";
import { CLIP, expectClip, playing, playingFile, ServedFile } from "./served.ts";

vi.setConfig({ testTimeout: 60_000 });

const WHOLE = readStream(CLIP);
const PACKETS = WHOLE.packets;
const KEYS = PACKETS.filter(({ isKey }) => isKey).map(({ index }) => index);

test("the clip has groups", () => {
  expect(KEYS).toEqual([0, 3, 6, 9]);
});

test("the first picture takes head, tail, the last packet's time, header and one key packet", async () => {
  const file = new ServedFile(CLIP);
  const play = playingFile(file);
  await play.until(() => play.shown.length > 0);
  expect(play.shown).toEqual([0]);
  const key = PACKETS[0]!;
  expect(file.requests).toEqual([
    [0, 4096],
    [CLIP.length - 4096, CLIP.length],
    [PACKETS.at(-1)!.offset, PACKETS.at(-1)!.offset + 20],
    [4096, key.offset + key.bytes],
  ]);
  expect(play.engine.frames.duration).toBeCloseTo(12 / 30);
  expect(play.errors).toEqual([]);
});

test("opened elsewhere, the packets from the key on are read, and no others", async () => {
  const file = new ServedFile(CLIP);
  const play = playingFile(file, PACKETS[8]!.ptsSeconds);
  await play.until(() => play.shown.at(-1) === 8);
  expect(play.shown).toEqual([6, 8]);
  expect(file.requests.slice(3)).toEqual([
    [4096, PACKETS[0]!.offset],
    [PACKETS[6]!.offset, PACKETS[9]!.offset],
  ]);
});

test("seeking back and forth gives exact frames and fetches what is not there", async () => {
  const file = new ServedFile(CLIP);
  const play = playingFile(file);
  await play.settled();
  const before = file.requests.length;
  for (const index of [7, 1, 11, 5, 7, 0]) await play.seeksExactly(index);
  expect(file.requests.slice(before)).toEqual([
    [PACKETS[6]!.offset, PACKETS[8]!.offset],
    [PACKETS[1]!.offset, PACKETS[2]!.offset],
    [PACKETS[9]!.offset, PACKETS[11]!.offset + PACKETS[11]!.bytes],
    [PACKETS[3]!.offset, PACKETS[6]!.offset],
  ]);
});

test("a seek that is overtaken by another loses no field", async () => {
  const play = playingFile(new ServedFile(CLIP));
  await play.settled();
  for (const index of [4, 10, 2, 8]) {
    play.engine.seekFrame(index);
    await new Promise((resolve) => setTimeout(resolve, index));
  }
  await play.until(() => play.shown.at(-1) === 8);
  expectClip(play, 8);
});

test("plays to the end, every frame in order, and again from the start", async () => {
  const play = playingFile(new ServedFile(CLIP));
  await play.settled();
  let ended = 0;
  play.engine.on("ended", () => ended++);
  play.engine.play();
  await play.until(() => {
    play.seconds += 1 / 120;
    return ended === 1;
  });
  expect(new Set(play.shown).size).toBeGreaterThan(8);
  expect(play.shown).toEqual([...play.shown].sort((a, b) => a - b));
  expect(play.shown.at(-1)).toBe(11);
  expect([play.engine.paused, play.engine.ended]).toEqual([true, true]);
  play.engine.play();
  await play.until(() => play.shown.at(-1) === 0);
});

test("loops, at another rate", async () => {
  const play = playingFile(new ServedFile(CLIP));
  await play.settled();
  play.engine.loop = true;
  play.engine.playbackRate = 2;
  play.engine.play();
  await play.until(() => {
    play.seconds += 1 / 200;
    return play.shown.filter((index) => index === 0).length >= 3;
  });
  expect(play.engine.paused).toBe(false);
  expect(() => {
    play.engine.playbackRate = -1;
  }).toThrow("expected a positive number");
});

test("late frames are dropped, and playback continues at the next key", async () => {
  const play = playingFile(new ServedFile(CLIP));
  await play.settled();
  play.engine.play();
  await play.until(() => play.engine.stored.times[0]?.[1] === play.engine.frames.duration, "buffer");
  play.seconds += 0.31; // a hole of nine frames
  await play.until(() => play.shown.at(-1)! >= 9);
  // Those decoded ahead were there; the ones between were not made into numbers, nor waited for.
  expect(play.shown.filter((index) => index > 5)).toEqual([9]);
  expect(play.engine.stalled).toBe(false);
});

describe("on a network that is slower than the stream", () => {
  /** Plays the first frame; no other packets arrive yet. */
  async function starved() {
    const file = new ServedFile(CLIP);
    const play = playingFile(file);
    await play.settled();
    file.heldFrom = PACKETS[1]!.offset;
    play.engine.play();
    return { file, play };
  }

  /** Lets all packets arrive; every frame is shown. */
  async function goesOn({ file, play }: Awaited<ReturnType<typeof starved>>) {
    file.heldFrom = Number.POSITIVE_INFINITY;
    await play.until(() => {
      // No frame is late from now on.
      if (play.shown.at(-1) === play.engine.frameIndex) play.seconds += 1 / 240;
      return play.engine.ended;
    }, "end");
    expect(play.shown).toEqual(PACKETS.map(({ index }) => index));
    expect(play.errors).toEqual([]);
  }

  test("a picture that takes as long as the rest of the stream does not end it", async () => {
    const { file, play } = await starved();
    play.seconds += 1;
    play.engine.tick();
    expect([play.engine.ended, play.engine.stalled, play.engine.frameIndex]).toEqual([false, true, 0]);
    await goesOn({ file, play });
  });

  test("frames that have arrived and are not decoded yet do not let the clock run past the missing ones", async () => {
    const { file, play } = await starved();
    const decoded = play.holdFrames();
    file.heldFrom = PACKETS[2]!.offset;
    await play.until(() => play.engine.stored.has(1), "packet");
    play.seconds += 0.3;
    let ticks = 0;
    await play.until(() => ++ticks > 5);
    decoded();
    await goesOn({ file, play });
  });

  test("frames that were dropped as late, and have left memory since, are not waited for", () => {
    const pipeline: Pipeline = { send: () => undefined, onmessage: undefined, close: () => undefined };
    let now = 0;
    const engine = new Engine(pipeline, () => now);
    const hear = (message: FromDecoder) => pipeline.onmessage!(message);
    const ptsSeconds = Float64Array.from({ length: 30 }, (_, i) => i / 30);
    const facts = { first: 0, count: 30, ptsSeconds, keys: Uint32Array.of(0, 10, 20), lost: [], complete: true };
    hear({ type: "catalog", facts });
    const update = { index: 0, ptsSeconds: 0, fields: new Map() };
    hear({ type: "frame", serial: 1, update, exact: true, packets: [], decodeMilliseconds: 0 });
    hear({ type: "stored", ranges: [[0, 20]], fetchedBytes: 0 });
    engine.play();
    now = 0.5;
    engine.tick();
    hear({ type: "stored", ranges: [[10, 20]], fetchedBytes: 0 });
    engine.tick();
    expect([engine.stalled, engine.frameIndex]).toEqual([false, 15]);
    now = 0.8;
    engine.tick();
    expect([engine.stalled, engine.frameIndex]).toEqual([true, 19]);
    engine.destroy();
  });
});

test("steps", async () => {
  const play = playingFile(new ServedFile(CLIP));
  await play.settled();
  for (const [by, at] of [
    [1, 1],
    [1, 2],
    [-1, 1],
    [-5, 0],
    [100, 11],
  ] as const) {
    play.engine.step(by);
    await play.until(() => !play.engine.seeking && play.shown.at(-1) === at, `frame ${at}`);
    expect(play.engine.frameIndex).toBe(at);
  }
});

test("a starved clock waits with the last frame, and says so", async () => {
  const file = new ServedFile(CLIP);
  const play = playingFile(file);
  await play.settled();
  const stalls: boolean[] = [];
  play.engine.on("stall", ({ stalled }) => stalls.push(stalled));
  file.status = 503;
  play.engine.play();
  const before = play.engine.currentTime;
  play.seconds += 0.2;
  play.engine.tick();
  expect(stalls).toEqual([true]);
  expect(play.engine.currentTime).toBeLessThan(before + 0.04);
  await play.until(() => play.engine.paused, "giving up");
  expect(play.errors).toEqual(["The server answered the request for clip.sgs with 503."]);
  file.status = undefined;
  play.engine.play();
  await play.toEnd(1 / 120);
  expect(stalls.slice(0, 2)).toEqual([true, false]);
  expect(play.shown.at(-1)).toBe(11);
});

test.each([true, false])("a server may send less than was asked for, of a file with an index: %s", async (indexed) => {
  const file = new ServedFile(indexed ? CLIP : CLIP.slice(0, -1));
  file.mostBytes = 1500;
  file.lastModified = new Date(0).toUTCString();
  const play = playingFile(file);
  await play.settled();
  await play.until(() => play.engine.frames.count === PACKETS.length);
  await play.seeksExactly(11);
  expect(play.errors).toEqual([]);
});

describe("a server without ranges", () => {
  test("is read whole, once, and said so", async () => {
    const file = new ServedFile(CLIP);
    file.ranges = false;
    const play = playingFile(file);
    await play.settled();
    await play.until(() => play.engine.frames.complete);
    play.engine.seekFrame(10);
    await play.until(() => play.shown.at(-1) === 10);
    expect(file.requests.length).toBe(1);
    expect(play.notices.join()).toContain("range requests");
  });

  test("packets that left memory are read again", async () => {
    const file = new ServedFile(CLIP);
    file.ranges = false;
    const play = playingFile(file, 0, { budgetBytes: 3000 });
    await play.until(() => play.engine.frames.complete);
    for (const index of [11, 0, 6]) {
      play.engine.seekFrame(index);
      await play.until(() => play.shown.at(-1) === index, `frame ${index}`);
    }
    expect(play.errors).toEqual([]);
  });
});

test("packets take no more bytes than they may", async () => {
  const file = new ServedFile(CLIP);
  const play = playingFile(file, 0, { budgetBytes: 4000 });
  await play.settled();
  play.engine.loop = true;
  play.engine.play();
  let most = 0;
  play.engine.on("progress", ({ buffered }) => {
    const frames = buffered.flatMap(([start, end]) =>
      PACKETS.filter((p) => p.ptsSeconds >= start && p.ptsSeconds < end),
    );
    most = Math.max(
      most,
      frames.reduce((sum, { bytes }) => sum + bytes - 12, 0),
    );
  });
  await play.until(() => {
    play.seconds += 1 / 200;
    return play.shown.filter((index) => index === 0).length >= 3;
  });
  expect(most).toBeLessThanOrEqual(4000);
  expect(most).toBeGreaterThan(1000);
});

describe("a growing file", () => {
  test("is followed, and its pace is reported", async () => {
    const cut = (frames: number) => CLIP.subarray(0, PACKETS[frames - 1]!.offset + PACKETS[frames - 1]!.bytes + 5);
    const file = new ServedFile(cut(2));
    const play = playingFile(file);
    await play.until(() => play.engine.frames.count === 2 && play.engine.edge.grows);
    play.engine.play();
    const ticking = () => {
      play.seconds += 1 / 60;
      return true;
    };
    await play.until(() => ticking() && play.shown.at(-1) === 1);
    await play.until(() => ticking() && play.engine.stalled);
    expect(play.engine.nextFrameSeconds).toBeUndefined();
    for (const frames of [3, 4, 5]) {
      file.bytes = cut(frames);
      await play.until(() => ticking() && play.shown.at(-1) === frames - 1, `frame ${frames - 1}`);
    }
    expect(play.engine.nextFrameSeconds).toBeGreaterThanOrEqual(0);
    file.bytes = CLIP;
    await play.until(() => ticking() && play.engine.ended, "end");
    expect(play.engine.frames.complete).toBe(true);
    expect(play.errors).toEqual([]);
  });

  test("that no longer grows comes to an end", async () => {
    const file = new ServedFile(CLIP.subarray(0, PACKETS[5]!.offset + 20));
    file.lastModified = new Date(Date.now() - 3_600_000).toUTCString();
    const play = playingFile(file);
    await play.until(() => play.engine.frames.complete);
    expect(play.engine.frames.count).toBe(5);
    play.engine.play();
    await play.toEnd();
    expect(play.shown.at(-1)).toBe(4);
  });

  test("that was replaced by a shorter one is refused", async () => {
    const file = new ServedFile(CLIP.subarray(0, PACKETS[5]!.offset));
    const play = playingFile(file);
    await play.until(() => play.engine.edge.grows);
    file.bytes = CLIP.subarray(0, 9000);
    await play.until(() => play.errors.length > 0);
    expect(play.errors[0]).toContain("it was replaced. Load it again");
  });
});

test("frames that a live run skipped take their time, also in a file with an index", async () => {
  const bytes = CLIP.slice();
  for (const { index, isKey, offset, bytes: size } of PACKETS) {
    const payload = bytes.slice(offset + 8, offset + size - 4);
    new DataView(payload.buffer).setFloat64(4, 3 * index, true);
    bytes.set(record(isKey ? 2 : 3, payload), offset);
  }
  const play = playingFile(new ServedFile(bytes));
  await play.until(() => play.engine.frames.count === 12, "all frames");
  expect(play.engine.frames.duration).toBeGreaterThan(33);
  play.engine.seek(20);
  await play.until(() => play.shown.at(-1) === 6, "frame 6");
  expect(play.errors).toEqual([]);
});

describe("damage", () => {
  test("in a packet costs its group, and is reported", async () => {
    const bytes = CLIP.slice();
    bytes[PACKETS[4]!.offset + 30]! ^= 4;
    const play = playingFile(new ServedFile(bytes));
    await play.settled();
    play.engine.play();
    await play.toEnd(1 / 120);
    expect([...new Set(play.shown)]).toEqual([0, 1, 2, 3, 6, 7, 8, 9, 10, 11]);
    expect(play.errors).toEqual([`Frames 4 to 5 are lost: its record at byte ${PACKETS[4]!.offset} is damaged.`]);
    expect(play.engine.frames.lost).toEqual([[4, 6]]);
    play.engine.seekFrame(5);
    await play.settled();
    expect(play.shown.at(-1)).toBe(3);
  });

  test("in the index is got around by reading all", async () => {
    const bytes = CLIP.slice();
    bytes[bytes.length - 30]! ^= 1;
    const play = playingFile(new ServedFile(bytes));
    await play.settled();
    await play.until(() => play.engine.frames.count === 12);
    expect(play.errors).toEqual([]);
  });

  test("of a packet's contents behind a right checksum costs its group", async () => {
    const bytes = CLIP.slice();
    const { offset, bytes: size } = PACKETS[4]!;
    const payload = bytes.slice(offset + 8, offset + size - 4);
    payload.fill(255, 30);
    bytes.set(record(3, payload), offset);
    const play = playingFile(new ServedFile(bytes));
    await play.settled();
    play.engine.seekFrame(5);
    await play.settled();
    expect(play.errors.join()).toContain("Frames 4 to 5 are lost");
  });

  test("that leaves no frame is reported", async () => {
    const file = new ServedFile(CLIP.subarray(0, PACKETS[0]!.offset + 20));
    file.lastModified = new Date(0).toUTCString();
    const play = playingFile(file);
    await play.until(() => play.errors.length > 0);
    expect(play.errors).toEqual(["clip.sgs has a header and no whole frame to show."]);
  });

  test("of the header, another format, another version", async () => {
    const broken = CLIP.slice();
    broken[5000]! ^= 1;
    const newer = CLIP.slice();
    newer[8] = 9;
    for (const [bytes, sentence] of [
      [broken, "its init record is damaged"],
      [newer, "has format version 9.0; this program reads 2.x. Use a newer one."],
      [new TextEncoder().encode("<html>"), "its first bytes are not the format's signature"],
    ] as const) {
      const play = playingFile(new ServedFile(bytes));
      await play.until(() => play.errors.length > 0);
      expect(play.errors[0]).toContain(sentence);
    }
  });
});

test.each([
  [404, "clip.sgs was not found on the server (404). Check the address."],
  [403, "The server refuses clip.sgs to this page (403)."],
  [500, "The server answered the request for clip.sgs with 500."],
])("status %i", async (status, sentence) => {
  const file = new ServedFile(CLIP);
  file.status = status;
  const play = playingFile(file);
  await play.until(() => play.errors.length > 0);
  expect(play.errors).toEqual([sentence]);
});

test("a server that does not answer is reported at once; one that stops answering is asked again", async () => {
  const file = new ServedFile(CLIP);
  file.failures = 1;
  const never = playingFile(file);
  await never.until(() => never.errors.length > 0);
  expect(never.errors[0]).toContain("Access-Control-Allow-Origin");
  const play = playingFile(file);
  await play.settled();
  file.failures = 2;
  play.engine.seekFrame(11);
  await play.until(() => play.shown.at(-1) === 11);
  expect(play.notices.join()).toContain("The next attempt is in");
  expect(play.errors).toEqual([]);
});

test("files of the user's and base64", async () => {
  for (const source of [
    { kind: "blob", blob: new Blob([CLIP]), name: "a file" },
    { kind: "base64", text: `\n${Buffer.from(CLIP).toString("base64")}\n`, name: "a page" },
  ] as const) {
    const play = playing(fetch);
    play.engine.load(source);
    await play.settled();
    play.engine.seekFrame(8);
    await play.until(() => play.shown.at(-1) === 8);
  }
  const play = playing(fetch);
  play.engine.load({ kind: "base64", text: "*", name: "a page" });
  await play.until(() => play.errors.length > 0);
  expect(play.errors[0]).toContain("a page is no base64 text");
});

test("what a packet took is known by field", async () => {
  const play = playingFile(new ServedFile(CLIP));
  await play.settled();
  play.engine.seekFrame(4);
  await play.settled();
  const facts = play.engine.packets.of(4)!;
  expect(facts.bytes).toBe(PACKETS[4]!.bytes);
  expect([...facts.byField.values()].reduce((sum, bytes) => sum + bytes, 24)).toBe(facts.bytes);
});
