// SPDX-License-Identifier: Apache-2.0
/** Arrays of integers from the sections of the init record's fields (docs/bitstream.md, Coded init fields). */

import { BitReader } from "./bits.js";
import { StreamError } from "./errors.js";
import { type FieldName, fieldIn } from "./fields.js";
import { decodedSymbols } from "./rans.js";
import { decodedTables, type FrequencyTables, geometric } from "./tables.js";

const RESIDUAL_ALPHABET = 16; // 0, -1, 1 ... -7, 7; the last symbol is not used
const CLASSES = 32; // bit lengths of natural numbers below 2^31
const FLAT = 128; // geometric row of a context that has not occurred

/** Decodes one section after another; the part of a name before the dot is the field whose bytes are read. */
export class Decoder {
  private readonly left: Map<string, Uint8Array>;
  /** By name of a section, as its last occurrence left them. */
  private readonly tables = new Map<string, FrequencyTables>();

  /** @param where subject of error messages */
  constructor(
    fields: ReadonlyMap<FieldName, Uint8Array>,
    private readonly where: string,
  ) {
    this.left = new Map(fields);
  }

  /** Signed numbers `[n]` from -7 to 7. */
  residuals(name: string, contexts: Uint8Array, count: number): Int32Array {
    const symbols = this.section(name, contexts, count, RESIDUAL_ALPHABET);
    if (this.number(name) || symbols.includes(RESIDUAL_ALPHABET - 1)) {
      throw new StreamError(`${this.where}, ${name}, holds a residual beyond 7; it is damaged.`);
    }
    return Int32Array.from(symbols, (symbol) => (symbol & 1 ? -((symbol + 1) >> 1) : symbol >> 1));
  }

  /** Numbers `[n]` from 0 to below 2^31. */
  naturals(name: string, contexts: Uint8Array, count: number): Int32Array {
    const sizes = this.section(name, contexts, count, CLASSES);
    let bits = 0;
    for (const size of sizes) bits += Math.max(size - 1, 0);
    const reader = new BitReader(this.taken(name, Math.ceil(bits / 8)), `${this.where}, ${name},`);
    const found = new Int32Array(sizes.length);
    for (let i = 0; i < found.length; i++) {
      const size = sizes[i]!;
      if (size) found[i] = (1 << (size - 1)) + reader.fixed(size - 1);
    }
    reader.end();
    return found;
  }

  /** One number from 0 to below 2^32. */
  number(name: string): number {
    let value = 0;
    for (let place = 0; place < 5; place++) {
      const byte = this.taken(name, 1)[0]!;
      value += (byte & 127) * 2 ** (7 * place);
      if (byte < 128 && value < 2 ** 32) return value;
      if (byte < 128) break;
    }
    throw new StreamError(`${this.where}, ${name}, holds a number beyond 32 bits; it is damaged.`);
  }

  /** Check that nothing remains. */
  end(): void {
    for (const [name, data] of this.left) {
      if (data.length) {
        throw new StreamError(`${this.where} has more bytes of ${name} than it should; it is damaged.`);
      }
    }
  }

  private section(name: string, contexts: Uint8Array, count: number, alphabet: number): Uint8Array {
    const where = `${this.where}, ${name},`;
    const before = this.tables.get(name) ?? geometric(FLAT, count, alphabet);
    const tables = decodedTables(this.taken(name, this.number(name)), before, where);
    this.tables.set(name, tables);
    const { symbols, bytes } = decodedSymbols(this.leftOf(name), contexts, tables, where);
    this.taken(name, bytes);
    return symbols;
  }

  private leftOf(name: string): Uint8Array {
    return this.left.get(fieldIn(name)) ?? new Uint8Array(0);
  }

  private taken(name: string, size: number): Uint8Array {
    const data = this.leftOf(name);
    if (size > data.length) {
      const missing = size - data.length;
      throw new StreamError(`${this.where} ends ${missing} bytes too early in ${fieldIn(name)}; it is damaged.`);
    }
    this.left.set(fieldIn(name), data.subarray(size));
    return data.subarray(0, size);
  }
}
