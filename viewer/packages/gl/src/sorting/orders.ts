// SPDX-License-Identifier: Apache-2.0
/** The renderer's interface to the sorting worker: one request at a time; only the latest waiting request is sent. */

import { sameCamera } from "../cameraMath.js";
import { GlError } from "../errors.js";
import { type Snapshot, sizesOf } from "../scene.js";
import type { Camera } from "../types.js";
import type { Order, OrderAnswer, OrderRequest } from "./messages.js";
import { PLACING_FIELDS, type PlacingField } from "./placement.js";

/** The scene and camera of an order. */
export interface Wanted {
  readonly snapshot: Snapshot;
  readonly camera: Camera;
  readonly maxSplats: number;
}

/** An order with its scene and camera, which must be drawn together. */
export interface Sorted extends Wanted {
  readonly order: Order;
}

export function sameWanted(a: Wanted, b: Wanted): boolean {
  return a.snapshot === b.snapshot && a.maxSplats === b.maxSplats && sameCamera(a.camera, b.camera);
}

export class Orders {
  /** The newest answer, for `take`. */
  private arrived: Sorted | undefined;
  private asked: Wanted | undefined;
  private next: Wanted | undefined;
  private last: Wanted | undefined;
  private id = 0;
  /** The request whose answer is not needed any more. */
  private stale = 0;
  /** The state that the worker has. */
  private readonly sent = new Map<PlacingField, Float32Array>();
  private readonly spare: ArrayBuffer[][] = [];
  private returned: ArrayBuffer[] = [];
  private closed = false;

  /**
   * @param onOrder an order has come
   * @param onError the worker failed; there will be no answer to the request
   */
  constructor(
    private readonly worker: Worker,
    private readonly onOrder: () => void,
    private readonly onError: (error: GlError) => void,
  ) {
    worker.onmessage = (event: MessageEvent<OrderAnswer>) => this.answered(event.data);
    worker.onerror = (event) => {
      const reason = event.message || "its file could not be loaded";
      this.onError(new GlError(`The sorting worker does not run (${reason}); check that the page may start workers.`));
    };
  }

  /** Requests an order, unless the last request was the same. */
  want(wanted: Wanted): void {
    if (this.last && sameWanted(this.last, wanted)) return;
    this.last = wanted;
    this.next = wanted;
    this.send();
  }

  /** Whether `take` returns an order. */
  get waiting(): boolean {
    return this.arrived !== undefined;
  }

  /** The newest order since the last call. */
  take(): Sorted | undefined {
    const { arrived } = this;
    this.arrived = undefined;
    return arrived;
  }

  /** Ignores the answer to the last request, because another stream is played. */
  forget(): void {
    this.arrived = undefined;
    this.next = undefined;
    this.last = undefined;
    this.stale = this.asked ? this.id : 0;
  }

  /** Returns the memory of an order that is not drawn any more. */
  release({ order }: Sorted): void {
    if (this.spare.length < 2) this.spare.push([order.anchors.buffer, order.slots.buffer]);
  }

  close(): void {
    this.closed = true;
    this.worker.terminate();
  }

  private send(): void {
    const { next } = this;
    if (!next || this.asked || this.closed) return;
    this.asked = next;
    this.next = undefined;
    const { fields } = next.snapshot;
    const changed = new Map<PlacingField, Float32Array<ArrayBuffer>>();
    for (const name of PLACING_FIELDS) {
      const array = fields.get(name)!.data as Float32Array;
      if (this.sent.get(name) === array) continue;
      changed.set(name, this.copied(array));
      this.sent.set(name, array);
    }
    const buffers = this.spare.pop() ?? [];
    const request: OrderRequest = {
      id: ++this.id,
      changed,
      offsetsPerAnchor: sizesOf(fields).offsetsPerAnchor,
      interval: next.snapshot.training.bound,
      camera: next.camera,
      maxSplats: next.maxSplats,
      buffers,
    };
    this.worker.postMessage(request, [...buffers, ...[...changed.values()].map(({ buffer }) => buffer)]);
  }

  /** Copies into reused memory, because new memory costs the page's thread more than the copy. */
  private copied(array: Float32Array): Float32Array<ArrayBuffer> {
    const bytes = array.byteLength;
    const found = this.returned.findIndex(({ byteLength }) => byteLength >= bytes && byteLength <= 2 * bytes);
    const buffer = found < 0 ? new ArrayBuffer(bytes) : this.returned.splice(found, 1)[0]!;
    const copy = new Float32Array(buffer, 0, array.length);
    copy.set(array);
    return copy;
  }

  private answered(answer: OrderAnswer): void {
    const { asked } = this;
    if (this.closed || !asked || answer.id !== this.id) return;
    this.asked = undefined;
    if ("failure" in answer) {
      this.onError(new GlError(`The sorting worker failed: ${answer.failure}; load the stream again.`));
      return;
    }
    this.returned = [...answer.returned, ...this.returned].slice(0, PLACING_FIELDS.length);
    if (this.arrived) this.release(this.arrived);
    this.arrived = undefined;
    if (answer.id !== this.stale) this.arrived = { ...asked, order: answer };
    this.send();
    if (this.arrived) this.onOrder();
  }
}
