// SPDX-License-Identifier: Apache-2.0
/** The workers, from the script that the build inserts as text (`build.mjs`). */

import type { Role } from "./worker.js";

declare const STRUCTGSTREAM_WORKER: string;

/** Starts a worker with its role; `port` is transferred to it. */
export function startedWorker(name: Role["role"], port?: MessagePort): Worker {
  const url = URL.createObjectURL(new Blob([STRUCTGSTREAM_WORKER], { type: "text/javascript" }));
  const worker = new Worker(url, { name: `structgstream ${name}` });
  worker.postMessage({ role: name, port }, port ? [port] : []);
  // The address is needed only until the browser has read the script.
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
  return worker;
}
