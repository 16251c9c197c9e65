// SPDX-License-Identifier: Apache-2.0
// What an init record costs to decode: `node bench/header.mjs FILE [DECISIONS]`, after `npm run build`. DECISIONS, by
// `python -m benchmarks.header_coders FILE DECISIONS`, has the symbols of the same record coded by adaptive decisions.

import { readFileSync } from "node:fs";
import { AdaptiveDecoder } from "../dist/adaptive.js";
import { Decoder } from "../dist/coder.js";
import { Models } from "../dist/decisions.js";
import { unpackedHeader } from "../dist/initRecord.js";

const ROUNDS = 9;
const [file, decisions] = process.argv.slice(2);
let [inSymbols, calls] = [0, 0]; // microseconds of the present round, and calls that have begun

/** Adds the core time of a decoder's method, unless another one has called it. */
function count(type, name) {
  const method = type.prototype[name];
  type.prototype[name] = function (...values) {
    const before = process.cpuUsage();
    calls++;
    const found = method.apply(this, values);
    calls--;
    const { user, system } = process.cpuUsage(before);
    if (!calls) inSymbols += user + system;
    return found;
  };
}

function report(what, decode) {
  const rounds = [];
  for (let round = 0; round < ROUNDS; round++) {
    inSymbols = 0;
    const before = process.cpuUsage();
    decode();
    const { user, system } = process.cpuUsage(before);
    rounds.push([user + system, inSymbols]);
  }
  const parts = ["in all", "in its symbols"].map((part, i) => {
    const times = rounds.map((times) => times[i] / 1000);
    const sorted = times.toSorted((a, b) => a - b);
    const [least, median, first] = [sorted[0], sorted[ROUNDS >> 1], times[0]].map((time) => time.toFixed(0));
    return `${median} core ms ${part} (least ${least}, first ${first})`;
  });
  console.log(`${what}: ${parts.join(", ")}`);
}

for (const name of ["residuals", "naturals"]) count(Decoder, name);
count(AdaptiveDecoder, "numbers");

const data = new Uint8Array(readFileSync(file));
const payload = data.subarray(20, 20 + new DataView(data.buffer).getUint32(16, true)); // after prefix and record's head
report(`sections, record of ${payload.length} bytes`, () => unpackedHeader(payload));

if (decisions !== undefined) {
  const coded = readFileSync(decisions);
  let at = 4 + coded.readUInt32LE(0);
  const { fields, arrays } = JSON.parse(coded.subarray(4, at));
  const taken = (size) => {
    at += size;
    return coded.subarray(at - size, at);
  };
  const contexts = arrays.map(({ values }) => Int32Array.from(taken(values)));
  const parts = new Map(Object.entries(fields).map(([name, size]) => [name, taken(size)]));
  report("decisions, the same symbols", () => {
    const decoder = new AdaptiveDecoder(new Models(), parts, "The init record");
    for (const [i, { name, contexts: count }] of arrays.entries()) decoder.numbers(name, contexts[i], [count]);
    decoder.end();
  });
}
