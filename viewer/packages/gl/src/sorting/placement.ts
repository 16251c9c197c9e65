// SPDX-License-Identifier: Apache-2.0
/** Positions and sizes, which do not depend on the camera; computed once per state of the scene. */

import type { FieldName } from "@structgstream/core";
import { type IntervalBound, TRAINING_LOW_PASS } from "../sampling.js";

/** The fields with the positions of splats. */
export const PLACING_FIELDS = ["anchor_positions", "offset_scales", "base_scales", "anchor_offsets", "free"] as const;
export type PlacingField = (typeof PLACING_FIELDS)[number] & FieldName;

/** Their numbers. */
export type PlacingArrays = ReadonlyMap<PlacingField, Float32Array<ArrayBuffer>>;

/** Of a free Gaussian. */
const FREE_COLUMNS = 14;
/** Radius of a Gaussian, in standard deviations: alpha = 1/255 is reached before 3.33 at any opacity. */
const BALL_DEVIATIONS = 3.4;

/** Splat `m * K + k` is Gaussian `k` of anchor `m`; splat `M * K + i` is free Gaussian `i`. */
export class Placement {
  anchors = 0;
  free = 0;
  offsetsPerAnchor = 1;
  /** [M, 3], the state's own. */
  positions = new Float32Array(0);
  /** [M * K + F, 3] */
  centers = new Float32Array(0);
  /** [M] radius of a ball around the anchor that contains all its Gaussians. */
  radii = new Float32Array(0);
  /** [M] the largest standard deviation that a Gaussian of the anchor can have, without low-pass. */
  extents = new Float32Array(0);

  set(arrays: PlacingArrays, k: number, interval: IntervalBound): void {
    const [positions, offsetScales, baseScales, offsets, free] = PLACING_FIELDS.map((name) => arrays.get(name)!) as [
      Float32Array<ArrayBuffer>,
      ...Float32Array[],
    ];
    this.positions = positions;
    this.offsetsPerAnchor = k;
    this.anchors = positions.length / 3;
    this.free = free!.length / FREE_COLUMNS;
    const splats = this.anchors * k + this.free;
    if (this.centers.length !== 3 * splats) this.centers = new Float32Array(3 * splats);
    if (this.radii.length !== this.anchors) {
      this.radii = new Float32Array(this.anchors);
      this.extents = new Float32Array(this.anchors);
    }
    this.placeAnchors(offsets!, offsetScales!, baseScales!, interval);
    for (let i = 0, to = 3 * this.anchors * k, from = 0; i < this.free; i++, to += 3, from += FREE_COLUMNS) {
      this.centers[to] = free![from]!;
      this.centers[to + 1] = free![from + 1]!;
      this.centers[to + 2] = free![from + 2]!;
    }
  }

  private placeAnchors(
    offsets: Float32Array,
    offsetScales: Float32Array,
    baseScales: Float32Array,
    { middle, spread, slope }: IntervalBound,
  ): void {
    const { positions, centers, radii, extents, offsetsPerAnchor: k } = this;
    for (let m = 0, a = 0, to = 0; m < this.anchors; m++, a += 3) {
      const [x, y, z] = [positions[a]!, positions[a + 1]!, positions[a + 2]!];
      const [sx, sy, sz] = [Math.exp(offsetScales[a]!), Math.exp(offsetScales[a + 1]!), Math.exp(offsetScales[a + 2]!)];
      let reach = 0;
      for (let j = 0; j < k; j++, to += 3) {
        const [dx, dy, dz] = [offsets[to]! * sx, offsets[to + 1]! * sy, offsets[to + 2]! * sz];
        centers[to] = x + dx;
        centers[to + 1] = y + dy;
        centers[to + 2] = z + dz;
        reach = Math.max(reach, dx * dx + dy * dy + dz * dz);
      }
      extents[m] = Math.exp(Math.max(baseScales[a]!, baseScales[a + 1]!, baseScales[a + 2]!));
      const away = Math.sqrt((x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2);
      const interval = slope * (away + spread);
      const drawn = Math.sqrt(extents[m]! ** 2 + TRAINING_LOW_PASS * interval * interval);
      radii[m] = Math.sqrt(reach) + BALL_DEVIATIONS * drawn;
    }
  }
}
