// SPDX-License-Identifier: Apache-2.0
/** A server of pages and streams that remembers what it was asked, and can be made worse. */

import { createServer, type IncomingMessage, type ServerResponse } from "node:http";
import type { AddressInfo } from "node:net";

/** A file; all of it may be replaced while it is served, and its pace also while a body is sent. */
export interface Served {
  bytes: Uint8Array;
  type?: string;
  ranges?: boolean;
  /** Bytes of a body in a second. */
  bytesPerSecond?: number | undefined;
  /** A body does not go on at these bytes of the file. */
  held?: readonly [start: number, end: number] | undefined;
  cors?: boolean;
  status?: number;
  location?: string;
  changed?: Date;
}

export interface Request {
  readonly path: string;
  readonly query: string;
  /** From the first to before the last byte; undefined when all was asked for. */
  readonly range: readonly [start: number, end: number] | undefined;
}

export class TestServer {
  readonly files = new Map<string, Served>();
  readonly requests: Request[] = [];
  private readonly server = createServer((request, response) => void this.answer(request, response));

  /** @returns a server that listens on this machine only */
  static async started(): Promise<TestServer> {
    const made = new TestServer();
    await new Promise<void>((resolve) => made.server.listen(0, "127.0.0.1", resolve));
    return made;
  }

  get origin(): string {
    return `http://127.0.0.1:${(this.server.address() as AddressInfo).port}`;
  }

  put(path: string, bytes: Uint8Array | string, more: Omit<Served, "bytes"> = {}): Served {
    const data = typeof bytes === "string" ? new TextEncoder().encode(bytes) : bytes;
    const file = { bytes: data, ...more };
    this.files.set(path, file);
    return file;
  }

  /** Gives the files of a folder as they are now, and no others below that path. */
  publish(path: string, files: ReadonlyMap<string, Uint8Array>, more: Omit<Served, "bytes"> = {}): void {
    for (const known of this.files.keys()) {
      if (known.startsWith(path) && !files.has(known.slice(path.length))) this.files.delete(known);
    }
    for (const [name, bytes] of files) this.put(path + name, bytes, more);
  }

  rangesOf(path: string): (readonly [number, number] | undefined)[] {
    return this.requests.filter((request) => request.path === path).map(({ range }) => range);
  }

  async stop(): Promise<void> {
    this.server.closeAllConnections();
    await new Promise<void>((resolve) => this.server.close(() => resolve()));
  }

  private async answer(request: IncomingMessage, response: ServerResponse): Promise<void> {
    const { pathname: path, search: query } = new URL(request.url ?? "/", "http://localhost");
    const file = this.files.get(path);
    const asked = /^bytes=(\d+)-(\d*)$/.exec(request.headers.range ?? "");
    const size = file?.bytes.length ?? 0;
    const start = asked ? Number(asked[1]) : 0;
    const end = asked?.[2] ? Math.min(Number(asked[2]) + 1, size) : size;
    this.requests.push({ path, query, range: asked ? [start, end] : undefined });
    if (!file || file.status) {
      const headers = file?.location ? { Location: file.location } : {};
      response.writeHead(file?.status ?? 404, headers).end();
      return;
    }
    const headers: Record<string, string> = {
      "Content-Type": file.type ?? "application/octet-stream",
      "Last-Modified": (file.changed ?? new Date(0)).toUTCString(),
      // A page of another test asks for it again.
      "Cache-Control": "no-store",
      ...(file.cors ? { "Access-Control-Allow-Origin": "*", "Access-Control-Expose-Headers": "Content-Range" } : {}),
    };
    if (!asked || file.ranges === false) {
      response.writeHead(200, { ...headers, "Content-Length": size });
      return pour(response, file, 0, size);
    }
    if (start >= size) {
      response.writeHead(416, { ...headers, "Content-Range": `bytes */${size}` }).end();
      return;
    }
    response.writeHead(206, {
      ...headers,
      "Content-Length": end - start,
      "Content-Range": `bytes ${start}-${end - 1}/${size}`,
    });
    await pour(response, file, start, end);
  }
}

async function pour(response: ServerResponse, file: Served, start: number, end: number): Promise<void> {
  const { bytes } = file;
  for (let at = start; at < end && !response.destroyed; ) {
    const { bytesPerSecond, held = [end, end] } = file;
    const isHeld = at >= held[0] && at < held[1];
    const step = bytesPerSecond ? Math.max(Math.round(bytesPerSecond / 20), 1) : end;
    const next = isHeld ? at : Math.min(at + step, end, at < held[0] ? held[0] : end);
    if (next > at) response.write(bytes.subarray(at, next));
    at = next;
    if (isHeld || bytesPerSecond) await new Promise((resolve) => setTimeout(resolve, 50));
  }
  response.end();
}
