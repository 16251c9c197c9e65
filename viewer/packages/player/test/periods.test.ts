// SPDX-License-Identifier: Apache-2.0
/** A file of several periods, played and sought: engine, decoder and fetcher together, without a browser. */

import { expect, test, vi } from "vitest";
import { periodFile } from "./periodFile.ts";
import { CLIP, expectClip, playingFile, ServedFile } from "./served.ts";

vi.setConfig({ testTimeout: 60_000 });

const PERIODS = 5;
const EACH = 6;
const FILE = periodFile(Array<Uint8Array>(PERIODS).fill(CLIP), EACH);

/** How many requests after those for head and tail were for these bytes. */
function asked(file: ServedFile, [start, end]: readonly [number, number]): number {
  return file.requests.slice(2).filter(([from, to]) => from < end && to > start).length;
}

test("periods of a file are crossed without a break, and each init record is fetched once, before it is needed", async () => {
  const file = new ServedFile(FILE.bytes);
  const play = playingFile(file);
  await play.settled();
  const stalls: boolean[] = [];
  play.engine.on("stall", ({ stalled }) => stalls.push(stalled));
  play.engine.play();
  await play.until(() => (play.engine.stored.times.at(-1)?.[1] ?? 0) > 0.5, "buffer");
  await play.toEnd();
  expect(play.headers).toEqual([6, 12, 18, 24]);
  expectClip(play, EACH - 1);
  expect(stalls).toEqual([]);
  expect(FILE.inits.map((init) => asked(file, init))).toEqual([1, 1, 1, 1]);
  const bytes = file.requests.reduce((sum, [start, end]) => sum + end - start, 0);
  expect(bytes).toBeLessThan(FILE.bytes.length + 3 * 4096);
  expect(play.errors).toEqual([]);
});

test("any frame is sought, in any order, with the header of its period", async () => {
  const file = new ServedFile(FILE.bytes);
  const play = playingFile(file, 14 / 30);
  await play.settled();
  for (const index of [29, 1, 13, 7, 25, 12, 11, 5, 6, 18]) {
    play.engine.seekFrame(index);
    await play.until(() => play.shown.at(-1) === index, `frame ${index}`);
    expectClip(play, index % EACH);
  }
  expect(play.errors).toEqual([]);
});

test("without an index, and while the file grows, it is the same", async () => {
  const cut = FILE.packets[3 * EACH + 2]!;
  const file = new ServedFile(FILE.bytes.subarray(0, cut));
  const play = playingFile(file);
  await play.settled();
  play.engine.play();
  await play.until(() => {
    play.seconds += 1 / 60;
    return play.shown.at(-1) === 3 * EACH + 1;
  }, "last frame so far");
  expectClip(play, 1);
  file.bytes = FILE.bytes;
  await play.toEnd();
  expect(play.headers).toEqual([6, 12, 18, 24]);
  expectClip(play, EACH - 1);
  await play.seeksExactly(2);
  expect(play.errors).toEqual([]);
});

test.each([true, false])("a damaged init record costs its period (with an index: %s)", async (indexed) => {
  const bytes = FILE.bytes.slice();
  bytes[FILE.inits[1]![0] + 100]! ^= 1;
  const file = new ServedFile(indexed ? bytes : bytes.subarray(0, -16));
  const play = playingFile(file);
  await play.settled();
  play.engine.play();
  await play.toEnd();
  expectClip(play, EACH - 1);
  expect(play.headers).toEqual([6, 18, 24]);
  expect(play.errors.length).toBe(1);
  expect(play.errors[0]).toMatch(/^Frames 12 to 17 are lost: /);
});

test("a damaged packet that begins a period does not cost the groups behind it, whatever was sought before", async () => {
  const bytes = FILE.bytes.slice();
  bytes[FILE.packets[EACH]! + 30]! ^= 1;
  const play = playingFile(new ServedFile(bytes));
  await play.settled();
  // Frame 7 is lost; the header of its period is forgotten after three others.
  for (const index of [7, 13, 19, 25, 10]) {
    play.engine.seekFrame(index);
    const shown = index === 7 ? 5 : index;
    await play.until(() => !play.engine.seeking && play.shown.at(-1) === shown, `frame ${shown}`);
  }
  expectClip(play, 10 - EACH);
});
