// SPDX-License-Identifier: Apache-2.0
/**
 * Pictures of whole streams in the browser against those of the Python CPU renderer; `npm run parity` in this package:
 *
 *     python test/make_references.py STREAM REFERENCES; npm run parity -- STREAM REFERENCES [OUT]
 *
 * With OUT, writes `NAME-gl.ppm` and `NAME-difference.ppm` (times four, around grey) of every view there.
 */

import { mkdirSync, readdirSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { readStream } from "@structgstream/core";
import type { MlpPath } from "../src/index.js";
import { openStage } from "../test/support/browser.js";
import { chromiumPath } from "../test/support/chromium.js";
import { magnified } from "../test/support/compare.js";
import { compared, viewsOf } from "../test/support/references.js";

const [stream, folder, out] = process.argv.slice(2);
const executable = chromiumPath();
if (!stream || !folder || !executable)
  throw new Error("usage: npm run parity -- STREAM REFERENCES [OUT], with a Chromium");

const LIMITS: Readonly<Record<MlpPath, number>> = { "transform-feedback": 1e-4, mrt: 2e-3 };
const files: Record<string, string> = { stream };
for (const name of readdirSync(folder)) files[`stream/${name}`] = join(folder, name);
const sizes = new Map(viewsOf(folder).map(({ name, camera }) => [name, [camera.width, camera.height] as const]));
const offsets = readStream(new Uint8Array(readFileSync(stream))).header!.static.get("anchor_offsets")!.shape[1]!;
const stage = await openStage(executable, files);
let failed = false;
try {
  for (const path of ["transform-feedback", "mrt"] as const) {
    for await (const view of compared(stage, "stream", folder, path, offsets)) {
      const right = view.psnrDecibels >= 45 && view.blockLevels <= 8 && view.mlp <= LIMITS[path];
      failed ||= !right;
      console.log(
        `${right ? "ok " : "BAD"} ${path.padEnd(18)} ${view.name.padEnd(18)} ${view.psnrDecibels.toFixed(2)} dB, block ` +
          `${view.blockLevels.toFixed(2)}, pixel ${view.pixelLevels} levels; MLP ${view.mlp.toExponential(1)} of ` +
          `${view.gaussians}; ${view.stats.anchors} anchors, ${view.stats.splats} splats, sort ` +
          `${view.stats.sortMilliseconds.toFixed(1)} ms`,
      );
      if (!out || path === "mrt") continue;
      mkdirSync(out, { recursive: true });
      const [width, height] = sizes.get(view.name)!;
      writeFileSync(join(out, `${view.name}-gl.ppm`), ppm(view.rgba, width, height));
      writeFileSync(join(out, `${view.name}-difference.ppm`), ppm(magnified(view.rgba, view.truth), width, height));
    }
  }
  for (const complaint of stage.complaints) console.log(`complaint: ${complaint}`);
  failed ||= stage.complaints.length > 0;
} finally {
  await stage.close();
}
process.exitCode = failed ? 1 : 0;

function ppm(rgba: Uint8Array, width: number, height: number): Uint8Array {
  const rgb = rgba.filter((_, i) => i % 4 !== 3);
  return Buffer.concat([Buffer.from(`P6\n${width} ${height}\n255\n`), rgb]);
}
