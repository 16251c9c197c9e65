// SPDX-License-Identifier: Apache-2.0
/** The scene on the GPU: one table per field that shaders read, rewritten only if the field has changed. */

import type { FieldName, Tensor } from "@structgstream/core";
import { type Shape, type Sizes, type Snapshot, sizesOf } from "../scene.js";
import type { Order } from "../sorting/messages.js";
import type { Device } from "./device.js";
import type { Resources } from "./resources.js";
import { Table, type TexelFormat } from "./table.js";
import { packedWeights, paddedRows, WEIGHT_FIELDS } from "./weights.js";

/** By the names of the shaders' samplers: the format of a table, and its name in messages. */
const TABLES = {
  positions: ["RGB32F", "anchor_positions"],
  offsetScales: ["RGB32F", "offset_scales"],
  baseScales: ["RGB32F", "base_scales"],
  offsets: ["RGB32F", "anchor_offsets"],
  features: ["RGBA32F", "anchor_features"],
  appearance: ["RGBA32F", "appearance"],
  free: ["RG32F", "free"],
  weights: ["RGBA32F", "MLP weights"],
  anchors: ["R32UI", "visible anchors"],
  slots: ["R32UI", "the splats' order"],
} as const satisfies Record<string, readonly [TexelFormat, string]>;

type TableName = keyof typeof TABLES;

export class SceneTextures {
  sizes: Sizes = { anchors: 0, offsetsPerAnchor: 1, free: 0 };
  anchorCount = 0;
  splats = 0;
  private readonly tables: Readonly<Record<TableName, Table>>;
  private readonly written = new Map<FieldName, Tensor>();

  constructor(
    resources: Resources,
    device: Device,
    private readonly shape: Shape,
  ) {
    this.tables = Object.fromEntries(
      Object.entries(TABLES).map(([key, [format, name]]) => [key, new Table(resources, device, format, name)]),
    ) as Record<TableName, Table>;
  }

  /** Textures of tables, for `bindTextures`. */
  textures(...names: readonly TableName[]): Record<string, WebGLTexture | undefined> {
    return Object.fromEntries(names.map((name) => [name, this.tables[name].texture]));
  }

  /** A scene and the order that belongs to it. @throws GlError too large for this device */
  adopt({ fields }: Snapshot, order: Order): void {
    const { tables, shape } = this;
    const changed = (name: FieldName) => this.written.get(name) !== fields.get(name);
    const floats = (name: FieldName) => fields.get(name)!.data as Float32Array;
    for (const key of ["positions", "offsetScales", "baseScales", "offsets", "free"] as const) {
      const [, name] = TABLES[key];
      if (changed(name)) tables[key].write(floats(name));
    }
    if (changed("anchor_features")) tables.features.write(paddedRows(floats("anchor_features"), shape.features));
    if (shape.appearance && changed("appearance")) {
      tables.appearance.write(paddedRows(floats("appearance"), shape.appearance));
    }
    if (WEIGHT_FIELDS.some(changed)) tables.weights.write(packedWeights(fields, shape));
    for (const [name, tensor] of fields) this.written.set(name, tensor);
    this.sizes = sizesOf(fields);
    tables.anchors.write(order.anchors, order.anchorCount);
    tables.slots.write(order.slots, order.splats);
    this.anchorCount = order.anchorCount;
    this.splats = order.splats;
  }

  /** Number of slots that the order may contain: those of visible anchors, then all free Gaussians. */
  get slotCount(): number {
    return this.anchorCount * this.sizes.offsetsPerAnchor + this.sizes.free;
  }
}
