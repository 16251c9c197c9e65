// SPDX-License-Identifier: Apache-2.0

import { expect, test } from "vitest";
import { Playback } from "../src/playback.ts";
import { readStream, type StreamReader } from "../src/reader.ts";
import { bytesOf, FIXTURES, joined, piecesOf, VECTORS } from "./streams.ts";

const STREAM = bytesOf(FIXTURES, "paper.sgs");

function playing(reader: StreamReader = readStream(STREAM)) {
  const shown: number[] = [];
  const calls = { ended: 0 };
  const playback = new Playback(reader, ({ index }) => shown.push(index), { ended: () => calls.ended++ });
  return { playback, shown, calls, reader, interval: 1 / reader.header!.fps };
}

test("plays every frame once, in order, and ends", () => {
  const { playback, shown, calls, reader, interval } = playing();
  const indices = reader.packets.map(({ index }) => index);
  playback.play();
  for (let now = 100; !playback.ended; now += interval / 3) playback.update(now);
  expect(shown).toEqual(indices);
  expect(calls.ended).toBe(1);
  expect(playback.paused).toBe(true);
  expect(playback.currentTime).toBe(playback.duration);
  expect(playback.duration).toBeCloseTo(reader.packets.at(-1)!.ptsSeconds + interval);
  playback.play();
  playback.update(200);
  expect(shown.at(-1)).toBe(indices[0]);
});

test("a paused one shows the first frame, and what is sought", () => {
  const { playback, shown, reader } = playing();
  playback.update(0);
  playback.update(5);
  const last = reader.packets.at(-1)!;
  playback.seek(last.ptsSeconds);
  playback.update(6);
  playback.seek(-1);
  playback.update(7);
  expect(shown).toEqual([0, last.index, 0]);
  playback.seek(1e9);
  playback.update(8);
  expect(shown.at(-1)).toBe(last.index);
  expect(playback.ended).toBe(false);
});

test("loops, at another rate, and time while paused or hidden does not count", () => {
  const { playback, shown, calls, reader, interval } = playing();
  const count = reader.packets.length;
  Object.assign(playback, { loop: true, playbackRate: 0.5 });
  playback.play();
  for (let i = 0; i <= 2 * count; i++) playback.update(i * interval * 1.0001);
  expect(shown).toEqual([...reader.packets.map(({ index }) => index), 0]);
  expect(calls.ended).toBe(0);
  playback.pause();
  const { currentTime } = playback;
  playback.update(1000);
  playback.play();
  playback.update(2000);
  expect(playback.currentTime).toBe(currentTime);
  playback.playbackRate = 0.01;
  playback.update(9000);
  expect(playback.currentTime - currentTime).toBeCloseTo(0.01);
});

test("frames that need a lost one are left out, and without any there is nothing to play", () => {
  const pieces = piecesOf(STREAM);
  const damaged = pieces.map((piece) => piece.slice());
  damaged[3]![20]! ^= 1; // the second packet
  const { playback, shown, interval, reader } = playing(readStream(joined(...damaged)));
  expect(reader.damage.length).toBe(1);
  playback.play();
  for (let now = 0; !playback.ended; now += interval / 2) playback.update(now);
  expect(shown[0]).toBe(0);
  expect(shown).not.toContain(1);
  const empty = readStream(joined(...pieces.slice(0, 2)), "Ball");
  expect(() => new Playback(empty, () => undefined)).toThrow("Ball has no frame that can be shown.");
});

test("a raw stream plays, too", () => {
  const { playback, shown, interval, reader } = playing(readStream(bytesOf(VECTORS, "version-2.sgs")));
  playback.play();
  for (let now = 0; !playback.ended; now += interval) playback.update(now);
  expect(shown.length).toBe(reader.packets.length);
});
