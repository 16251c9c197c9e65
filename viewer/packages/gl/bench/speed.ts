// SPDX-License-Identifier: Apache-2.0
/**
 * Milliseconds of each stage of a picture: `npm run speed -- STREAM CAMERA` in this package. Where GL is software, as in the
 * browser that this starts, its figures say nothing about a GPU; those of the page's thread and of the sorter hold.
 */

import { openStage } from "../test/support/browser.js";
import { chromiumPath } from "../test/support/chromium.js";

const [stream, camera] = process.argv.slice(2);
const executable = chromiumPath();
if (!stream || !camera || !executable) throw new Error("usage: npm run speed -- STREAM CAMERA, with a Chromium");

const stage = await openStage(executable, { stream });
const ms = (value: number) => value.toFixed(1);
try {
  for (const path of ["transform-feedback", "mrt"] as const) {
    const found = await stage.page.evaluate(([name, how]) => globalThis.stage.timed("stream", name, how, 7), [
      camera,
      path,
    ] as const);
    console.log(
      `${path}: ${found.anchors} anchors, ${found.splats} splats; worker: placing ${ms(found.place)}, culling and sorting ` +
        `${ms(found.sort)} ms; GPU (software): upload ${ms(found.upload)}, MLPs ${ms(found.mlp)}, projecting and blending ` +
        `${ms(found.draw)}, environment ${ms(found.show)} ms`,
    );
  }
  const { calls, shown } = await stage.page.evaluate(async (name) => {
    const play = await globalThis.stage.open("stream");
    const found = await globalThis.stage.played(play, play.rig(name), 40);
    play.close();
    return found;
  }, camera);
  const sorted = [...calls.slice(5)].sort((a, b) => a - b);
  const at = (share: number) => ms(sorted[Math.floor(share * (sorted.length - 1))]!);
  console.log(
    `page's thread, update and render of a moving camera: median ${at(0.5)}, 90 % within ${at(0.9)}, worst ${at(1)} ms; ` +
      `${shown} frames shown of ${calls.length}`,
  );
  for (const complaint of stage.complaints) console.log(`complaint: ${complaint}`);
} finally {
  await stage.close();
}
