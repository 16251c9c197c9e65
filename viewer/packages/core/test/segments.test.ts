// SPDX-License-Identifier: Apache-2.0
/** The golden segments (docs/segments.md), which the Python writer made: in order they are the golden stream. */

import { createHash } from "node:crypto";
import { readdirSync } from "node:fs";
import { expect, test } from "vitest";
import { readStream } from "../src/reader.ts";
import { bytesOf, joined, VECTORS } from "./streams.ts";

interface Entry {
  file: string;
  bytes: number;
  sha256: string;
}

interface Segment extends Entry {
  first_frame: number;
  frame_bytes: number[];
}

interface Manifest {
  live: boolean;
  edge: { frame: number };
  periods: Entry[];
  segments: Segment[];
  parts: (Entry & { frame: number; kind: string })[];
}

const FOLDER = new URL("segments-1/", VECTORS);
const MANIFEST: Manifest = JSON.parse(Buffer.from(bytesOf(FOLDER, "manifest.json")).toString());
const ENTRIES = [...MANIFEST.periods, ...MANIFEST.segments, ...MANIFEST.parts];

test("every file is what the manifest states, and there is no other", () => {
  for (const entry of ENTRIES) {
    const content = bytesOf(FOLDER, entry.file);
    expect(content.length).toBe(entry.bytes);
    expect(createHash("sha256").update(content).digest("hex")).toBe(entry.sha256);
    expect(entry.file).toContain(entry.sha256.slice(0, 16));
  }
  expect(readdirSync(FOLDER).sort()).toEqual([...ENTRIES.map((entry) => entry.file), "manifest.json"].sort());
});

test("init record, segments and parts are the beginning of the stream, up to the edge", () => {
  const found = joined(...ENTRIES.map((entry) => bytesOf(FOLDER, entry.file)));
  const whole = bytesOf(VECTORS, "version-2-compact.sgs");
  expect(found).toEqual(whole.subarray(0, found.length));
  expect(readStream(found).packets.length).toBe(MANIFEST.edge.frame + 1);
  expect(readStream(whole).packets.length).toBe(MANIFEST.edge.frame + 1);
  expect(MANIFEST.live).toBe(true);
});

test("the lengths of frames cut a segment into its records", () => {
  for (const segment of MANIFEST.segments) {
    const content = bytesOf(FOLDER, segment.file);
    expect(segment.frame_bytes.reduce((sum, size) => sum + size, 0)).toBe(content.length);
    let at = 0;
    for (const size of segment.frame_bytes) {
      expect([2, 3]).toContain(content[at]);
      at += size;
    }
  }
});
