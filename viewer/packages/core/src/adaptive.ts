// SPDX-License-Identifier: Apache-2.0
/** Arrays of a packet from adaptive decisions (docs/bitstream.md, sections Decisions and Rows). */

import { Arithmetic, type Model, type Models, NUMBER_NODES } from "./decisions.js";
import { StreamError } from "./errors.js";
import { type FieldName, fieldIn } from "./fields.js";

const LARGEST_NUMBER = 2 ** 31 - 1;
const LARGEST_RESIDUAL = 2 ** 23;
const BLOCK = 32;
const BLOCK_CONTEXTS = [90, 198];
const ACTIVITY_CONTEXTS = [255, 108, 360];
/** First row and step of a pass; decoded neighbours are at the distance of the first row; pass 0 has none. */
const PASSES = [
  [0, 16],
  [8, 16],
  [4, 8],
  [2, 4],
  [1, 2],
] as const;
const PAD = 24; // largest distance of a neighbour

/** Decodes one array after another; the part of a name before the dot is the field whose bytes are read. */
export class AdaptiveDecoder {
  private readonly codes: ReadonlyMap<string, Arithmetic>;

  /** @param where subject of error messages */
  constructor(
    private readonly models: Models,
    fields: ReadonlyMap<FieldName, Uint8Array>,
    private readonly where: string,
  ) {
    this.codes = new Map([...fields].map(([name, data]) => [name, new Arithmetic(data)]));
  }

  /** Which rows are active, `[n]`, given their history and the sizes of their last residuals. */
  activity(name: string, history: Uint8Array, sizes: Int32Array): Uint8Array {
    const count = history.length;
    const found = new Uint8Array(count + 2 * PAD);
    if (!count) return found.subarray(0, 0);
    const code = this.codeOf(name);
    const blocks = decodedBlocks(code, this.models.get(`${name}.blocks`, BLOCK_CONTEXTS, 1), history);
    const model = this.models.get(`${name}.rows`, ACTIVITY_CONTEXTS, 1);
    const before = new Int32Array(count + 1);
    for (let i = 0; i < count; i++) before[i + 1] = before[i]! + (history[i]! & 1);
    const moved = new Int32Array(count + 4);
    moved.set(sizes, 2);
    const contexts = new Int32Array(3);
    for (const [level, [first, step]] of PASSES.entries()) {
      for (let i = first; i < count; i += step) {
        if (!blocks[(i / BLOCK) | 0]) continue;
        const at = i + PAD;
        const near = level ? found[at - first]! + found[at + first]! : 0;
        const beyond = level ? found[at - 3 * first]! + found[at + 3 * first]! : 0;
        const wide = before[Math.min(i + 9, count)]! - before[Math.max(i - 8, 0)]! - (history[i]! & 1);
        const around = moved[i]! + moved[i + 1]! + moved[i + 3]! + moved[i + 4]!;
        contexts[0] = (wide * 3 + near) * 5 + level;
        contexts[1] = (bitLength(moved[i + 2]!, 5) * 3 + near) * 6 + bitLength(around, 5);
        contexts[2] = ((level * 3 + beyond) * 3 + near) * 8 + history[i]!;
        code.at(model, contexts, 0);
        found[at] = code.decide(model, 0);
      }
    }
    this.check(name, code);
    return found.subarray(PAD, PAD + count);
  }

  /** Residuals `[n, columns]` of active rows, given their last ones and the sizes `[n]` of groups before. */
  residuals(name: string, columns: number, last: Int32Array, others: Int32Array): Int32Array {
    const count = others.length;
    const found = new Int32Array(count * columns);
    if (!count) return found;
    const code = this.codeOf(name);
    const model = this.models.get(name, residualContexts(columns), NUMBER_NODES);
    const totals = new Int32Array(count);
    const moved = new Uint8Array(count);
    for (let i = 0; i < last.length; i++) if (last[i]) moved[(i / columns) | 0] = 1;
    const contexts = new Int32Array(6);
    for (let column = 0; column < columns; column++) {
      for (const [level, [first, step]] of PASSES.entries()) {
        for (let a = first; a < count; a += step) {
          const at = a * columns + column;
          const own = last[at]!;
          const above = level ? found[at - first * columns]! : 0;
          const below = level && a + first < count ? found[at + first * columns]! : 0;
          const around = Math.abs(above) + Math.abs(below);
          const left = column ? found[at - 1]! : 0;
          const off = column ? left - last[at - 1]! : 0;
          let led = 8 * (above + below);
          if (moved[a]) led = level ? 10 * own + 3 * (above + below) : 16 * own;
          const expected = sizeClass((Math.abs(led) + 4) >> 3);
          contexts[0] = (limited(own, 8) + 8) * columns + column;
          contexts[1] = (limited(above, 4) + 4) * 9 + limited(below, 4) + 4;
          contexts[2] = ((led < 0 ? -expected : expected) + 15) * 5 + level;
          contexts[3] = (Math.min(totals[a]!, 9) * 6 + Math.min(around, 5)) * columns + column;
          contexts[4] = (bitLength(others[a]!, 5) * columns + column) * 16 + sizeClass(2 * Math.abs(own) + around);
          contexts[5] = ((limited(left, 3) + 3) * 7 + limited(off, 3) + 3) * 7 + limited(own, 3) + 3;
          code.at(model, contexts, 0);
          const value = code.number(model);
          if (Math.abs(value) > LARGEST_RESIDUAL) this.damaged(name);
          found[at] = value;
        }
      }
      for (let a = 0; a < count; a++) totals[a] = Math.min(totals[a]! + Math.abs(found[a * columns + column]!), 9);
    }
    this.check(name, code);
    return found;
  }

  /** Flags, 1 or 0, `[n]`, with contexts below `count`. */
  flags(name: string, contexts: ArrayLike<number>, count: number): Uint8Array {
    return Uint8Array.from(
      this.each(name, Int32Array.from(contexts), [count], 1, (code, model) => code.decide(model, 0)),
    );
  }

  /** Signed numbers `[n]` of 32 bits with contexts `[n, inputs]` below `counts`. */
  numbers(name: string, contexts: Int32Array, counts: readonly number[]): Int32Array {
    return this.each(name, contexts, counts, NUMBER_NODES, (code, model) => code.number(model));
  }

  /** Check that all bytes were read. */
  end(): void {
    for (const [name, code] of this.codes) {
      if (!code.isWhole)
        throw new StreamError(`${this.where} has other bytes of ${name} than it should; it is damaged.`);
    }
  }

  private each(
    name: string,
    contexts: Int32Array,
    counts: readonly number[],
    nodes: number,
    decode: (code: Arithmetic, model: Model) => number,
  ): Int32Array {
    const found = new Int32Array(contexts.length / counts.length);
    if (!found.length) return found;
    const code = this.codeOf(name);
    const model = this.models.get(name, counts, nodes);
    for (let i = 0; i < found.length; i++) {
      code.at(model, contexts, i * counts.length);
      const value = decode(code, model);
      if (Math.abs(value) > LARGEST_NUMBER) this.damaged(name);
      found[i] = value;
    }
    this.check(name, code);
    return found;
  }

  private codeOf(name: string): Arithmetic {
    const code = this.codes.get(fieldIn(name));
    if (!code) throw new StreamError(`${this.where} holds no ${fieldIn(name)}; it is damaged.`);
    return code;
  }

  private check(name: string, code: Arithmetic): void {
    if (code.isOver) throw new StreamError(`${this.where} ends too early in ${fieldIn(name)}; it is damaged.`);
  }

  private damaged(name: string): never {
    throw new StreamError(`${this.where}, ${name}, holds a number out of bounds; it is damaged.`);
  }
}

/** The blocks of 32 rows with an active row. */
function decodedBlocks(code: Arithmetic, model: Model, history: Uint8Array): Uint8Array {
  const count = Math.ceil(history.length / BLOCK);
  const last = new Uint8Array(count + 2);
  const ever = new Uint8Array(count);
  for (let i = 0; i < history.length; i++) {
    const past = history[i]!;
    if (!past) continue;
    last[((i / BLOCK) | 0) + 1]! += past & 1;
    ever[(i / BLOCK) | 0]!++;
  }
  for (const [i, active] of last.entries()) last[i] = bitLength(active, 5);
  const found = new Uint8Array(count + 8);
  const contexts = new Int32Array(2);
  for (const [level, [first, step]] of PASSES.entries()) {
    for (let b = first; b < count; b += step) {
      const near = level ? found[b - first]! + found[b + first]! : 0;
      contexts[0] = (last[b + 1]! * 3 + near) * 5 + level;
      contexts[1] = (bitLength(ever[b]!, 5) * 11 + last[b]! + last[b + 2]!) * 3 + near;
      code.at(model, contexts, 0);
      found[b] = code.decide(model, 0);
    }
  }
  return found;
}

function residualContexts(columns: number): number[] {
  return [17 * columns, 81, 31 * 5, 60 * columns, 96 * columns, 343];
}

/** Number of binary digits, at most `most`. */
export function bitLength(value: number, most: number): number {
  return Math.min(32 - Math.clz32(value), most);
}

/** Size classes 0 to 15: one per size below 8, then two per octave. */
function sizeClass(size: number): number {
  if (size < 8) return size;
  const top = 31 - Math.clz32(size);
  return Math.min(2 * top + ((size >> (top - 1)) & 1) + 2, 15);
}

function limited(value: number, most: number): number {
  return Math.max(-most, Math.min(value, most));
}
