// SPDX-License-Identifier: Apache-2.0
/** Files of a segments folder: their addresses, and checks of size and hash. */

import { SourceError } from "./byteSource.js";
import type { FileEntry } from "./manifest.js";

/** The address of a file next to a manifest, with the manifest's access token. The name was checked before. */
export function siblingUrl(manifest: string, file: string): string {
  const found = new URL(file, manifest);
  const token = new URL(manifest).searchParams.get("token");
  if (token !== null) found.searchParams.set("token", token);
  return found.href;
}

/**
 * Compares a file with its stated size, and its hash if the browser supports that for this page: pages loaded by https
 * or from this machine.
 *
 * @throws SourceError it differs
 */
export async function verify(bytes: Uint8Array, { file, sha256, bytes: stated }: FileEntry): Promise<void> {
  if (bytes.length !== stated) throw new SourceError(`${file} has ${bytes.length} bytes; expected ${stated}.`);
  const subtle = globalThis.crypto?.subtle;
  if (!subtle) return;
  const digest = new Uint8Array(await subtle.digest("SHA-256", bytes as Uint8Array<ArrayBuffer>));
  const found = [...digest].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  if (found !== sha256) throw new SourceError(`${file} is not the file that the manifest states (SHA-256).`);
}
