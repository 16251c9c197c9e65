// SPDX-License-Identifier: Apache-2.0
/** Adaptive binary decisions, whose probabilities follow the decoded data (docs/entropy.md, section Decisions). */

const HALF = 1 << 15;
const LEAST = 32;
const MOST = 65536 - 32;
const FAR = 1983;
const WEIGHT_LIMIT = (1 << 19) - 1;
const NEAR_SIZES = 6; // sizes with a decision of their own
const LENGTH_NODES = 9; // bit lengths of larger sizes with a decision of their own
const LENGTHS = 30;
const AHEAD = 3;

/** Number of nodes of a number's decisions. */
export const NUMBER_NODES = 2 + NEAR_SIZES + LENGTH_NODES;

/** 65536 / (1 + exp(-j / 4)), rounded. */
const SQUASHED = [
  32768, 36843, 40793, 44511, 47911, 50941, 53581, 55834, 57724, 59287, 60565, 61598, 62428, 63090, 63615, 64030, 64357,
  64614, 64816, 64974, 65097, 65194, 65269, 65328, 65374, 65410, 65438, 65459, 65476, 65489, 65500, 65508,
];

/** Probability, in 1/65536, of a logit in 1/256, by `logit + FAR`. */
const CHANCES = Uint16Array.from({ length: 2 * FAR + 1 }, (_, i) => {
  const size = Math.abs(i - FAR);
  const place = size >> 6;
  const chance = SQUASHED[place]! + (((SQUASHED[place + 1]! - SQUASHED[place]!) * (size & 63)) >> 6);
  return clamped(i < FAR ? 65536 - chance : chance, LEAST, MOST);
});

/** Logit of each probability in 1/4096: the lowest whose probability is not below the middle. */
const LOGITS = new Int16Array(4096);
for (let i = 0, place = 0; i < LOGITS.length; i++) {
  while (place < 2 * FAR && CHANCES[place]! < 16 * i + 8) place++;
  LOGITS[i] = place - FAR;
}

/** Adaptation rate of the `seen`th decision, in 1/65536. */
const SHARES = Int32Array.from({ length: 256 }, (_, seen) => Math.floor(65536 / (seen + 2)));

/** A model of decisions, updated by each of them. `counts` are the numbers of contexts of each input. */
export class Model {
  readonly chances: Uint16Array;
  readonly seen: Uint8Array;
  readonly weights: Int32Array;
  readonly starts: Int32Array;

  constructor(
    readonly counts: readonly number[],
    readonly nodes: number,
    other?: Model,
  ) {
    const rows = counts.reduce((sum, count) => sum + count, 0);
    const inputs = counts.length;
    this.chances = other ? other.chances.slice() : new Uint16Array(rows * nodes).fill(HALF);
    this.seen = other ? other.seen.slice() : new Uint8Array(rows * nodes);
    this.weights = other ? other.weights.slice() : new Int32Array(nodes * inputs).fill(Math.floor(65536 / inputs));
    this.starts = new Int32Array(inputs);
    for (let k = 1; k < inputs; k++) this.starts[k] = this.starts[k - 1]! + counts[k - 1]!;
  }
}

/** The models after a packet, by name. An object that is created from another changes copies of its models. */
export class Models {
  private readonly now = new Map<string, Model>();
  private readonly before: ReadonlyMap<string, Model>;

  constructor(others?: Models) {
    this.before = new Map(others && [...others.before, ...others.now]);
  }

  get(name: string, counts: readonly number[], nodes: number): Model {
    let found = this.now.get(name);
    if (!found) {
      const known = this.before.get(name);
      found = new Model(known?.counts ?? counts, nodes, known);
      this.now.set(name, found);
    }
    return found;
  }
}

/** The arithmetic code of one field. Bytes after the end are zeros. */
export class Arithmetic {
  private place = 0;
  private range = 0; // as a signed number of 32 bits; 0 before the first decision
  private low = 0;
  private readonly logits = new Int32Array(8);
  private readonly rows = new Int32Array(8);

  constructor(private readonly data: Uint8Array) {}

  /** Whether exactly the bytes of the field were read. */
  get isWhole(): boolean {
    return this.range ? this.place === this.data.length + AHEAD : !this.data.length;
  }

  /** Whether more bytes were read than an encoder can have written. */
  get isOver(): boolean {
    return this.place > this.data.length + AHEAD;
  }

  /** Sets the context of the next decisions of `model`: `contexts` has one per input from index `from` on. */
  at(model: Model, contexts: Int32Array, from: number): void {
    const { starts, nodes } = model;
    for (let k = 0; k < starts.length; k++) this.rows[k] = (starts[k]! + contexts[from + k]!) * nodes;
  }

  /** Decodes one decision and updates the model. */
  decide(model: Model, node: number): number {
    const { chances, seen, weights } = model;
    const { rows, logits } = this;
    const inputs = model.starts.length;
    const first = node * inputs;
    let sum = 0;
    for (let k = 0; k < inputs; k++) {
      const logit = LOGITS[chances[rows[k]! + node]! >> 4]!;
      logits[k] = logit;
      sum += Math.imul(weights[first + k]!, logit) >> 16;
    }
    const chance = CHANCES[clamped(sum, -FAR, FAR) + FAR]!;
    const yes = this.decision(chance);
    const target = yes ? 65536 : 0;
    const error = (target - chance) >> 4;
    for (let k = 0; k < inputs; k++) {
      const weight = weights[first + k]! + ((Math.imul(logits[k]!, error) + 4096) >> 13);
      weights[first + k] = clamped(weight, -WEIGHT_LIMIT, WEIGHT_LIMIT);
      const cell = rows[k]! + node;
      const before = chances[cell]!;
      const count = seen[cell]!;
      chances[cell] = clamped(before + (Math.imul(target - before, SHARES[count]!) >> 16), LEAST, MOST);
      if (count < 255) seen[cell] = count + 1;
    }
    return yes;
  }

  /** A signed number, which may exceed 31 bits. */
  number(model: Model): number {
    if (!this.decide(model, 0)) return 0;
    const negative = this.decide(model, 1);
    let size = 1;
    while (size <= NEAR_SIZES && this.decide(model, 1 + size)) size++;
    if (size > NEAR_SIZES) {
      let length = 0;
      while (length < LENGTHS && this.decide(model, 2 + NEAR_SIZES + Math.min(length, LENGTH_NODES - 1))) length++;
      let rest = 1;
      for (; length > 0; length--) rest = 2 * rest + this.decision(HALF);
      size = rest + NEAR_SIZES;
    }
    return negative ? -size : size;
  }

  private decision(chance: number): number {
    if (!this.range) {
      this.range = -1;
      for (let i = 0; i < 4; i++) this.take();
    }
    // All are stored as signed 32-bit numbers; `>>> 0` makes them comparable.
    let range = this.range;
    const bound = Math.imul(range >>> 16, chance);
    const yes = this.low >>> 0 < bound >>> 0;
    if (yes) {
      range = bound;
    } else {
      this.low = (this.low - bound) | 0;
      range = (range - bound) | 0;
    }
    while (range >>> 24 === 0) {
      this.take();
      range <<= 8;
    }
    this.range = range;
    return yes ? 1 : 0;
  }

  private take(): void {
    this.low = (this.low << 8) | (this.data[this.place++] ?? 0);
  }
}

function clamped(value: number, least: number, most: number): number {
  return value < least ? least : value > most ? most : value;
}
