// SPDX-License-Identifier: Apache-2.0

/** One end of a line between threads: a worker, the inside of one, or a message port. */
export interface Port<Sent, Received> {
  postMessage(message: Sent, transfer: Transferable[]): void;
  onmessage: ((event: MessageEvent<Received>) => void) | null;
}
