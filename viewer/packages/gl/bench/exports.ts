// SPDX-License-Identifier: Apache-2.0
/**
 * Exported frames as engines read and draw them, against our own pictures of the stream (docs/export.md).
 *
 * npm run exports --workspace packages/gl -- spark|playcanvas STREAM FRAME CAMERA FOLDER SETTINGS FILE...
 * SETTINGS are the engine's as JSON, {} for its own; FOLDER gets a picture for each file: ours beside the engine's.
 */

import { createHash } from "node:crypto";
import { writeFileSync } from "node:fs";
import { basename, join } from "node:path";
import { openStage } from "../test/support/browser.ts";
import { chromiumPath } from "../test/support/chromium.ts";
import { bytesOf, difference } from "../test/support/compare.ts";
import type { ExportedStage } from "../test/support/exportedPage.ts";

declare const stage: ExportedStage;

const [engine = "", stream = "", frame = "", camera = "", folder = "", settings = "", ...files] = process.argv.slice(2);
const served = Object.fromEntries(files.map((file) => [basename(file), file]));
const script = new URL(`../../${engine}/bench/exported.ts`, import.meta.url);
const opened = await openStage(chromiumPath()!, { ...served, stream }, script);
try {
  for (const file of Object.keys(served)) {
    const found = await opened.page.evaluate(
      ([name, index, view, options]) => stage.pictures(name, index, view, options),
      [file, Number(frame), camera, JSON.parse(settings) as object] as const,
    );
    const { width, height } = found;
    const pictures = [bytesOf(found.own), bytesOf(found.engine)] as const;
    const { psnrDecibels } = difference(...pictures, width, height);
    console.log(`${engine} ${file} ${camera}: ${psnrDecibels.toFixed(2)} dB`);
    const name = `${engine}-${file}-${camera}-${createHash("md5").update(settings).digest("hex").slice(0, 4)}.png`;
    writeFileSync(join(folder, name), await sideBySide(pictures, width, height));
  }
} finally {
  console.log(`messages: ${JSON.stringify(opened.complaints)}`);
  await opened.close();
}

async function sideBySide(pictures: readonly Uint8Array[], width: number, height: number): Promise<Buffer> {
  const url = await opened.page.evaluate(
    ([all, w, h]) => {
      const canvas = Object.assign(document.createElement("canvas"), { width: all.length * w, height: h });
      for (const [i, bytes] of all.entries()) {
        const image = new ImageData(new Uint8ClampedArray(bytes), w, h);
        canvas.getContext("2d")!.putImageData(image, i * w, 0);
      }
      return canvas.toDataURL();
    },
    [pictures.map((bytes) => [...bytes]), width, height] as const,
  );
  return Buffer.from(url.split(",")[1]!, "base64");
}
