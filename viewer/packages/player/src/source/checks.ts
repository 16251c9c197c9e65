// SPDX-License-Identifier: Apache-2.0
/** Values of JSON that may come from a hostile host: each is checked for its type and bounds before it is used. */

import { SourceError } from "./byteSource.js";

/** Returns the value with its checked type; `where` names it in messages. */
export type Check<Value> = (value: unknown, where: string) => Value;

type Shaped<Shape extends Readonly<Record<string, Check<unknown>>>> = {
  readonly [Name in keyof Shape]: ReturnType<Shape[Name]>;
};

/** @throws SourceError always */
export function refuse(where: string, value: unknown, expected: string): never {
  const text = JSON.stringify(value) ?? "missing";
  throw new SourceError(`${where} is ${text.length > 60 ? `${text.slice(0, 60)}...` : text}; expected ${expected}.`);
}

function checked<Value>(holds: (value: unknown) => boolean, expected: string): Check<Value> {
  return (value, where) => (holds(value) ? (value as Value) : refuse(where, value, expected));
}

export function whole(least = 0, most = 2 ** 32 - 1): Check<number> {
  const holds = (value: unknown) => Number.isInteger(value) && (value as number) >= least && (value as number) <= most;
  return checked(holds, `a whole number from ${least} to ${most}`);
}

export function number(least = -1e15): Check<number> {
  const holds = (value: unknown) => typeof value === "number" && value >= least && value <= 1e15;
  return checked(holds, least < 0 ? "a finite number" : `a number from ${least} to 1e15`);
}

export const flag: Check<boolean> = checked((value) => typeof value === "boolean", "true or false");

/** A text of Unicode characters without lone surrogates, which JSON may contain. */
export const text: Check<string> = checked(
  (value) => typeof value === "string" && [...value].length <= 1000 && !/\p{Cs}/u.test(value),
  "a text of at most 1000 characters",
);

/** A text that matches a regular expression completely. */
export function like(pattern: RegExp, expected: string): Check<string> {
  return checked((value) => typeof value === "string" && pattern.test(value), expected);
}

export function orNull<Value>(check: Check<Value>): Check<Value | null> {
  return (value, where) => (value === null ? null : check(value, where));
}

export function list<Value>(check: Check<Value>, most: number): Check<Value[]> {
  return (value, where) => {
    if (!Array.isArray(value) || value.length > most) refuse(where, value, `a list of at most ${most}`);
    return value.map((entry, i) => check(entry, `${where}[${i}]`));
  };
}

/** Two numbers, the second not below the first. */
export const span: Check<readonly [number, number]> = (value, where) => {
  const found = list(number(), 2)(value, where);
  if (found.length !== 2 || found[0]! > found[1]!) refuse(where, value, "two numbers that do not fall");
  return found as [number, number];
};

/** An object with these fields; others are removed. */
export function shaped<Shape extends Readonly<Record<string, Check<unknown>>>>(shape: Shape): Check<Shaped<Shape>> {
  return (value, where) => {
    if (typeof value !== "object" || value === null || Array.isArray(value)) refuse(where, value, "an object");
    const fields = Object.entries(shape).map(([name, check]) => [
      name,
      check(Object.hasOwn(value, name) ? (value as Record<string, unknown>)[name] : undefined, fieldOf(where, name)),
    ]);
    return Object.fromEntries(fields) as Shaped<Shape>;
  };
}

/** Name of a field in messages: `manifest.json: parts[0].file`. */
export function fieldOf(where: string, name: string): string {
  return where.includes(": ") ? `${where}.${name}` : `${where}: ${name}`;
}

/**
 * The value of a JSON text in UTF-8 without a byte order mark.
 *
 * @throws SourceError it is not JSON
 */
export function parsedJson(bytes: Uint8Array, where: string): unknown {
  try {
    return JSON.parse(new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(bytes));
  } catch {
    throw new SourceError(`${where} is no JSON: it was cut or changed, or is something else.`);
  }
}
