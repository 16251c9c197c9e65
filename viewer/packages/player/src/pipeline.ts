// SPDX-License-Identifier: Apache-2.0
/** The two workers of a stream. */

import type { FromDecoder } from "./decode/messages.js";
import type { Pipeline } from "./engine/pipeline.js";
import { startedWorker } from "./scripts.js";

/** Starts both workers; `close` terminates them. */
export function startedPipeline(): Pipeline {
  const { port1, port2 } = new MessageChannel();
  const workers = [startedWorker("fetch", port1), startedWorker("decode", port2)];
  const decoder = workers[1]!;
  const pipeline: Pipeline = {
    onmessage: undefined,
    send: (message) => decoder.postMessage(message),
    close: () => {
      for (const worker of workers) worker.terminate();
    },
  };
  decoder.onmessage = ({ data }: MessageEvent<FromDecoder>) => pipeline.onmessage?.(data);
  for (const worker of workers) {
    worker.onerror = (event) => {
      const unknown = "this page cannot start it (does its Content-Security-Policy allow worker-src blob:?)";
      const message = `A worker of the player stopped: ${event.message ?? unknown}.`;
      pipeline.onmessage?.({ type: "failed", message, fatal: true });
    };
  }
  return pipeline;
}
