// SPDX-License-Identifier: Apache-2.0
/** Damaged streams give scenes or a StreamError: no other exception, and no large allocation. */

import { afterEach, beforeEach, describe, expect, test, vi } from "vitest";
import { AdaptiveDecoder } from "../src/adaptive.ts";
import { Models } from "../src/decisions.ts";
import { StreamError } from "../src/errors.ts";
import { decodedFree, MAX_FREE, noFree } from "../src/freeRows.ts";
import { readStream } from "../src/reader.ts";
import { bytesOf, FIXTURES, joined, piecesOf, record, VECTORS } from "./streams.ts";

const MAX_BYTES = 2 ** 20;
/** A stream, and the distance of the bytes that are tried. */
const STREAMS: [string, Uint8Array, number][] = [
  ["raw", bytesOf(VECTORS, "version-2.sgs"), 5],
  ["compact", bytesOf(FIXTURES, "tiny.sgs"), 7],
];
const ARRAYS = { Uint8Array, Uint16Array, Int32Array, Float32Array, Float64Array, BigInt64Array };
let largest = 0;

vi.setConfig({ testTimeout: 600_000 });

beforeEach(() => {
  largest = 0;
  for (const [name, Base] of Object.entries(ARRAYS)) {
    const counting = new Proxy(Base, {
      construct(target, given: unknown[], newTarget) {
        if (typeof given[0] === "number") largest = Math.max(largest, given[0] * Base.BYTES_PER_ELEMENT);
        return Reflect.construct(target, given, newTarget);
      },
    });
    vi.stubGlobal(name, counting);
  }
});

afterEach(() => {
  vi.unstubAllGlobals();
});

/** Lets the test runner speak between decodings. */
async function pause(at: number): Promise<void> {
  if (at % 256 === 0) await new Promise((resolve) => setImmediate(resolve));
}

/** Frames that could be decoded, or undefined where the stream was refused; anything but a StreamError is thrown. */
function framesOf(stream: Uint8Array): number | undefined {
  try {
    const reader = readStream(stream);
    for (const { index } of reader.packets) reader.frame(index);
    return reader.packets.length;
  } catch (error) {
    if (error instanceof StreamError) return undefined;
    throw error;
  }
}

describe.each(STREAMS)("the %s stream", (_, stream, step) => {
  const records = readStream(stream).packets.length;

  test("cut", async () => {
    let before = 0;
    for (let end = 0; end < stream.length; end += step) {
      await pause(end);
      const frames = framesOf(stream.subarray(0, end)) ?? 0;
      expect(frames).toBeGreaterThanOrEqual(before);
      before = frames;
    }
    expect(framesOf(stream)).toBe(records);
    expect(largest).toBeLessThan(MAX_BYTES);
  });

  test("with a byte changed", async () => {
    for (let at = 0; at < stream.length; at += step) {
      await pause(at);
      const damaged = stream.slice();
      damaged[at]! ^= 1 << (at & 7);
      const frames = framesOf(damaged);
      expect(frames === undefined || frames <= records).toBe(true);
    }
    expect(largest).toBeLessThan(MAX_BYTES);
  });

  test("with a byte changed and a checksum that says it is right", async () => {
    const pieces = piecesOf(stream);
    let decoded = 0;
    let refused = 0;
    for (const [place, piece] of pieces.entries()) {
      if (place === 0) continue;
      for (let at = 8; at < piece.length - 4; at += step) {
        await pause(at);
        for (const change of [1 << (at & 7), 0xff]) {
          const payload = piece.slice(8, -4);
          payload[at - 8]! ^= change;
          const damaged = joined(...pieces.slice(0, place), record(piece[0]!, payload), ...pieces.slice(place + 1));
          if (framesOf(damaged) === undefined) refused++;
          else decoded++;
        }
      }
    }
    expect(refused).toBeGreaterThan(60);
    expect(decoded).toBeGreaterThan(60);
    expect(largest).toBeLessThan(2 ** 24);
  });

  test("with every payload cut anywhere and a checksum that says it is right", async () => {
    const pieces = piecesOf(stream);
    for (const [place, piece] of pieces.entries()) {
      if (place === 0 || place === pieces.length - 1) continue;
      for (let end = 0; end < piece.length - 12; end += step) {
        await pause(end);
        const cut = record(piece[0]!, piece.slice(8, 8 + end));
        expect(framesOf(joined(...pieces.slice(0, place), cut, ...pieces.slice(place + 1)))).toBeUndefined();
      }
    }
    expect(largest).toBeLessThan(MAX_BYTES);
  });
});

/** What {@link decodedFree} reads of a packet in which nothing is there, and `births` are the bytes of what is born. */
function bornOf(...births: number[]): AdaptiveDecoder {
  return new AdaptiveDecoder(
    new Models(),
    new Map([
      ["free", new Uint8Array(0)],
      ["free_births", Uint8Array.from(births)],
    ]),
    "It",
  );
}

test("more births than a scene may have are refused before anything is allocated for them", () => {
  expect(decodedFree(bornOf(129), noFree(), "It").births.length).toBe(0);
  const most = () => decodedFree(bornOf(64, 62, 189, 124, 229), noFree(), "It");
  expect(most).toThrow("ends too early in free_births");
  largest = 0;
  const more = () => decodedFree(bornOf(64, 62, 189, 124, 228), noFree(), "It");
  expect(more).toThrow(`adds ${MAX_FREE + 1} free Gaussians`);
  const huge = () => decodedFree(bornOf(64, 62, 143, 66, 0, 2, 244), noFree(), "It");
  expect(huge).toThrow("adds 2147483647 free Gaussians");
  expect(() => decodedFree(bornOf(33), noFree(), "It")).toThrow("adds -1 free Gaussians");
  expect(largest).toBeLessThan(2 ** 16);
});
