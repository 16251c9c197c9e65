// SPDX-License-Identifier: Apache-2.0
/** The two workers of a stream, from the script that the bundle carries as text. */

import type { FromDecoder } from "./decode/messages.js";
import type { Pipeline } from "./engine/engine.js";

/** Starts both workers; `close` ends them, whatever they do. */
export function startedPipeline(script: string): Pipeline {
  const url = URL.createObjectURL(new Blob([script], { type: "text/javascript" }));
  const fetcher = new Worker(url, { name: "structgstream fetch" });
  const decoder = new Worker(url, { name: "structgstream decode" });
  const { port1, port2 } = new MessageChannel();
  fetcher.postMessage({ role: "fetch", port: port1 }, [port1]);
  decoder.postMessage({ role: "decode", port: port2 }, [port2]);
  const pipeline: Pipeline = {
    onmessage: undefined,
    send: (message) => decoder.postMessage(message),
    close: () => {
      fetcher.terminate();
      decoder.terminate();
      URL.revokeObjectURL(url);
    },
  };
  decoder.onmessage = ({ data }: MessageEvent<FromDecoder>) => pipeline.onmessage?.(data);
  for (const worker of [fetcher, decoder]) {
    worker.onerror = (event) => {
      pipeline.onmessage?.({
        type: "failed",
        message: `A worker of the player stopped: ${event.message}.`,
        fatal: true,
      });
    };
  }
  return pipeline;
}
