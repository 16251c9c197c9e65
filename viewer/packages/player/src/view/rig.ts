// SPDX-License-Identifier: Apache-2.0
/** The cameras of a stream in scene units, with focus, size and first camera. */

import type { StreamHeader } from "@structgstream/core";
import {
  along,
  axes,
  type Camera,
  center,
  dot,
  focusPoint,
  length,
  mean,
  rigCameras,
  upAxis,
  type Vector,
} from "@structgstream/gl";

export interface RigCamera {
  readonly name: string;
  readonly heldOut: boolean;
  /** In scene units. */
  readonly camera: Camera;
}

export interface Rig {
  readonly cameras: readonly RigCamera[];
  readonly focus: Vector;
  readonly up: Vector;
  /** Largest distance of a camera to the mean of all. */
  readonly radius: number;
  /** The initial camera: the one nearest to the cameras' mean. */
  readonly first: RigCamera;
}

/** A free camera's near plane is at least this share of its nearest camera's, because nearer content is blurred. */
const MIN_NEAR_SHARE = 0.01;

/**
 * Near plane of a camera at `eye`, in scene units: that of the nearest camera of the rig, which stays where it is if the
 * eye advances along that camera's axis (docs/conventions.md). Beside the cameras it keeps its distance.
 */
export function nearPlane({ cameras }: Pick<Rig, "cameras">, eye: Vector): number {
  const away = ({ camera }: RigCamera) => length(along(eye, center(camera), -1));
  const { camera } = cameras.reduce((best, other) => (away(other) < away(best) ? other : best));
  const advance = dot(along(eye, center(camera), -1), axes(camera)[2]);
  return Math.max(camera.near - Math.max(advance, 0), MIN_NEAR_SHARE * camera.near);
}

export function rigOf(header: StreamHeader): Rig {
  const found = rigCameras(header);
  const cameras = header.cameras.map(({ name, heldOut }, i) => ({ name, heldOut, camera: found[i]! }));
  const centers = found.map(center);
  const middle = mean(centers);
  const distances = centers.map((eye) => length(along(eye, middle, -1)));
  const first = cameras[distances.indexOf(Math.min(...distances))]!;
  return { cameras, focus: focusPoint(found), up: upAxis(found), radius: Math.max(...distances), first };
}
