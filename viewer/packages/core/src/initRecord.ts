// SPDX-License-Identifier: Apache-2.0
/** Reads a header from the init record (docs/bitstream.md, section Init record). */

import { fieldsIn } from "./blocks.js";
import { checkCodec } from "./compact.js";
import { StreamError } from "./errors.js";
import { checkShapes, type FieldName, type Fields, isFieldName, isScene, mergedFields, type Tensor } from "./fields.js";
import type { Camera, StreamHeader } from "./header.js";
import { unpackedJson } from "./json.js";
import { viewOf } from "./records.js";
import type { SoundFormat } from "./sound.js";
import { AS_THEY_ARE, decodedFields } from "./staticFields.js";

const LENGTH_BYTES = 4;
const MAX_IMAGE_SIDE = 65535;
const MAX_IMAGE_PIXELS = 2 ** 26;
const MIN_STEP = 2 ** -64;
const RIGID = 1e-3;

/**
 * The header of an init record's payload.
 *
 * @throws StreamError the payload contradicts the format, or has a codec that this version does not know
 */
export function unpackedHeader(payload: Uint8Array): StreamHeader {
  if (payload.length < LENGTH_BYTES) throw new StreamError("The init record is too short.");
  const end = LENGTH_BYTES + viewOf(payload).getUint32(0, true);
  if (end > payload.length) throw new StreamError("The init record states a longer description than it holds.");
  const description = object(unpackedJson(payload.subarray(LENGTH_BYTES, end)), "the description");
  const codec = text(description.codec, "codec");
  // Before its fields, which another codec may store otherwise.
  if (codec !== "raw" && codec !== "compact") {
    throw new StreamError(
      `The stream is coded with '${codec}'; this version knows 'raw' and 'compact'. Use a newer one.`,
    );
  }
  const header = headerOf(description, codec, fieldsOf(description, codec, payload, end));
  if (!isScene(new Set([...header.dynamic, ...header.static.keys()]))) {
    throw new StreamError("The init record does not hold every field that packets leave out, and only those.");
  }
  checkShapes(new Map([...header.static, ...header.reference]), header, "The init record");
  checkCodec(header);
  return header;
}

/** With `compact`, nearly all fields are coded; with `raw` none is. */
function fieldsOf(description: Record<string, unknown>, codec: string, payload: Uint8Array, start: number): Fields {
  const isCompact = codec === "compact";
  const isCoded = (name: FieldName) => isCompact && !AS_THEY_ARE.has(name);
  const { values, coded } = fieldsIn(payload, start, "The init record", isCoded);
  if (!isCompact) return values;
  return mergedFields(values, decodedFields(coded, stepsOf(description.init_steps, "init_steps")));
}

function headerOf(description: Record<string, unknown>, codec: string, fields: Fields): StreamHeader {
  const cameras = list(description.cameras, "cameras").map(cameraOf);
  if (new Set(cameras.map((camera) => camera.name)).size !== cameras.length) throw wrong("camera names", "used once");
  if (cameras.filter((camera) => !camera.heldOut).length < 2) throw wrong("cameras", "at least two not held out");
  const similarity = object(description.similarity, "similarity");
  const dynamic = new Set(list(description.dynamic, "dynamic").map(fieldNameOf));
  return {
    cameras,
    similarity: {
      center: numbers(similarity.center, 3, "similarity.center") as [number, number, number],
      scale: positive(similarity.scale, "similarity.scale"),
    },
    fps: positive(description.fps, "fps"),
    codec,
    dynamic,
    static: selected(fields, (name) => !dynamic.has(name)),
    reference: selected(fields, (name) => dynamic.has(name)),
    steps: stepsOf(description.steps, "steps"),
    distanceInput: flag(description.distance_input, "distance_input"),
    config: object(description.config, "config"),
    metadata: object(description.metadata, "metadata"),
    sound: description.sound === undefined ? undefined : soundFormat(object(description.sound, "sound")),
  };
}

function soundFormat({ codec, channels }: Record<string, unknown>): SoundFormat {
  if (codec === "opus" && channels !== 1 && channels !== 2) throw wrong("sound.channels", "1 or 2");
  return { codec: text(codec, "sound.codec"), channels: Number(channels) };
}

function selected(fields: Fields, wanted: (name: FieldName) => boolean): Map<FieldName, Tensor> {
  return new Map([...fields].filter(([name]) => wanted(name)));
}

function cameraOf(value: unknown): Camera {
  const entry = object(value, "a camera");
  const viewmat = numbers(entry.viewmat, 16, "viewmat");
  const K = numbers(entry.K, 9, "K");
  if (!isRotation([0, 4, 8].map((row) => viewmat.slice(row, row + 3)))) throw wrong("viewmat", "rigid");
  const [width, height] = [imageSide(entry.width), imageSide(entry.height)];
  if (width * height > MAX_IMAGE_PIXELS) throw wrong("the pixels of a picture", `at most ${MAX_IMAGE_PIXELS}`);
  if (K[0]! <= 0 || K[4]! <= 0) throw wrong("focal lengths", "positive");
  return {
    name: text(entry.name, "a camera's name"),
    viewmat,
    K,
    width,
    height,
    near: positive(entry.near, "near"),
    heldOut: flag(entry.held_out, "held_out"),
  };
}

function isRotation(rows: number[][]): boolean {
  const [a, b, c] = rows as [number[], number[], number[]];
  const dot = (x: number[], y: number[]) => x[0]! * y[0]! + x[1]! * y[1]! + x[2]! * y[2]!;
  const cross = [b[1]! * c[2]! - b[2]! * c[1]!, b[2]! * c[0]! - b[0]! * c[2]!, b[0]! * c[1]! - b[1]! * c[0]!];
  const orthonormal = rows.every((x, i) => rows.every((y, j) => Math.abs(dot(x, y) - Number(i === j)) <= RIGID));
  return orthonormal && dot(a, cross) > 0;
}

function wrong(what: string, expected: string): StreamError {
  return new StreamError(`The init record does not follow the format: ${what} must be ${expected}.`);
}

function object(value: unknown, what: string): Record<string, unknown> {
  if (typeof value !== "object" || value === null || Array.isArray(value)) throw wrong(what, "an object");
  return value as Record<string, unknown>;
}

function list(value: unknown, what: string): unknown[] {
  if (!Array.isArray(value)) throw wrong(what, "a list");
  return value;
}

function text(value: unknown, what: string): string {
  if (typeof value !== "string") throw wrong(what, "a text");
  return value;
}

function flag(value: unknown, what: string): boolean {
  if (typeof value !== "boolean") throw wrong(what, "true or false");
  return value;
}

function number(value: unknown, what: string): number {
  if (typeof value !== "number" || !Number.isFinite(value)) throw wrong(what, "a finite number");
  return value;
}

function positive(value: unknown, what: string): number {
  if (number(value, what) <= 0) throw wrong(what, "positive");
  return value as number;
}

function numbers(value: unknown, count: number, what: string): number[] {
  const found = list(value, what);
  if (found.length !== count) throw wrong(what, `${count} numbers`);
  return found.map((entry) => number(entry, what));
}

function imageSide(value: unknown): number {
  const side = number(value, "the side of a picture");
  if (!Number.isInteger(side) || side < 1 || side > MAX_IMAGE_SIDE) {
    throw wrong("the side of a picture", `1 to ${MAX_IMAGE_SIDE}`);
  }
  return side;
}

function stepsOf(value: unknown, what: string): Map<string, number> {
  const steps = Object.entries(object(value ?? {}, what));
  return new Map(steps.map(([name, step]) => [name, stepOf(step, `${what}.${name}`)]));
}

function stepOf(value: unknown, what: string): number {
  const step = number(value, what);
  if (step < MIN_STEP || step > 1 / MIN_STEP || Math.fround(step) !== step) {
    throw wrong(what, "a float32 number from 2^-64 to 2^64");
  }
  return step;
}

function fieldNameOf(value: unknown): FieldName {
  const name = text(value, "a field in dynamic");
  if (!isFieldName(name)) {
    throw new StreamError(
      `The init record lists field '${name}' in dynamic, which this version does not know; use a newer one.`,
    );
  }
  return name;
}
