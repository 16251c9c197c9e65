// SPDX-License-Identifier: Apache-2.0
/** The bundle: small, complete, and what the sources give. */

import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";
import { afterAll, beforeAll, expect, test } from "vitest";

const MOST_BYTES = 72_000;
const folder = mkdtempSync(join(tmpdir(), "player-"));
let first = "";

function built(name: string): string {
  const path = join(folder, name);
  execFileSync(process.execPath, [fileURLToPath(new URL("../build.mjs", import.meta.url)), path], { stdio: "pipe" });
  return readFileSync(path, "utf8");
}

beforeAll(() => {
  first = built("first.js");
}, 60_000);

afterAll(() => rmSync(folder, { recursive: true }));

test("is small enough", () => {
  expect(gzipSync(first, { level: 9 }).length).toBeLessThanOrEqual(MOST_BYTES);
});

test("is the same whenever it is built", () => {
  expect(built("second.js")).toBe(first);
}, 60_000);

test("is what the browser tests look at: run `npm run build` otherwise", () => {
  expect(readFileSync(new URL("../dist/player.js", import.meta.url), "utf8") === first).toBe(true);
});

test("is whole, and names no other place", () => {
  expect(first).not.toMatch(/\bimport\s*[{("'*]|\bfrom\s*["']/);
  expect([...first.matchAll(/https?:\/\/[\w.]+/g)].map(([address]) => address)).toEqual(["http://www.w3.org"]);
  // It may stand inside an HTML page.
  expect(first).not.toMatch(/<\/script|<!--/i);
});
