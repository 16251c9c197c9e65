// SPDX-License-Identifier: Apache-2.0
/** The scene in the renderer: its present state, and the state for which an order was requested. */

import { FIELD_NAMES, type Fields, OPTIONAL_FIELDS, type StreamHeader } from "@structgstream/core";
import { GlError } from "./errors.js";
import { type TrainingCameras, trainingCamerasOf } from "./sampling.js";
import type { SceneUpdate } from "./types.js";

/** An immutable state of a scene. */
export interface Snapshot {
  readonly index: number;
  readonly ptsSeconds: number;
  readonly fields: Fields;
  readonly training: TrainingCameras;
}

/** Numbers of elements. */
export interface Sizes {
  readonly anchors: number;
  readonly offsetsPerAnchor: number;
  readonly free: number;
}

/** Numbers for which programs are compiled. */
export interface Shape {
  readonly offsetsPerAnchor: number;
  readonly features: number;
  /** Columns of the anchors' appearance; 0 if there is none. */
  readonly appearance: number;
  readonly hidden: number;
  readonly distanceInput: boolean;
}

export function sizesOf(fields: Fields): Sizes {
  const [anchors, offsetsPerAnchor] = fields.get("anchor_offsets")!.shape as [number, number];
  return { anchors, offsetsPerAnchor, free: fields.get("free")!.shape[0]! };
}

export function shapeOf(fields: Fields, distanceInput: boolean): Shape {
  const { offsetsPerAnchor } = sizesOf(fields);
  const features = fields.get("anchor_features")!.shape[1]!;
  const inputs = features + 3 + Number(distanceInput);
  const weights = fields.get("opacity_mlp")!.data.length;
  return {
    offsetsPerAnchor,
    features,
    appearance: fields.get("appearance")?.shape[1] ?? 0,
    hidden: (weights - offsetsPerAnchor) / (inputs + 1 + offsetsPerAnchor),
    distanceInput,
  };
}

export function sameShape(a: Shape, b: Shape): boolean {
  return (Object.keys(a) as (keyof Shape)[]).every((key) => a[key] === b[key]);
}

/** Collects updates and provides the present scene. */
export class LiveScene {
  /** Undefined until an update has completed the scene. */
  latest: Snapshot | undefined;
  private readonly training: TrainingCameras;

  constructor(readonly header: StreamHeader) {
    this.training = trainingCamerasOf(header);
  }

  /** @throws GlError the update lacks fields that no earlier update contained */
  apply(update: SceneUpdate): void {
    const fields = new Map([...(this.latest?.fields ?? this.header.static), ...update.fields]);
    const missing = FIELD_NAMES.filter((name) => !fields.has(name) && !OPTIONAL_FIELDS.includes(name));
    if (missing.length) {
      throw new GlError(
        `The update of frame ${update.index} lacks ${missing.join(", ")}; expected every dynamic field in the first update.`,
      );
    }
    this.latest = { index: update.index, ptsSeconds: update.ptsSeconds, fields, training: this.training };
  }
}
