// SPDX-License-Identifier: Apache-2.0
/** The script of all workers; the first message sets a worker's role. */

import { Decoding } from "./decode/decoding.js";
import type { FromDecoder, ToDecoder } from "./decode/messages.js";
import type { ReadReply, ReadRequest } from "./source/description.js";
import { Fetcher } from "./source/fetcher.js";
import type { Port } from "./source/port.js";

/** The first message to a worker; `port` connects the fetch and decode workers. */
export type Role =
  | { readonly role: "fetch" | "decode"; readonly port: MessagePort }
  /** The renderer's sorter handles all further messages. */
  | { readonly role: "sort" };

self.onmessage = ({ data }: MessageEvent<Role>) => {
  self.onmessage = null;
  if (data.role === "sort") {
    // It is part of this script, so it starts before the next message is handled.
    void import("@structgstream/gl/sorter");
  } else if (data.role === "fetch") {
    new Fetcher(data.port as unknown as Port<ReadReply, ReadRequest>, (input, init) => fetch(input, init));
  } else {
    const engine = self as unknown as Port<FromDecoder, ToDecoder>;
    new Decoding(engine, data.port as unknown as Port<ReadRequest, ReadReply>, breather());
  }
};

/** Lets other messages be handled; unlike a timer it has no delay. */
function breather(): () => Promise<void> {
  const { port1, port2 } = new MessageChannel();
  let resume: () => void = () => {};
  port1.onmessage = () => resume();
  return () =>
    new Promise((resolve) => {
      resume = resolve;
      port2.postMessage(0);
    });
}
