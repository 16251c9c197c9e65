// SPDX-License-Identifier: Apache-2.0
/** The sorting worker's entry: one request, one answer. */

import type { OrderAnswer, OrderRequest } from "./sorting/messages.js";
import { Sorter } from "./sorting/sorter.js";

const sorter = new Sorter();

function answer(request: OrderRequest): [OrderAnswer, Transferable[]] {
  try {
    const order = sorter.order(request);
    return [order, [order.anchors.buffer, order.slots.buffer, ...order.returned]];
  } catch (error) {
    return [{ id: request.id, failure: error instanceof Error ? error.message : String(error) }, []];
  }
}

self.addEventListener("message", (event: MessageEvent<OrderRequest>) => {
  const [message, transfer] = answer(event.data);
  self.postMessage(message, { transfer });
});
