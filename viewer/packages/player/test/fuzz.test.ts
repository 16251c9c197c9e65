// SPDX-License-Identifier: Apache-2.0
/** Damaged streams are played, or refused in a sentence: never without an end, and never with another exception. */

import { readFileSync } from "node:fs";
import { expect, test, vi } from "vitest";
import { playing, ServedFile, URL_OF_CLIP } from "./served.ts";

vi.setConfig({ testTimeout: 120_000 });

const STREAMS = ["version-2.sgs", "version-2-compact.sgs"].map(
  (name) =>
    [name, new Uint8Array(readFileSync(new URL(`../../../../tests/vectors/${name}`, import.meta.url)))] as const,
);

/** Plays a stream to its end, or until it is refused; gives back whether a picture came. */
async function played(bytes: Uint8Array, ranges: boolean): Promise<boolean> {
  const file = new ServedFile(bytes);
  file.ranges = ranges;
  file.lastModified = new Date(0).toUTCString();
  file.chunkBytes = 1 << 20;
  const play = playing(file.fetch as typeof fetch);
  try {
    play.engine.load({ kind: "url", url: URL_OF_CLIP, name: "it" });
    play.engine.play();
    const fatal = { found: false };
    play.engine.on("error", (error) => {
      fatal.found ||= error.fatal;
    });
    await play.until(() => {
      play.seconds += 0.02;
      return fatal.found || play.engine.ended;
    }, "end");
    return play.shown.length > 0;
  } finally {
    play.close();
  }
}

test.each(STREAMS)("%s, cut and with bits flipped", async (_, stream) => {
  let shown = 0;
  let tried = 0;
  for (let at = 0; at < stream.length; at += 331) {
    const flipped = stream.slice();
    flipped[at]! ^= 1 << (at & 7);
    shown += Number(await played(flipped, at % 3 !== 0));
    shown += Number(await played(stream.slice(0, at), at % 2 !== 0));
    tried += 2;
  }
  expect(shown).toBeGreaterThan(tried / 8);
  expect(shown).toBeLessThan(tried);
});
