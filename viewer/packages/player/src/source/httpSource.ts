// SPDX-License-Identifier: Apache-2.0
/**
 * A file on a server, read by Range requests, or as a whole if the server does not support them.
 *
 * Only ranges with a first byte are requested: browsers send these to another origin without a preflight request, but
 * not a range of the last bytes.
 */

import { type ByteSink, type ByteSource, type ReadOptions, SourceError } from "./byteSource.js";

/** A file that has not changed for this time counts as finished. */
const STILL_SECONDS = 600;
const TEMPORARY = new Set([408, 429, 500, 502, 503, 504]);

export class HttpSource implements ByteSource {
  private growing = true;
  private fileBytes = 0;

  constructor(
    private readonly url: string,
    private readonly name: string,
    private readonly request: typeof fetch,
    private readonly sameOrigin = false,
    /** Whether the file never changes, so that the browser's cache can be used. */
    private readonly kept = false,
  ) {}

  get mayGrow(): boolean {
    return this.growing;
  }

  async read(start: number, options: ReadOptions, sink: ByteSink, signal: AbortSignal): Promise<void> {
    // Browsers log every 416 response, so a range that may be empty is requested together with the byte before it.
    const before = options.end === undefined && start > 0 ? 1 : 0;
    const response = await this.answer(start - before, options.end, signal);
    this.noticeAge(response);
    if (response.status === 416) {
      const { fileBytes } = rangeOf(response);
      this.checkSize(fileBytes);
      sink.begin({ start, fileBytes, ranged: true });
      return;
    }
    if (response.status !== 206 && response.status !== 200) throw refusal(this.name, response.status);
    const { end = Number.POSITIVE_INFINITY, wholeIfNeeded } = options;
    if (response.status === 206) {
      const found = rangeOf(response);
      // A page of another origin may not see the response's range; it is that of the request then.
      const from = start - before;
      if ((found.start ?? from) !== from) {
        throw new SourceError(`The server sent ${this.name} from byte ${found.start} instead of byte ${from}.`);
      }
      this.checkSize(found.fileBytes);
      sink.begin({ start, fileBytes: found.fileBytes, ranged: found.fileBytes !== undefined });
      return this.pour(response, before, end - start, sink);
    }
    const fileBytes = lengthOf(response);
    if (wholeIfNeeded) {
      sink.begin({ start: 0, fileBytes, ranged: false });
      return this.pour(response, 0, Number.POSITIVE_INFINITY, sink);
    }
    sink.begin({ start, fileBytes, ranged: false });
    if (fileBytes !== undefined && fileBytes <= start) return response.body?.cancel();
    return this.pour(response, start, end - start, sink);
  }

  private answer(start: number, end: number | undefined, signal: AbortSignal): Promise<Response> {
    const headers = { Range: `bytes=${start}-${end === undefined ? "" : end - 1}` };
    return answered(this.request, this.url, this.name, headers, this.sameOrigin, signal, this.kept);
  }

  /** Passes on `count` bytes of the body after the first `skip`. */
  private async pour(response: Response, skip: number, count: number, sink: ByteSink): Promise<void> {
    const reader = response.body!.getReader();
    let [left, behind] = [count, skip];
    try {
      while (left > 0) {
        const { done, value } = await reader.read();
        if (done) return;
        const bytes = value.subarray(Math.min(behind, value.length), Math.min(value.length, behind + left));
        behind -= Math.min(behind, value.length);
        left -= bytes.length;
        // A copy, because the bytes are transferred, and the remainder of a chunk would be transferred with them.
        if (bytes.length) sink.take(bytes.length === value.buffer.byteLength ? bytes : bytes.slice());
      }
      await reader.cancel();
    } catch {
      throw new SourceError(`The connection broke while ${this.name} was read.`, true);
    }
  }

  private checkSize(fileBytes: number | undefined): void {
    if (fileBytes === undefined) return;
    if (fileBytes < this.fileBytes) {
      throw new SourceError(
        `${this.name} has become shorter (${fileBytes} bytes after ${this.fileBytes}): it was replaced. Load it again.`,
      );
    }
    this.fileBytes = fileBytes;
  }

  private noticeAge(response: Response): void {
    const changed = Date.parse(response.headers.get("Last-Modified") ?? "");
    const now = Date.parse(response.headers.get("Date") ?? "");
    // The server's clock, if known, because the user's may be wrong.
    if (!Number.isNaN(changed)) this.growing = (Number.isNaN(now) ? Date.now() : now) - changed < STILL_SECONDS * 1000;
  }
}

/** The server's response, which may be an error. */
export async function answered(
  request: typeof fetch,
  url: string,
  name: string,
  headers: Record<string, string>,
  sameOrigin: boolean,
  signal: AbortSignal,
  kept = false,
): Promise<Response> {
  const [mode, cache] = [sameOrigin ? "same-origin" : "cors", kept ? "default" : "no-store"] as const;
  try {
    return await request(url, { headers, signal, mode, cache });
  } catch (error) {
    if (signal.aborted) throw error;
    throw new SourceError(
      `${name} cannot be fetched: the server does not answer, or, being of another origin, does not allow this ` +
        "page to read it (Access-Control-Allow-Origin).",
      true,
    );
  }
}

/** The error of an unexpected response. */
export function refusal(name: string, status: number): SourceError {
  if (status === 404 || status === 410) {
    return new SourceError(`${name} was not found on the server (${status}). Check the address.`);
  }
  if (status === 401 || status === 403) {
    return new SourceError(`The server refuses ${name} to this page (${status}).`);
  }
  return new SourceError(`The server answered the request for ${name} with ${status}.`, TEMPORARY.has(status));
}

/** Parses `bytes 0-9/100` or `bytes * /100`; undefined if it is missing or malformed. */
function rangeOf(response: Response): { start: number | undefined; fileBytes: number | undefined } {
  const header = response.headers.get("Content-Range") ?? "";
  const found = /^bytes (?:(\d{1,15})-\d{1,15}|\*)\/(\d{1,15}|\*)$/.exec(header.trim());
  if (!found) return { start: undefined, fileBytes: undefined };
  const [, start, size] = found;
  return {
    start: start === undefined ? undefined : Number(start),
    fileBytes: size === "*" ? undefined : Number(size),
  };
}

/** Length of a body without content coding; a coded one has another length. */
function lengthOf(response: Response): number | undefined {
  const header = response.headers.get("Content-Length");
  return header === null || response.headers.get("Content-Encoding") ? undefined : Number(header);
}
