// SPDX-License-Identifier: Apache-2.0

/** One end of a connection between threads: a worker, its global scope, or a message port. */
export interface Port<Sent, Received> {
  postMessage(message: Sent, transfer: Transferable[]): void;
  onmessage: ((event: MessageEvent<Received>) => void) | null;
}
