// SPDX-License-Identifier: Apache-2.0
/** A headless Chromium with WebGL2 in software, where there is one. */

import { existsSync } from "node:fs";
import { type Browser, chromium, type Page } from "playwright-core";

const USUAL_PLACES = [
  "/usr/bin/chromium-headless-shell",
  "/usr/bin/chromium",
  "/usr/bin/chromium-browser",
  "/usr/bin/google-chrome",
  "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
];
/** Software GL without a window, and no warning that it is. */
const FLAGS = [
  "--no-sandbox",
  "--use-angle=swiftshader",
  "--enable-unsafe-swiftshader",
  "--ignore-gpu-blocklist",
  "--enable-gpu",
];

/** Where a browser is: the variable CHROMIUM, or one of the usual places; undefined says that tests must skip. */
export function chromiumPath(): string | undefined {
  const found = process.env.CHROMIUM || USUAL_PLACES.find((path) => existsSync(path));
  if (!found) console.warn("SKIPPED: tests in a browser: no Chromium; set CHROMIUM to its path.");
  return found;
}

/** @param flags more of them */
export function launched(executablePath: string, ...flags: string[]): Promise<Browser> {
  return chromium.launch({ executablePath, args: [...FLAGS, ...flags] });
}

/** What a page and its console complain of, from now on. */
export function complaintsOf(page: Page): string[] {
  const complaints: string[] = [];
  page.on("pageerror", (error) => complaints.push(error.message));
  page.on("console", (message) => {
    const text = message.text();
    // Software GL says so of itself.
    const usual = text.includes("GPU stall due to ReadPixels");
    if (["error", "warning"].includes(message.type()) && !usual) complaints.push(text);
  });
  return complaints;
}
