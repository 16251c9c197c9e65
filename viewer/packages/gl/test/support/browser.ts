// SPDX-License-Identifier: Apache-2.0
/** A headless browser with WebGL2 in software, and a server on this machine for what it shows. */

import { readFile } from "node:fs/promises";
import { createServer, type Server } from "node:http";
import type { AddressInfo } from "node:net";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";
import type { Browser, Page } from "playwright-core";
import { launched } from "./chromium.ts";

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
  const content: Record<string, Uint8Array | string> = {
    "/": '<!doctype html><meta charset="utf-8"><title>stage</title><link rel="icon" href="data:,"><script type="module" src="/page.js"></script>',
    "/page.js": page,
    "/sorter.js": sorter,
    "/sorter.worker.js": sorter,
  };
  const server = createServer(async (request, response) => {
    const name = new URL(request.url ?? "/", "http://localhost").pathname;
    const path = files[name.slice(1)];
    const body = content[name] ?? (path === undefined ? undefined : await readFile(path));
    const type = name === "/" ? "text/html" : name.endsWith(".js") ? "text/javascript" : "application/octet-stream";
    response.writeHead(body === undefined ? 404 : 200, { "content-type": type });
    response.end(body);
  });
  await new Promise<void>((resolve) => server.listen(0, "127.0.0.1", resolve));
  let browser: Browser | undefined;
  try {
    browser = await launched(executablePath);
    const opened = await browser.newPage(viewport ? { viewport } : {});
    const complaints: string[] = [];
    opened.on("pageerror", (error) => complaints.push(error.message));
    opened.on("console", (message) => {
      const text = message.text();
      // The page has no icon, and software GL says so of itself when pixels are read.
      const usual = text.includes("favicon") || text.includes("GPU stall due to ReadPixels");
      if (["error", "warning"].includes(message.type()) && !usual) complaints.push(text);
    });
    await opened.goto(`http://127.0.0.1:${(server.address() as AddressInfo).port}/${query}`);
    await opened.waitForFunction("globalThis.stage !== undefined");
    const running = browser;
    return { page: opened, complaints, close: () => closed(running, server) };
  } catch (error) {
    await closed(browser, server);
    throw error;
  }
}

async function closed(browser: Browser | undefined, server: Server): Promise<void> {
  await browser?.close();
  server.closeAllConnections();
  await new Promise<void>((resolve) => server.close(() => resolve()));
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
