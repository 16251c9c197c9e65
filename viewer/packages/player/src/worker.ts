// SPDX-License-Identifier: Apache-2.0
/** What workers run: one script for all, which learns by its first message which one it is. */

import { Decoding } from "./decode/decoding.js";
import type { FromDecoder, ToDecoder } from "./decode/messages.js";
import type { ReadReply, ReadRequest } from "./source/description.js";
import { Fetcher } from "./source/fetcher.js";
import type { Port } from "./source/port.js";

/** The first message to a worker; `port` is the line between those that fetch and decode. */
export type Role =
  | { readonly role: "fetch" | "decode"; readonly port: MessagePort }
  /** The renderer's sorter hears everything from then on. */
  | { readonly role: "sort" };

self.onmessage = ({ data }: MessageEvent<Role>) => {
  self.onmessage = null;
  if (data.role === "sort") {
    // It is in this very script: before another message is heard it has been started.
    void import("@structgstream/gl/sorter");
  } else if (data.role === "fetch") {
    new Fetcher(data.port as unknown as Port<ReadReply, ReadRequest>, (input, init) => fetch(input, init));
  } else {
    const engine = self as unknown as Port<FromDecoder, ToDecoder>;
    new Decoding(engine, data.port as unknown as Port<ReadRequest, ReadReply>, breather());
  }
};

/** Lets messages in; unlike a timer it does not wait. */
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
