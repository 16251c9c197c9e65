// SPDX-License-Identifier: Apache-2.0
/** Whole stream files from a server. */

import { readStream, StreamError, type StreamReader } from "@structgstream/core";

/**
 * A reader of the file at an address, when all of it has arrived.
 *
 * @throws StreamError the server has no such file, or it is no stream
 * @throws TypeError the server cannot be reached
 * @throws DOMException the signal aborted
 */
export async function fetchStream(url: string | URL, signal?: AbortSignal): Promise<StreamReader> {
  const response = await fetch(url, signal ? { signal } : {});
  if (!response.ok) throw new StreamError(`${url} cannot be loaded: the server answered ${response.status}.`);
  return readStream(new Uint8Array(await response.arrayBuffer()), String(url));
}
