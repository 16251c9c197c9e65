// SPDX-License-Identifier: Apache-2.0
/** Files of a segments folder: where they are, and whether they are what is stated of them. */

import { SourceError } from "./byteSource.js";
import type { FileEntry } from "./manifest.js";

/** The address of a file beside a manifest, with the manifest's access token. The name has been checked. */
export function besides(manifest: string, file: string): string {
  const found = new URL(file, manifest);
  const token = new URL(manifest).searchParams.get("token");
  if (token !== null) found.searchParams.set("token", token);
  return found.href;
}

/**
 * Compares a file with what is stated of it, where the browser lets this page count hashes: on pages that came by https,
 * or from this machine.
 *
 * @throws SourceError it is another one
 */
export async function verify(bytes: Uint8Array, { file, sha256, bytes: stated }: FileEntry): Promise<void> {
  if (bytes.length !== stated) throw new SourceError(`${file} has ${bytes.length} bytes; expected ${stated}.`);
  const subtle = globalThis.crypto?.subtle;
  if (!subtle) return;
  const digest = new Uint8Array(await subtle.digest("SHA-256", bytes as Uint8Array<ArrayBuffer>));
  const found = [...digest].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  if (found !== sha256) throw new SourceError(`${file} is not the file that the manifest states (SHA-256).`);
}
