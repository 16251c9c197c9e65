// SPDX-License-Identifier: Apache-2.0
/** Answers requests for orders; independent of the worker. */

import { largestAnchors, seenAnchors } from "./culling.js";
import { DepthSorter } from "./depthOrder.js";
import type { Order, OrderRequest } from "./messages.js";
import { Placement, type PlacingField } from "./placement.js";

const FAR = 1e30;

export class Sorter {
  private readonly placement = new Placement();
  private readonly arrays = new Map<PlacingField, Float32Array<ArrayBuffer>>();
  private readonly sorter = new DepthSorter();
  private depths = new Float32Array(0);
  private candidates = new Uint32Array(0);

  order(request: OrderRequest): Order {
    const began = performance.now();
    const { placement, arrays } = this;
    const { offsetsPerAnchor, interval, camera } = request;
    const returned: ArrayBuffer[] = [];
    if (request.changed.size) {
      for (const [name, array] of request.changed) {
        const before = arrays.get(name);
        if (before) returned.push(before.buffer);
        arrays.set(name, array);
      }
      placement.set(arrays, offsetsPerAnchor, interval);
    }
    const [first, second] = request.buffers;
    const anchors = fitting(first, placement.anchors);
    const all = placement.anchors * offsetsPerAnchor + placement.free;
    const order = fitting(second, all);
    const seen = seenAnchors(placement, camera, anchors);
    // Free Gaussians represent moving content and are few, so a budget should remove them last.
    const free = Math.min(placement.free, request.maxSplats);
    const keep = Math.floor((request.maxSplats - free) / offsetsPerAnchor);
    const anchorCount = largestAnchors(placement, camera, anchors, seen, keep);
    if (this.depths.length < all) {
      this.depths = new Float32Array(all);
      this.candidates = new Uint32Array(all);
    }
    const splats = this.depthsOf(camera, anchors, anchorCount, free);
    this.sorter.sort(this.depths, splats, order);
    for (let i = 0; i < splats; i++) order[i] = this.candidates[order[i]!]!;
    const milliseconds = performance.now() - began;
    return { id: request.id, anchors, anchorCount, slots: order, splats, milliseconds, returned };
  }

  /** Fills `depths` and their slots `candidates`; returns their number. */
  private depthsOf(camera: OrderRequest["camera"], anchors: Uint32Array, anchorCount: number, free: number): number {
    const { depths, candidates, placement } = this;
    const { centers, offsetsPerAnchor: k } = placement;
    const [a, b, c, d] = [8, 9, 10, 11].map((i) => camera.viewmat[i]!) as [number, number, number, number];
    let count = 0;
    const take = (splat: number, slot: number) => {
      const at = 3 * splat;
      const z = a * centers[at]! + b * centers[at + 1]! + c * centers[at + 2]! + d;
      if (!(z >= camera.near && z < FAR)) return;
      depths[count] = z;
      candidates[count++] = slot;
    };
    for (let v = 0, slot = 0; v < anchorCount; v++) {
      for (let j = 0, splat = anchors[v]! * k; j < k; j++) take(splat++, slot++);
    }
    for (let i = 0; i < free; i++) take(placement.anchors * k + i, anchorCount * k + i);
    return count;
  }
}

function fitting(buffer: ArrayBuffer | undefined, count: number): Uint32Array<ArrayBuffer> {
  return buffer && buffer.byteLength >= 4 * count ? new Uint32Array(buffer) : new Uint32Array(count);
}
