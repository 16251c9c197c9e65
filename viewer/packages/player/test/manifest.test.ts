// SPDX-License-Identifier: Apache-2.0
/** Manifests of honest and of hostile hosts. */

import { readFileSync } from "node:fs";
import { describe, expect, test } from "vitest";
import { SourceError } from "../src/source/byteSource.ts";
import { type Manifest, manifestIn, type PageEntry, pageIn } from "../src/source/manifest.ts";
import { siblingUrl, verify } from "../src/source/storedFile.ts";
import { LiveRun } from "./liveRun.ts";
import { CLIP } from "./served.ts";

type Json = Record<string, unknown>;
const bytesOf = (value: unknown) => new TextEncoder().encode(typeof value === "string" ? value : JSON.stringify(value));
const RUN = new LiveRun(CLIP, { pageSegments: 2 }).write(40);
const GOOD = JSON.parse(new TextDecoder().decode(RUN.files.get("manifest.json")!)) as Json;

function parsed(value: unknown): Manifest {
  return manifestIn(bytesOf(value), "manifest.json") as Manifest;
}

/** The good manifest with something else at a path such as `segments.0.file`. */
function but(path: string, value: unknown): Json {
  const copy = structuredClone(GOOD);
  const steps = path.split(".");
  let at = copy as Json;
  for (const step of steps.slice(0, -1)) at = at[step] as Json;
  if (value === undefined) delete at[steps.at(-1)!];
  else at[steps.at(-1)!] = value;
  return copy;
}

test("a manifest is what it says, without what nobody knows", () => {
  const found = parsed(but("news", 1));
  expect(found.edge.frame).toBe(39);
  expect(found).not.toHaveProperty("news");
  expect(found.history.length + found.segments.length).toBeGreaterThan(3);
  expect(found.parts.map(({ frame }) => frame)).toEqual([39]);
});

test.each([
  ["format", "structgstream"],
  ["format", undefined],
  ["version", 2],
  ["sequence", -1],
  ["sequence", "1"],
  ["live", 1],
  ["fps", null],
  ["target_latency_seconds", -1],
  ["target_latency_seconds", 1e300],
  ["frame_seconds", "4"],
  ["edge", []],
  ["edge.frame", 2 ** 32],
  ["edge.frame", 38],
  ["window.first_frame", 40],
  ["window.first_segment", 1e6],
  ["periods", []],
  ["periods.0.first_frame", 1],
  ["periods.0.period", 1],
  ["periods.0.bytes", 0],
  ["history", {}],
  ["history.0.level", 9],
  ["history.0.bytes", 2 ** 23],
  ["history.0.frames", 0],
  ["history.0.first_frame", 1],
  ["segments.0.segment", 0],
  ["segments.0.frames", 70_000],
  ["segments.0.pts_seconds", [2, 1]],
  ["segments.0.pts_seconds", [1]],
  ["segments.0.frame_bytes", [1, 2, 3]],
  ["segments.0.key_bytes", 1],
  ["segments.0.bytes", 2 ** 60],
  ["segments.0.sha256", "A".repeat(64)],
  ["segments", Array(5000).fill(0)],
  ["parts.0.kind", "other"],
  ["parts.0.frame", 41],
  ["parts.0.period", 7],
  ["live", false],
  ["__proto__", { a: 1 }],
] as const)("refused: %s %j", (path, value) => {
  if (path === "__proto__") expect(parsed(but(path, value)).live).toBe(true);
  else expect(() => parsed(but(path, value))).toThrow(/manifest\.json/);
});

const VECTORS = new URL("../../../../tests/vectors/", import.meta.url);
const GOLDEN = readFileSync(new URL("segments-1/manifest.json", VECTORS), "utf8");
type Rule = { readonly at: readonly (string | number)[]; readonly json: string; readonly taken: boolean };
const RULES = JSON.parse(readFileSync(new URL("manifest-rules.json", VECTORS), "utf8")) as readonly Rule[];

test.each(RULES)("the rules that the Python reader follows too: $at $json", ({ at, json, taken }) => {
  const plain = JSON.parse(GOLDEN) as Json;
  let place: Json = plain;
  for (const key of at.slice(0, -1)) place = place[key] as Json;
  place[at.at(-1)!] = "@";
  const value = json.replace(/<(.+?)\*(\d+)>/, (_, unit: string, times: string) => unit.repeat(Number(times)));
  const read = () => parsed(JSON.stringify(plain).replace('"@"', value));
  if (taken) expect(read().live).toBe(true);
  else expect(read).toThrow(/manifest\.json/);
});

test("a byte order mark and what is too long are refused", () => {
  const padded = (bytes: number) => () => parsed(GOLDEN.padEnd(bytes));
  expect(padded(2 ** 22)).not.toThrow();
  expect(padded(2 ** 22 + 1)).toThrow("expected at most 4194304");
  expect(() => parsed(`\u{feff}${GOLDEN}`)).toThrow("is no JSON");
  const listed = JSON.stringify({
    format: "structgstream-qualities",
    version: 1,
    qualities: [{ name: "a", manifest: "a/manifest.json", bits_per_second: 1 }],
  });
  expect(parsed(listed.padEnd(2 ** 16))).toHaveLength(1);
  expect(() => parsed(listed.padEnd(2 ** 16 + 1))).toThrow("expected at most 65536");
});

test.each([
  "../secret.sgs",
  "/etc/passwd",
  "https://elsewhere/x.sgs",
  "//elsewhere/x",
  "data:,x",
  "a/b.sgs",
  "a\\b.sgs",
  ".hidden",
  "..",
  "",
  "x?y",
  "x#y",
  "x%2fy",
  "x\n",
  "ü.sgs",
  "x".repeat(129),
  7,
])("a file may not be called %j", (file) => {
  for (const path of ["periods.0.file", "segments.0.file", "history.0.file", "parts.0.file"]) {
    const shown = path.replace(/\.0/, "[0]");
    expect(() => parsed(but(path, file))).toThrow(`manifest.json: ${shown} is `);
    expect(() => parsed(but(path, file))).toThrow("expected the plain name of a file in its folder");
  }
});

test("however a manifest is changed, it is taken or refused, and nothing else happens", () => {
  const good = RUN.files.get("manifest.json")!;
  let [taken, seed] = [0, 7];
  const next = (most: number) => {
    seed = (seed * 48271) % 2147483647;
    return seed % most;
  };
  for (let i = 0; i < 3000; i++) {
    const bytes = good.slice();
    for (let flips = next(3); flips >= 0; flips--) bytes[next(bytes.length)] = 32 + next(95);
    try {
      manifestIn(bytes, "manifest.json");
      taken++;
    } catch (error) {
      expect(error).toBeInstanceOf(SourceError);
    }
  }
  expect(taken).toBeGreaterThan(50);
  expect(taken).toBeLessThan(2950);
});

test("what is no JSON, or none of ours", () => {
  for (const text of [
    "",
    "{",
    "[]",
    "null",
    "7",
    "<html>",
    "[".repeat(100_000),
    '{"format":"structgstream-segments"}',
  ]) {
    expect(() => parsed(text)).toThrow(/manifest\.json/);
  }
});

test("messages quote no more of a hostile value than can be read", () => {
  try {
    parsed(but("name", "y".repeat(100_000)));
  } catch (error) {
    expect((error as Error).message.length).toBeLessThan(250);
  }
});

describe("pages", () => {
  const entry = (GOOD.history as PageEntry[]).at(-1)!;
  const page = JSON.parse(new TextDecoder().decode(RUN.files.get(entry.file)!)) as Json;

  test("are what is announced of them", () => {
    const found = pageIn(bytesOf(page), entry);
    expect(found.segments.length + found.pages.length).toBe(2);
  });

  test.each([
    ["first_frame", 1e6],
    ["first_segment", 77],
    ["frames", 1],
    ["segments", 1],
    ["level", 3],
  ])("or are refused: other %s", (name, value) => {
    expect(() => pageIn(bytesOf(page), { ...entry, [name]: value })).toThrow(entry.file);
  });
});

describe("qualities", () => {
  const list = (qualities: unknown) => bytesOf({ format: "structgstream-qualities", version: 1, qualities });

  test("are paths below the list", () => {
    const good = { manifest: "a/b/manifest.json", bits_per_second: 5, name: "a" };
    expect(manifestIn(list([good]), "q.json")).toEqual([good]);
    for (const manifest of ["../a.json", "a/../../b.json", "/a.json", "https://x/a.json", "a//b.json", "a/.b.json"]) {
      expect(() => manifestIn(list([{ ...good, manifest }]), "q.json")).toThrow("plain path");
    }
    for (const wrong of [[], Array(9).fill(good), [{ ...good, bits_per_second: 0 }], {}]) {
      expect(() => manifestIn(list(wrong), "q.json")).toThrow("q.json");
    }
  });
});

test("files are in the folder of their manifest; their addresses have its token and nothing else", () => {
  expect(siblingUrl("https://a/b/manifest.json?token=x%26y&after=3#z", "part-1.sgs")).toBe(
    "https://a/b/part-1.sgs?token=x%26y",
  );
  expect(siblingUrl("https://a/b/manifest.json", "low/manifest.json")).toBe("https://a/b/low/manifest.json");
});

test("a file is compared with what is stated of it", async () => {
  const [file, bytes] = [...RUN.files].find(([name]) => name.startsWith("init-"))!;
  const { sha256 } = (GOOD.periods as { sha256: string }[])[0]!;
  await verify(bytes, { file, bytes: bytes.length, sha256 });
  await expect(verify(bytes.slice(1), { file, bytes: bytes.length, sha256 })).rejects.toThrow("bytes; expected");
  const other = bytes.slice();
  other[50]! ^= 1;
  await expect(verify(other, { file, bytes: bytes.length, sha256 })).rejects.toThrow("SHA-256");
});
