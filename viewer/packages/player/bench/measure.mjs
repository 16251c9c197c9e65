// SPDX-License-Identifier: Apache-2.0
// What the built player takes in a browser: `node bench/measure.mjs FILE [WIDTH HEIGHT] [SEEKS]`, after `npm run build`.
// Without a GPU the browser draws in software, so that times of pictures say nothing of real ones; bytes and workers' times do.

import { readFileSync } from "node:fs";
import { createServer } from "node:http";
import { chromium } from "playwright-core";

const [file, width = "320", height = "240", seeks = "20"] = process.argv.slice(2);
const stream = readFileSync(file);
const bundle = readFileSync(new URL("../dist/player.js", import.meta.url));
const requests = [];
const page = `<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,"><style>html,body{margin:0;height:100%}</style>
<structgstream-player src="stream" style="width:100%;height:100%;aspect-ratio:auto"></structgstream-player>
<script type="module" src="/player.js"></script>`;

const server = createServer((request, response) => {
  const body = { "/": page, "/player.js": bundle, "/stream": stream }[request.url];
  const type = { "/": "text/html", "/player.js": "text/javascript" }[request.url] ?? "application/octet-stream";
  const range = /^bytes=(\d+)-(\d*)$/.exec(request.headers.range ?? "");
  if (!body || !range) return response.writeHead(body ? 200 : 404, { "Content-Type": type }).end(body);
  const end = range[2] ? Math.min(Number(range[2]) + 1, body.length) : body.length;
  const part = body.subarray(Number(range[1]), end);
  requests.push(part.length);
  const where = `bytes ${range[1]}-${end - 1}/${body.length}`;
  response.writeHead(206, { "Content-Type": type, "Content-Range": where, "Content-Length": part.length }).end(part);
});
await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
const args = [
  "--no-sandbox",
  "--use-angle=swiftshader",
  "--enable-unsafe-swiftshader",
  "--ignore-gpu-blocklist",
  "--enable-gpu",
];
const browser = await chromium.launch({ executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args });
try {
  const opened = await browser.newPage({ viewport: { width: Number(width), height: Number(height) } });
  await opened.addInitScript(() => {
    globalThis.busy = [];
    const { requestAnimationFrame: original } = globalThis;
    globalThis.requestAnimationFrame = (callback) =>
      original((time) => {
        const start = performance.now();
        callback(time);
        busy.push(performance.now() - start);
      });
  });
  await opened.goto(`http://127.0.0.1:${server.address().port}/`);
  const first = await opened.evaluate(async () => {
    const player = document.querySelector("structgstream-player");
    const header = new Promise((resolve) => player.on("header", () => resolve(performance.now())));
    while (!player.stats?.settled) await new Promise((resolve) => setTimeout(resolve, 1));
    return {
      header: await Promise.race([header, Promise.resolve(0)]),
      picture: performance.now(),
      splats: player.stats.splats,
    };
  });
  const bytes = requests.reduce((sum, size) => sum + size, 0);
  console.log(
    `first picture: ${bytes} bytes of ${stream.length} in ${requests.length} requests, ${first.picture.toFixed(0)} ms after the page began; ${first.splats} splats`,
  );
  const times = await opened.evaluate(async (count) => {
    const player = document.querySelector("structgstream-player");
    const frames = Math.round(player.duration * 30);
    const found = [];
    for (let i = 0; i < count; i++) {
      const target = (7 * i + 5) % frames;
      const seconds = (target + 0.5) * (player.duration / frames);
      const start = performance.now();
      let [given, decoded] = [0, 0];
      const offs = [
        player.on("frame", () => {
          given ||= performance.now() - start;
        }),
        // Called when the seek begins, and when its frame has come from the worker.
        player.on("state", () => {
          decoded = performance.now() - start;
        }),
      ];
      player.seek(seconds);
      while (player.stats.frameIndex !== target || !player.stats.settled)
        await new Promise((resolve) => setTimeout(resolve, 1));
      found.push([given, decoded, performance.now() - start]);
      for (const off of offs) off();
    }
    return found;
  }, Number(seeks));
  const median = (values) => values.toSorted((a, b) => a - b)[values.length >> 1];
  const [given, decoded, picture] = [0, 1, 2].map((i) => median(times.map((time) => time[i])).toFixed(0));
  console.log(
    `seek, median of ${times.length}: the exact scene came from the worker after ${decoded} ms, the first one went to the renderer after ${given} ms, the exact picture was drawn after ${picture} ms`,
  );
  const played = await opened.evaluate(async () => {
    const player = document.querySelector("structgstream-player");
    const calls = [];
    const ticks = [];
    const decodes = [];
    player.on("drawn", ({ stats }) => {
      calls.push(stats.callMilliseconds);
      ticks.push(busy.length); // the callback that is running
    });
    player.on("frame", () => decodes.push(player.decodeMilliseconds));
    player.loop = true;
    player.seek(0);
    busy.length = 0;
    player.play();
    await new Promise((resolve) => setTimeout(resolve, 15_000));
    const median = (values) => values.toSorted((a, b) => a - b)[values.length >> 1];
    const drawing = ticks.map((at) => busy[at]).filter((time) => time !== undefined);
    const { sortMilliseconds: sort } = player.stats;
    return {
      pictures: calls.length,
      call: median(calls),
      callback: median(busy),
      drawing: median(drawing),
      worst: Math.max(...drawing),
      decode: median(decodes),
      sort,
    };
  });
  const text = (value) => (Number.isFinite(value) ? value.toFixed(1) : "no");
  console.log(
    `playing 15 s: ${played.pictures} pictures (software GL), ${text(played.decode)} ms to decode a packet and`,
  );
  console.log(
    `${text(played.sort)} ms to sort in workers; of the main thread ${text(played.call)} ms in the renderer's call,`,
  );
  console.log(
    `${text(played.drawing)} ms (at most ${text(played.worst)}) for a tick that drew, ${text(played.callback)} ms for any`,
  );
} finally {
  await browser.close();
  server.close();
}
