// SPDX-License-Identifier: Apache-2.0

import type { FromDecoder, ToDecoder } from "../decode/messages.js";

/** The connection to the decoder. */
export interface Pipeline {
  send(message: ToDecoder): void;
  onmessage: ((message: FromDecoder) => void) | undefined;
  close(): void;
}
