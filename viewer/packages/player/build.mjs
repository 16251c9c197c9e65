// SPDX-License-Identifier: Apache-2.0
// Makes dist/player.js: one module that holds the player, its workers and its styles, and needs nothing else.
// `node build.mjs [FILE]` after `tsc --build`; the same sources give the same bytes.

import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { basename, dirname } from "node:path";
import { fileURLToPath } from "node:url";
import { gzipSync } from "node:zlib";
import { build } from "esbuild";
import { minify } from "terser";

/** Shaders and styles are written to be read: indentation, and in shaders comments and spaces, stay out of the bundle. */
const terse = {
  name: "terse",
  setup({ onLoad }) {
    onLoad({ filter: /(?:gl\/dist\/(?:shaders|gpu)\/\w+\.js|ui\/styles\.ts)$/ }, ({ path }) => {
      const text = readFileSync(path, "utf8");
      const shader = path.endsWith(".js");
      const plain = shader ? text.replaceAll(/(^|\s)\/\/[^\n]*/g, "$1") : text;
      const dense = path.includes("/shaders/") ? plain.replaceAll(/ *([=*/+,;<>?:&|]) */g, "$1") : plain;
      return { contents: dense.replaceAll(/\s*\n\s*/g, "\n"), loader: shader ? "js" : "ts" };
    });
  },
};

const common = {
  absWorkingDir: fileURLToPath(new URL("./", import.meta.url)),
  bundle: true,
  minify: true,
  write: false,
  target: "es2022",
  legalComments: "none",
  charset: "utf8",
  logLevel: "warning",
  plugins: [terse],
};

/** What a second minifier still finds: some 1500 bytes with gzip. */
async function shorter({ outputFiles }, module) {
  const compress = { passes: 2, unsafe_arrows: true, unsafe_methods: true, keep_fargs: false };
  const { code } = await minify(outputFiles[0].text, { module, toplevel: true, ecma: 2020, compress });
  return code.trim();
}

/** A script for a classic worker, which starts from a blob wherever the page is from. */
async function script(entry) {
  return shorter(await build({ ...common, entryPoints: [entry], format: "iife" }), false);
}

const worker = await script("src/worker.ts");
const module = await build({
  ...common,
  entryPoints: ["src/main.ts"],
  format: "esm",
  define: { STRUCTGSTREAM_WORKER: JSON.stringify(worker) },
});
const bundle = `// SPDX-License-Identifier: Apache-2.0\n${await shorter(module, true)}\n`;
// In an HTML page a script ends where this stands, whatever it is part of.
if (/<\/script|<!--/i.test(bundle)) throw new Error("The bundle holds what would end a script element.");
const file = process.argv[2] ?? fileURLToPath(new URL("dist/player.js", import.meta.url));
mkdirSync(dirname(file), { recursive: true });
writeFileSync(file, bundle);
const size = (text) => `${Buffer.byteLength(text)} bytes, ${gzipSync(text, { level: 9 }).length} with gzip`;
console.error(`${basename(file)}: ${size(bundle)} (workers ${size(worker)})`);
