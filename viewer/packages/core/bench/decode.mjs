// SPDX-License-Identifier: Apache-2.0
// What frames cost to decode in core time: `node bench/decode.mjs FILE [ROUNDS]`, after `npm run build`.
// A file: `python viewer/packages/core/test/make_fixtures.py --bench 100000 bench.sgs`.

import { readFileSync } from "node:fs";
import { readStream } from "../dist/index.js";

const [file, rounds = "5"] = process.argv.slice(2);
const start = performance.now();
const reader = readStream(readFileSync(file));
console.log(`opened ${reader.packets.length} frames in ${(performance.now() - start).toFixed(1)} ms`);
const times = reader.packets.map(() => []);
for (let round = 0; round < Number(rounds); round++) {
  for (const { index } of reader.packets) {
    const before = process.cpuUsage();
    reader.frame(index);
    const { user, system } = process.cpuUsage(before);
    times[index].push((user + system) / 1000);
  }
}
for (const { index, isKey, bytes } of reader.packets) {
  const sorted = times[index].toSorted((a, b) => a - b);
  const [least, median, most] = [sorted[0], sorted[sorted.length >> 1], sorted.at(-1)].map((time) => time.toFixed(1));
  console.log(`${isKey ? "key  " : "delta"} ${index}: ${bytes} bytes, ${median} core ms (${least} to ${most})`);
}
