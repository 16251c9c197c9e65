// SPDX-License-Identifier: Apache-2.0
/** The workers' scripts, which the build puts in as text (`build.mjs`). */

declare const STRUCTGSTREAM_WORKER: string;
declare const STRUCTGSTREAM_SORTER: string;

export function workerScript(): string {
  return STRUCTGSTREAM_WORKER;
}

/** A worker that sorts for the renderer. */
export function startedSorter(): Worker {
  const url = URL.createObjectURL(new Blob([STRUCTGSTREAM_SORTER], { type: "text/javascript" }));
  const worker = new Worker(url, { name: "structgstream sort" });
  // The worker has been told where its script is; it is fetched whatever becomes of the address now.
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
  return worker;
}
