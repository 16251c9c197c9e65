// SPDX-License-Identifier: Apache-2.0
/** User navigation of a camera: around a point, with it, towards it, or freely; without state. */

import type { Similarity } from "@structgstream/core";
import {
  across,
  along,
  axes,
  type Camera,
  center,
  cross,
  dot,
  length,
  type Rotation,
  scaled,
  unit,
  type Vector,
  viewmatOf,
} from "@structgstream/gl";

/** A camera and its pivot. */
export interface View {
  readonly camera: Camera;
  readonly pivot: Vector;
}

/** Smallest angle to the vertical, at which left and right would be swapped. */
const POLE_RADIANS = 0.03;
const MIN_DISTANCE = 1e-3;

/** A camera with its pivot on the optical axis at the depth of `focus`. */
export function viewOf(camera: Camera, focus: Vector): View {
  const eye = center(camera);
  const forward = axes(camera)[2];
  const depth = dot(along(focus, eye, -1), forward);
  const distance = depth > MIN_DISTANCE ? depth : Math.max(length(along(focus, eye, -1)), MIN_DISTANCE);
  return { camera, pivot: along(eye, forward, distance) };
}

/** The same view of the capture in the units of another scene: `scene = (capture - center) * scale`. */
export function carried(view: View, from: Similarity, to: Similarity): View {
  const ratio = to.scale / from.scale;
  const moved = (point: Vector) =>
    point.map((value, i) => (value / from.scale + from.center[i]! - to.center[i]!) * to.scale) as unknown as Vector;
  const { camera, pivot } = view;
  const viewmat = viewmatOf(moved(center(camera)), axes(camera));
  return { camera: { ...camera, viewmat, near: camera.near * ratio }, pivot: moved(pivot) };
}

/** Orbits around the pivot: to the right for positive `yaw`, up for positive `pitch`, radians. */
export function orbited({ camera, pivot }: View, yaw: number, pitch: number, up: Vector): View {
  const arm = along(center(camera), pivot, -1);
  const turn = (vector: Vector) => rotated(vector, up, yaw);
  const side = cross(turn(arm), up);
  const right = length(side) > 1e-9 ? unit(scaled(side, -1)) : turn(axes(camera)[0]);
  const polar = Math.acos(Math.min(Math.max(dot(unit(arm), up), -1), 1));
  const wanted = Math.min(Math.max(polar - pitch, POLE_RADIANS), Math.PI - POLE_RADIANS);
  // A camera beyond the limit is not moved by it.
  const tilt = polar < POLE_RADIANS || polar > Math.PI - POLE_RADIANS ? pitch : polar - wanted;
  const whole = (vector: Vector) => rotated(turn(vector), right, -tilt);
  const turned = axes(camera).map(whole) as unknown as Rotation;
  return { camera: placed(camera, along(pivot, whole(arm)), turned), pivot };
}

/** Turns the camera around its position; the pivot stays in front of it. */
export function looked({ camera, pivot }: View, yaw: number, pitch: number, up: Vector): View {
  const eye = center(camera);
  const right = axes(camera)[0];
  const turn = (vector: Vector) => rotated(rotated(vector, right, pitch), up, yaw);
  const turned = axes(camera).map(turn) as unknown as Rotation;
  const distance = length(along(pivot, eye, -1));
  return { camera: placed(camera, eye, turned), pivot: along(eye, turned[2], distance) };
}

/** Moves camera and pivot so that the scene at the pivot's depth moves by a number of pixels. */
export function panned(view: View, x: number, y: number): View {
  const { camera, pivot } = view;
  const [right, down] = axes(camera);
  const depth = Math.max(dot(along(pivot, center(camera), -1), axes(camera)[2]), MIN_DISTANCE);
  const shift = along(scaled(right, (-x * depth) / camera.K.fx), down, (-y * depth) / camera.K.fy);
  return moved(view, shift);
}

/** Scales the distance to the pivot by `factor`. */
export function dollied({ camera, pivot }: View, factor: number): View {
  const arm = along(center(camera), pivot, -1);
  const distance = Math.max(length(arm) * factor, MIN_DISTANCE);
  return { camera: placed(camera, along(pivot, unit(arm), distance), axes(camera)), pivot };
}

/** Flies by a distance to the right, down and forward, in scene units. */
export function flown(view: View, right: number, down: number, forward: number): View {
  const [x, y, z] = axes(view.camera);
  return moved(view, along(along(scaled(x, right), y, down), z, forward));
}

function moved({ camera, pivot }: View, shift: Vector): View {
  return { camera: placed(camera, along(center(camera), shift), axes(camera)), pivot: along(pivot, shift) };
}

function placed(camera: Camera, eye: Vector, rotation: Rotation): Camera {
  return { ...camera, viewmat: viewmatOf(eye, orthonormal(rotation)) };
}

/** Orthonormalises the axes, because errors of many small rotations accumulate. */
function orthonormal([right, , forward]: Rotation): Rotation {
  const z = unit(forward);
  const x = unit(along(right, z, -dot(right, z)));
  return length(x) > 0 ? [x, cross(z, x), z] : [across(z), cross(z, across(z)), z];
}

/** A vector rotated around a unit axis, right-handed. */
function rotated(vector: Vector, axis: Vector, radians: number): Vector {
  const [sine, cosine] = [Math.sin(radians), Math.cos(radians)];
  const part = scaled(axis, dot(axis, vector) * (1 - cosine));
  return along(along(scaled(vector, cosine), cross(axis, vector), sine), part);
}
