// SPDX-License-Identifier: Apache-2.0

import { decompress } from "fzstd";
import { expect, test } from "vitest";
import { blocksIn } from "../src/blocks.ts";
import { unpackedHeader } from "../src/initRecord.ts";
import { unpackedJson } from "../src/json.ts";
import { viewOf } from "../src/records.ts";
import { bytesOf, FIXTURES, joined, piecesOf, VECTORS } from "./streams.ts";

// biome-ignore lint/suspicious/noExplicitAny: tests put anything anywhere
type Description = any;

/** One zstd frame that states `size` and holds `text` as it is. */
function frame(text: string, size?: number): Uint8Array {
  const bytes = new TextEncoder().encode(text);
  const head = new Uint8Array(12);
  const view = viewOf(head);
  view.setUint32(0, 0xfd2fb528, true);
  head[4] = 0xa0; // one segment, four bytes of size
  view.setUint32(5, size ?? bytes.length, true);
  const block = 1 | (bytes.length << 3);
  head.set([block & 255, (block >> 8) & 255, block >> 16], 9);
  return joined(head, bytes);
}

/** The init payload of a stream with a description that has been edited. */
function edited(folder: URL, name: string, edit: (description: Description) => void): Uint8Array {
  const payload = piecesOf(bytesOf(folder, name))[1]!.slice(8, -4);
  const end = 4 + viewOf(payload).getUint32(0, true);
  const description = JSON.parse(Buffer.from(decompress(payload.slice(4, end))).toString());
  edit(description);
  const packed = frame(JSON.stringify(description));
  const length = new Uint8Array(4);
  viewOf(length).setUint32(0, packed.length, true);
  return joined(length, packed, payload.slice(end));
}

const raw = (edit: (d: Description) => void) => () => unpackedHeader(edited(VECTORS, "version-2.sgs", edit));
const compact = (edit: (d: Description) => void) => () => unpackedHeader(edited(FIXTURES, "tiny.sgs", edit));

test("keys that are not known are ignored", () => {
  const header = raw((d) => {
    d.later = { cameras: 3 };
    d.cameras[0].serial = "7";
  })();
  expect(header.cameras.length).toBe(3);
  expect([...compact(() => {})().steps.keys()]).toContain("free_colors");
});

test.each<[string, (d: Description) => void]>([
  ["coded with 'later'; this version knows 'raw' and 'compact'", (d) => Object.assign(d, { codec: "later" })],
  ["holds field base_scales as it is, where it should be coded", (d) => Object.assign(d, { codec: "compact" })],
  ["codec must be a text", (d) => Object.assign(d, { codec: 3 })],
  ["fps must be positive", (d) => Object.assign(d, { fps: 0 })],
  ["fps must be a finite number", (d) => Object.assign(d, { fps: "30" })],
  ["at least two not held out", (d) => Object.assign(d.cameras[0], { held_out: true })],
  ["camera names must be used once", (d) => Object.assign(d.cameras[0], { name: "right" })],
  ["held_out must be true or false", (d) => Object.assign(d.cameras[0], { held_out: undefined })],
  ["side of a picture must be 1 to 65535", (d) => Object.assign(d.cameras[0], { width: 65536 })],
  ["side of a picture must be 1 to 65535", (d) => Object.assign(d.cameras[0], { height: 1.5 })],
  ["pixels of a picture must be at most 67108864", (d) => Object.assign(d.cameras[0], { width: 8192, height: 8193 })],
  ["K must be 9 numbers", (d) => d.cameras[0].K.pop()],
  ["focal lengths must be positive", (d) => d.cameras[0].K.fill(0)],
  ["viewmat must be a list", (d) => Object.assign(d.cameras[0], { viewmat: {} })],
  ["viewmat must be rigid", (d) => d.cameras[0].viewmat.splice(0, 1, 1.01)],
  ["viewmat must be rigid", (d) => d.cameras[0].viewmat.splice(0, 1, -1)],
  ["near must be positive", (d) => Object.assign(d.cameras[0], { near: -1 })],
  ["similarity.center must be 3 numbers", (d) => d.similarity.center.push(1)],
  ["config must be an object", (d) => Object.assign(d, { config: [] })],
  ["metadata must be an object", (d) => Object.assign(d, { metadata: null })],
  ["distance_input must be true or false", (d) => Object.assign(d, { distance_input: 1 })],
  ["lists field 'hair' in dynamic, which this version does not know", (d) => d.dynamic.push("hair")],
  ["a field in dynamic must be a text", (d) => d.dynamic.push(3)],
  ["does not hold every field that packets leave out", (d) => d.dynamic.pop()],
  ["dynamic fields, which codec 'raw' has no use for", (d) => d.dynamic.push("camera_color")],
  [
    "field camera_color as (2, 6), which does not fit the others; expected (3, 6)",
    (d) => Object.assign(d.cameras[1], { held_out: false }),
  ],
  ["an MLP of 29 weights", (d) => Object.assign(d, { distance_input: false })],
])("a raw header is refused: %s", (message, edit) => {
  expect(raw(edit)).toThrow(message);
});

test.each<[string, (d: Description) => void]>([
  ["states no step for free_quats", (d) => delete d.steps.free_quats],
  ["states no step for anchor_positions", (d) => delete d.steps.anchor_positions],
  ["steps.free_means must be a float32 number", (d) => Object.assign(d.steps, { free_means: 0.1 })],
  ["steps.free_means must be a float32 number", (d) => Object.assign(d.steps, { free_means: 2 ** -65 })],
  ["steps must be an object", (d) => Object.assign(d, { steps: [] })],
  ["states no step for color_mlp in the init record", (d) => delete d.init_steps.color_mlp],
  ["states no step for base_scales in the init record", (d) => delete d.init_steps],
  ["init_steps.color_mlp must be a float32 number", (d) => Object.assign(d.init_steps, { color_mlp: 0.1 })],
  ["init_steps must be an object", (d) => Object.assign(d, { init_steps: [] })],
  ["holds field base_scales coded, where it should be as it is", (d) => Object.assign(d, { codec: "raw" })],
  ["coded with 'later'; this version knows 'raw' and 'compact'", (d) => Object.assign(d, { codec: "later" })],
  ["no coding for camera_color", (d) => d.dynamic.push("camera_color")],
])("a compact header is refused: %s", (message, edit) => {
  expect(compact(edit)).toThrow(message);
});

test("a compact header whose fields do not go with each other", () => {
  const births = Uint8Array.of(10, 0, 1, 1, 0, 0, 0, 0); // none, as a static field
  const alone = edited(FIXTURES, "tiny.sgs", (d) => d.dynamic.splice(d.dynamic.indexOf("free_births"), 1));
  expect(() => unpackedHeader(joined(alone, births))).toThrow("free Gaussians without their births");
  const whole = edited(FIXTURES, "tiny.sgs", () => {});
  const { start, end } = blocksIn(whole, 4 + viewOf(whole).getUint32(0, true), "It").at(-1)!;
  const less = joined(whole.slice(0, start), whole.slice(end));
  expect(() => unpackedHeader(less)).toThrow("reference state does not hold the dynamic fields");
});

test("a description is looked at before it is unpacked", () => {
  expect(unpackedJson(frame('{"a":[1,"ä"]}'))).toEqual({ a: [1, "ä"] });
  expect(() => unpackedJson(frame("{}", 2 ** 20 + 1))).toThrow("states 1048577 bytes unpacked");
  const none = frame("{}");
  none[4] = 0;
  expect(() => unpackedJson(none)).toThrow("states no bytes unpacked");
  expect(() => unpackedJson(new Uint8Array(3))).toThrow("states no bytes unpacked");
  expect(() => unpackedJson(frame("{}", 3))).toThrow("cannot be read");
  expect(() => unpackedJson(frame("{}").subarray(0, -1))).toThrow("cannot be read");
  expect(() => unpackedJson(frame('{"a":NaN}'))).toThrow("cannot be read");
  expect(() => unpackedJson(joined(frame("{}").subarray(0, -2), Uint8Array.of(0x22, 0xff)))).toThrow("cannot be read");
});
