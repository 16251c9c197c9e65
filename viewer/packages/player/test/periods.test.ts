// SPDX-License-Identifier: Apache-2.0
/** A file of several periods, played and sought: engine, decoder and fetcher together, without a browser. */

import { readStream, type StreamHeader, type Tensor } from "@structgstream/core";
import { expect, test, vi } from "vitest";
import { expectSame } from "../../core/test/streams.ts";
import { periodFile } from "./periodFile.ts";
import { CLIP, type Playing, playingFile, ServedFile } from "./served.ts";

vi.setConfig({ testTimeout: 60_000 });

const PERIODS = 5;
const EACH = 6;
const FILE = periodFile(Array<Uint8Array>(PERIODS).fill(CLIP), EACH);
const WHOLE = readStream(CLIP);

/** Draws what is due, and records at which frames another header came; all that was given is in `fields`. */
function watching(play: Playing) {
  const headers: number[] = [];
  const fields = new Map<string, Tensor>();
  const take = () => {
    const update = play.engine.tick();
    if (!update) return undefined;
    const { header } = update as { header?: StreamHeader };
    if (header) {
      headers.push(update.index);
      fields.clear();
      expect(new Set(update.fields.keys())).toEqual(header.dynamic);
    }
    for (const [name, tensor] of update.fields) fields.set(name, tensor);
    return update.index;
  };
  return { headers, fields, take };
}

function expectFrame(fields: Map<string, Tensor>, index: number): void {
  const expected = readStream(CLIP).frame(index % EACH).fields;
  for (const name of WHOLE.header!.dynamic) expectSame(fields.get(name), expected.get(name)!);
}

/** How many requests after those for head and tail were for these bytes. */
function asked(file: ServedFile, [start, end]: readonly [number, number]): number {
  return file.requests.slice(2).filter(([from, to]) => from < end && to > start).length;
}

async function playedOut(play: Playing, take: () => number | undefined): Promise<void> {
  while (!play.engine.ended) {
    play.seconds += 1 / 60;
    take();
    await new Promise((resolve) => setTimeout(resolve, 2));
  }
}

test("periods of a file are crossed without a break, and each init record is fetched once, before it is needed", async () => {
  const file = new ServedFile(FILE.bytes);
  const play = playingFile(file);
  await play.settled();
  const { headers, fields, take } = watching(play);
  const stalls: boolean[] = [];
  play.engine.on("stall", ({ stalled }) => stalls.push(stalled));
  play.engine.play();
  await play.until(() => (play.engine.stored.times.at(-1)?.[1] ?? 0) > 0.5, "buffer");
  await playedOut(play, take);
  expect(headers).toEqual([6, 12, 18, 24]);
  expectFrame(fields, PERIODS * EACH - 1);
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
  const { fields, take } = watching(play);
  take();
  for (const index of [29, 1, 13, 7, 25, 12, 11, 5, 6, 18]) {
    play.engine.seekFrame(index);
    await vi.waitFor(() => expect(take()).toBe(index), { timeout: 10_000, interval: 1 });
    expectFrame(fields, index);
  }
  expect(play.errors).toEqual([]);
});

test("without an index, and while the file grows, it is the same", async () => {
  const cut = FILE.packets[3 * EACH + 2]!;
  const file = new ServedFile(FILE.bytes.subarray(0, cut));
  const play = playingFile(file);
  await play.settled();
  const { headers, fields, take } = watching(play);
  play.engine.play();
  await vi.waitFor(
    () => {
      play.seconds += 1 / 60;
      expect(take()).toBe(3 * EACH + 1);
    },
    { timeout: 20_000, interval: 2 },
  );
  expectFrame(fields, 3 * EACH + 1);
  file.bytes = FILE.bytes;
  await playedOut(play, take);
  expect(headers).toEqual([6, 12, 18, 24]);
  expectFrame(fields, PERIODS * EACH - 1);
  play.engine.seekFrame(2);
  await vi.waitFor(() => expect(take()).toBe(2), { timeout: 10_000, interval: 1 });
  expectFrame(fields, 2);
  expect(play.errors).toEqual([]);
});

test.each([true, false])("a damaged init record costs its period (with an index: %s)", async (indexed) => {
  const bytes = FILE.bytes.slice();
  bytes[FILE.inits[1]![0] + 100]! ^= 1;
  const file = new ServedFile(indexed ? bytes : bytes.subarray(0, -16));
  const play = playingFile(file);
  await play.settled();
  const { headers, fields, take } = watching(play);
  play.engine.play();
  await vi.waitFor(
    () => {
      play.seconds += 1 / 60;
      expect(take()).toBe(PERIODS * EACH - 1);
    },
    { timeout: 20_000, interval: 2 },
  );
  expectFrame(fields, PERIODS * EACH - 1);
  expect(headers).toEqual([6, 18, 24]);
  expect(play.errors.length).toBe(1);
  expect(play.errors[0]).toMatch(/^Frames 12 to 17 are lost: /);
});
