// SPDX-License-Identifier: Apache-2.0
/** The scene on the GPU: one table per field that shaders read, rewritten only if the field has changed. */

import type { FieldName, Tensor } from "@structgstream/core";
import { type Shape, type Sizes, type Snapshot, sizesOf } from "../scene.js";
import type { Order } from "../sorting/messages.js";
import type { Device } from "./device.js";
import type { Resources } from "./resources.js";
import { Table } from "./table.js";
import { packedWeights, paddedRows } from "./weights.js";

/** Fields that contain the weights. */
const MLP_FIELDS: readonly FieldName[] = ["opacity_mlp", "color_mlp", "covariance_mlp", "appearance_basis"];

export class SceneTextures {
  readonly positions: Table;
  readonly offsetScales: Table;
  readonly baseScales: Table;
  readonly offsets: Table;
  readonly features: Table;
  readonly appearance: Table;
  readonly free: Table;
  readonly weights: Table;
  readonly anchors: Table;
  readonly slots: Table;
  sizes: Sizes = { anchors: 0, offsetsPerAnchor: 1, free: 0 };
  anchorCount = 0;
  splats = 0;
  private readonly written = new Map<FieldName, Tensor>();

  constructor(
    resources: Resources,
    device: Device,
    private readonly shape: Shape,
  ) {
    const table = (format: Table["format"], name: string) => new Table(resources, device, format, name);
    this.positions = table("RGB32F", "anchor_positions");
    this.offsetScales = table("RGB32F", "offset_scales");
    this.baseScales = table("RGB32F", "base_scales");
    this.offsets = table("RGB32F", "anchor_offsets");
    this.features = table("RGBA32F", "anchor_features");
    this.appearance = table("RGBA32F", "appearance");
    this.free = table("RG32F", "free");
    this.weights = table("RGBA32F", "MLP weights");
    this.anchors = table("R32UI", "visible anchors");
    this.slots = table("R32UI", "the splats' order");
  }

  /** A scene and the order that belongs to it. @throws GlError too large for this device */
  adopt({ fields }: Snapshot, order: Order): void {
    const changed = (name: FieldName) => this.written.get(name) !== fields.get(name);
    const floats = (name: FieldName) => fields.get(name)!.data as Float32Array;
    for (const [name, table] of [
      ["anchor_positions", this.positions],
      ["offset_scales", this.offsetScales],
      ["base_scales", this.baseScales],
      ["anchor_offsets", this.offsets],
      ["free", this.free],
    ] as const) {
      if (changed(name)) table.write(floats(name));
    }
    if (changed("anchor_features")) {
      this.features.write(paddedRows(floats("anchor_features"), this.shape.features));
    }
    if (this.shape.appearance && changed("appearance")) {
      this.appearance.write(paddedRows(floats("appearance"), this.shape.appearance));
    }
    if (MLP_FIELDS.some(changed)) this.weights.write(packedWeights(fields, this.shape));
    for (const [name, tensor] of fields) this.written.set(name, tensor);
    this.sizes = sizesOf(fields);
    this.anchors.write(order.anchors, order.anchorCount);
    this.slots.write(order.slots, order.splats);
    this.anchorCount = order.anchorCount;
    this.splats = order.splats;
  }

  /** Number of slots that the order may contain: those of visible anchors, then all free Gaussians. */
  get slotCount(): number {
    return this.anchorCount * this.sizes.offsetsPerAnchor + this.sizes.free;
  }

  delete(): void {
    for (const table of [
      this.positions,
      this.offsetScales,
      this.baseScales,
      this.offsets,
      this.features,
      this.appearance,
      this.free,
      this.weights,
      this.anchors,
      this.slots,
    ]) {
      table.delete();
    }
  }
}
