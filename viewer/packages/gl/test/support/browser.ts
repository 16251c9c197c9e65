// SPDX-License-Identifier: Apache-2.0
/** A headless browser with WebGL2 in software, and a server on this machine for what it shows. */

import { readFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";
import type { Browser, Page } from "playwright-core";
import { complaintsOf, launched } from "./chromium.ts";
import { TestServer } from "./server.ts";

/** One page with the renderer in it, and what went wrong on it. */
export interface Stage {
  readonly page: Page;
  /** Errors of the page and of its console. */
  readonly complaints: string[];
  close(): Promise<void>;
}

export interface PageOptions {
  readonly viewport?: { readonly width: number; readonly height: number };
  /** Of the page's address. */
  readonly query?: string;
}

/**
 * @param files what the server gives in addition to the page, by name: paths on this machine
 * @param script what runs in the page; it sets `globalThis.stage`
 */
export async function openStage(
  executablePath: string,
  files: Readonly<Record<string, string>>,
  script = new URL("page.ts", import.meta.url),
  { viewport, query = "" }: PageOptions = {},
): Promise<Stage> {
  const sorterScript = new URL("../../src/sorter.worker.ts", import.meta.url);
  const [page, sorter] = await Promise.all([script, sorterScript].map((url) => bundled(fileURLToPath(url))));
  const server = await TestServer.started();
  server.put(
    "/",
    '<!doctype html><meta charset="utf-8"><title>stage</title><link rel="icon" href="data:,"><script type="module" src="/page.js"></script>',
    { type: "text/html" },
  );
  server.put("/page.js", page!, { type: "text/javascript" });
  for (const path of ["/sorter.js", "/sorter.worker.js"]) server.put(path, sorter!, { type: "text/javascript" });
  for (const [name, path] of Object.entries(files)) server.put(`/${name}`, await readFile(path));
  let browser: Browser | undefined;
  const close = async () => {
    await browser?.close();
    await server.stop();
  };
  try {
    browser = await launched(executablePath);
    const opened = await browser.newPage(viewport ? { viewport } : {});
    const complaints = complaintsOf(opened);
    await opened.goto(`${server.origin}/${query}`);
    await opened.waitForFunction("globalThis.stage !== undefined");
    return { page: opened, complaints, close };
  } catch (error) {
    await close();
    throw error;
  }
}

async function bundled(entry: string): Promise<string> {
  const result = await build({
    entryPoints: [entry],
    bundle: true,
    format: "esm",
    target: "es2022",
    write: false,
    logLevel: "warning",
  });
  return result.outputFiles[0]!.text;
}
