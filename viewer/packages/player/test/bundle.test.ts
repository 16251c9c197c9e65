// SPDX-License-Identifier: Apache-2.0
/** The bundle: small, complete, and what the package carries, which another build has made. */

import { readFileSync } from "node:fs";
import { gzipSync } from "node:zlib";
import { expect, test } from "vitest";

const MAX_BYTES = 82_000;
const read = (path: string) => readFileSync(new URL(path, import.meta.url), "utf8");
/** What `npm run build` wrote; the browser tests load it. */
const player = read("../dist/player.js");

test("is small enough", () => {
  expect(gzipSync(player, { level: 9 }).length).toBeLessThanOrEqual(MAX_BYTES);
});

test("is what the Python package carries: run `scripts/build-player` otherwise", () => {
  expect(read("../../../../src/structgstream/serve/assets/player.js") === player).toBe(true);
});

test("is whole, and names no other place", () => {
  expect(player).not.toMatch(/\bimport\s*[{("'*]|\bfrom\s*["']/);
  expect([...player.matchAll(/https?:\/\/[\w.]+/g)].map(([address]) => address)).toEqual(["http://www.w3.org"]);
  // It may stand inside an HTML page.
  expect(player).not.toMatch(/<\/script|<!--/i);
});
