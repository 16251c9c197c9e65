// SPDX-License-Identifier: Apache-2.0
/** The cameras of a stream as a viewer meets them. */

import type { StreamHeader } from "@structgstream/core";
import {
  along,
  axes,
  type Camera,
  center,
  dot,
  focusPoint,
  length,
  rigCameras,
  scaled,
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
  /** The camera that a stream begins with: the one nearest to their mean. */
  readonly first: RigCamera;
}

/**
 * Share of the rig's radius that a free camera sees from on: a hundredth, less than anyone would put between a lens and a
 * subject. Nearer still, single Gaussians fill the picture and the order by depth of their means says nothing.
 */
const FREE_NEAR = 0.01;

/**
 * Near plane of a camera at `eye`, in scene units. Nothing nearer than the capture's near plane was trained where its cameras
 * stand: there a viewer's plane is theirs. A viewer who went closer does not push it along: the plane stays where the nearest
 * camera of the rig has it until the viewer has reached it, so that nothing is cut that this camera shows.
 */
export function nearPlane({ cameras, radius }: Pick<Rig, "cameras" | "radius">, eye: Vector): number {
  const away = ({ camera }: RigCamera) => length(along(eye, center(camera), -1));
  const { camera } = cameras.reduce((best, other) => (away(other) < away(best) ? other : best));
  const closer = dot(along(eye, center(camera), -1), axes(camera)[2]);
  return Math.max(camera.near - Math.max(closer, 0), Math.min(FREE_NEAR * radius, camera.near));
}

export function rigOf(header: StreamHeader): Rig {
  const found = rigCameras(header);
  const cameras = header.cameras.map(({ name, heldOut }, i) => ({ name, heldOut, camera: found[i]! }));
  const centers = found.map(center);
  const middle = scaled(
    centers.reduce((sum, eye) => along(sum, eye), [0, 0, 0] as Vector),
    1 / centers.length,
  );
  const distances = centers.map((eye) => length(along(eye, middle, -1)));
  const first = cameras[distances.indexOf(Math.min(...distances))]!;
  return { cameras, focus: focusPoint(found), up: upAxis(found), radius: Math.max(...distances), first };
}
