// SPDX-License-Identifier: Apache-2.0
/** The bundle: small, complete, and what the sources give. */

import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";
import { expect, test } from "vitest";

const MAX_BYTES = 74_000;
const read = (path: string) => readFileSync(new URL(path, import.meta.url), "utf8");
/** What `npm run build` wrote; the browser tests load it. */
const player = read("../dist/player.js");

test("is small enough", () => {
  expect(gzipSync(player, { level: 9 }).length).toBeLessThanOrEqual(MAX_BYTES);
});

test("is the same whenever it is built, and what the sources give: run `npm run build` otherwise", () => {
  const folder = mkdtempSync(join(tmpdir(), "player-"));
  try {
    const path = join(folder, "again.js");
    execFileSync(process.execPath, [fileURLToPath(new URL("../build.mjs", import.meta.url)), path], { stdio: "pipe" });
    expect(readFileSync(path, "utf8") === player).toBe(true);
  } finally {
    rmSync(folder, { recursive: true });
  }
}, 60_000);

test("is what the Python package carries: run `scripts/build-player` otherwise", () => {
  expect(read("../../../../src/structgstream/serve/assets/player.js") === player).toBe(true);
});

test("is whole, and names no other place", () => {
  expect(player).not.toMatch(/\bimport\s*[{("'*]|\bfrom\s*["']/);
  expect([...player.matchAll(/https?:\/\/[\w.]+/g)].map(([address]) => address)).toEqual(["http://www.w3.org"]);
  // It may stand inside an HTML page.
  expect(player).not.toMatch(/<\/script|<!--/i);
});
