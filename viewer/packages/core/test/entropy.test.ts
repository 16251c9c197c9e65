// SPDX-License-Identifier: Apache-2.0
/** The examples of docs/entropy.md, and what it calls damage. */

import { expect, test } from "vitest";
import { BitReader } from "../src/bits.ts";
import { Decoder } from "../src/coder.ts";
import { Arithmetic, Model, NUMBER_NODES } from "../src/decisions.ts";
import { StreamError } from "../src/errors.ts";
import { decodedSymbols } from "../src/rans.ts";
import { decodedTables, geometricRow } from "../src/tables.ts";

const SECTION = Uint8Array.of(0x04, 0x04, 0x00, 0xb8, 0x97, 0x00, 0x01, 0x50);
const TABLES = { contexts: 2, alphabet: 2, rows: Uint16Array.of(3072, 1024, 3, 4093) };
const CONTEXTS = Uint8Array.of(0, 0, 1, 1);

function symbols(section: Uint8Array, contexts = CONTEXTS): Uint8Array {
  return decodedSymbols(section, contexts, TABLES, "It").symbols;
}

test("symbols", () => {
  expect([...symbols(SECTION)]).toEqual([0, 1, 0, 0]);
});

test("a section of another number of symbols, with a lane code 3, or with one bit changed in its states", () => {
  expect(() => symbols(SECTION, CONTEXTS.subarray(1))).toThrow("It states 4 symbols, 3 are expected; it is damaged.");
  const lanes = SECTION.slice();
  lanes[1] = 7;
  expect(() => symbols(lanes)).toThrow("It states 4 symbols in 1 words; it is damaged.");
  for (let bit = 0; bit < 32; bit++) {
    const states = SECTION.slice();
    states[2 + (bit >> 3)]! ^= 1 << (bit & 7);
    expect(() => symbols(states)).toThrow("It is damaged: its words and final states contradict each other.");
  }
  for (let end = 0; end < SECTION.length; end++) expect(() => symbols(SECTION.subarray(0, end))).toThrow(StreamError);
});

test("an explicit row against the previous one", () => {
  const previous = { contexts: 1, alphabet: 4, rows: Uint16Array.of(3072, 512, 512, 0) };
  const set = Uint8Array.of(0xc8, 0x2b, 0x20);
  expect([...decodedTables(set, previous, "It").rows]).toEqual([3072, 768, 256, 0]);
  expect([...previous.rows]).toEqual([3072, 512, 512, 0]);
  set[2]! |= 1;
  expect(() => decodedTables(set, previous, "It")).toThrow("It goes on after its last number; it is damaged.");
  expect(() => decodedTables(new Uint8Array(73), previous, "It")).toThrow("It has 73 bytes for 1 contexts");
});

test("the geometric family", () => {
  const row = new Uint16Array(5);
  geometricRow(100, row);
  expect([...row]).toEqual([3644, 145, 145, 81, 81]);
  for (let number = 0; number < 256; number++) {
    const longest = new Uint16Array(32);
    geometricRow(number, longest);
    expect(longest.reduce((sum, frequency) => sum + frequency)).toBe(4096);
  }
});

test("residuals beyond 7", () => {
  const read = (symbol: number, more: number) => {
    const section = Uint8Array.of(0x02, 0xb7, 0x80, 0x01, 0x00, 0xf0 + symbol, 0x0f, 0x00, 0x10, more);
    return new Decoder(new Map([["anchor_offsets", section]]), "It").residuals(
      "anchor_offsets.step",
      new Uint8Array(1),
      1,
    );
  };
  expect([...read(14, 0)]).toEqual([7]);
  expect(() => read(15, 0)).toThrow("It, anchor_offsets.step, holds a residual beyond 7; it is damaged.");
  expect(() => read(14, 1)).toThrow("It, anchor_offsets.step, holds a residual beyond 7; it is damaged.");
});

test("more zeros than an Exp-Golomb code may have, and a cut one", () => {
  expect(new BitReader(Uint8Array.of(0b00010110), "It").signedGolomb(0, 3)).toBe(5);
  expect(new BitReader(Uint8Array.of(0b00010100), "It").signedGolomb(0, 3)).toBe(-5);
  expect(() => new BitReader(Uint8Array.of(0b00010110), "It").golomb(0, 2)).toThrow("cut or out of bounds");
  expect(() => new BitReader(Uint8Array.of(0b00000001), "It").golomb(0, 8)).toThrow("ends within a number");
  expect(() => new BitReader(Uint8Array.of(0), "It").golomb(0, 8)).toThrow("cut or out of bounds");
});

test("decisions: numbers with one input of two contexts", () => {
  const model = new Model([2], NUMBER_NODES);
  const code = new Arithmetic(Uint8Array.of(0x92, 0xa5, 0xec, 0x05));
  const found = [0, 0, 1, 1, 0].map((context) => {
    code.at(model, Int32Array.of(context), 0);
    return code.number(model);
  });
  expect(found).toEqual([0, 3, -1, 20, 0]);
  expect(code.isWhole).toBe(true);
  expect(code.isOver).toBe(false);
  for (let i = 0; i < 9; i++) code.number(model);
  expect(code.isWhole).toBe(false);
  expect(new Arithmetic(new Uint8Array(0)).isWhole).toBe(true);
  expect(new Arithmetic(new Uint8Array(1)).isWhole).toBe(false);
});
