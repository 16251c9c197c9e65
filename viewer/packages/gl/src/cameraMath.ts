// SPDX-License-Identifier: Apache-2.0
/** Cameras as values: from a header, resized, directed at a point, or interpolated. */

import type { Camera as HeaderCamera, StreamHeader } from "@structgstream/core";
import { GlError } from "./errors.js";
import type { Camera, Intrinsics } from "./types.js";
import {
  across,
  along,
  cross,
  directionBetween,
  dot,
  length,
  type Rotation,
  rotationBetween,
  scaled,
  unit,
  type Vector,
} from "./vectors.js";

/** The rows of the rotation: directions of the camera's x (right), y (down) and z (forward) in the scene. */
export function axes({ viewmat: v }: Pick<Camera, "viewmat">): Rotation {
  return [
    [v[0]!, v[1]!, v[2]!],
    [v[4]!, v[5]!, v[6]!],
    [v[8]!, v[9]!, v[10]!],
  ];
}

/** The camera's position. */
export function center(camera: Pick<Camera, "viewmat">): Vector {
  const [right, down, forward] = axes(camera);
  const v = camera.viewmat;
  return scaled(along(along(scaled(right, v[3]!), down, v[7]!), forward, v[11]!), -1);
}

/** The view matrix of a camera at `eye` with these axes. */
export function viewmatOf(eye: Vector, [right, down, forward]: Rotation): Float64Array {
  const rows = [right, down, forward].flatMap((axis) => [...axis, -dot(axis, eye)]);
  return Float64Array.from([...rows, 0, 0, 0, 1]);
}

/** A camera at `eye` directed at `target`, upright with respect to `up`. */
export function lookAt(eye: Vector, target: Vector, up: Vector): Float64Array {
  const ahead = along(target, eye, -1);
  const forward = length(ahead) > 0 ? unit(ahead) : across(up);
  const sideways = cross(forward, up);
  const right = length(sideways) > 1e-9 * length(up) ? unit(sideways) : across(forward);
  return viewmatOf(eye, [right, cross(forward, right), forward]);
}

/** @throws GlError the rig has no camera of this name */
export function cameraNamed(header: StreamHeader, name: string): HeaderCamera {
  const found = header.cameras.find((camera) => camera.name === name);
  if (!found) {
    const names = header.cameras.map((camera) => camera.name).join(", ");
    throw new GlError(`The stream has no camera ${JSON.stringify(name)}; it has ${names}.`);
  }
  return found;
}

/**
 * A camera of the rig, in scene units.
 *
 * @throws GlError the rig has no camera of this name
 */
export function rigCamera(header: StreamHeader, name: string): Camera {
  const found = cameraNamed(header, name);
  const { scale } = header.similarity;
  const viewmat = Float64Array.from(found.viewmat);
  for (const row of [0, 4, 8]) {
    const shift = dot([viewmat[row]!, viewmat[row + 1]!, viewmat[row + 2]!], header.similarity.center);
    viewmat[row + 3] = (shift + viewmat[row + 3]!) * scale;
  }
  const [fx, , cx, , fy, cy] = found.K as unknown as [number, number, number, number, number, number];
  return {
    viewmat,
    K: { fx, fy, cx, cy },
    width: found.width,
    height: found.height,
    near: found.near * scale,
  };
}

/** Every camera of the rig in its order, in scene units. */
export function rigCameras(header: StreamHeader): Camera[] {
  return header.cameras.map(({ name }) => rigCamera(header, name));
}

/** The same view with its picture resampled, stretched if the sides' proportion differs. */
export function resized(camera: Camera, width: number, height: number): Camera {
  const { fx, fy, cx, cy } = camera.K;
  const [x, y] = [width / camera.width, height / camera.height];
  return { ...camera, K: { fx: fx * x, fy: fy * y, cx: cx * x, cy: cy * y }, width, height };
}

/** The same view on a picture of another size: all of it is visible, and more on two sides if the proportion differs. */
export function fitted(camera: Camera, width: number, height: number): Camera {
  const { fx, fy, cx, cy } = camera.K;
  const factor = Math.min(width / camera.width, height / camera.height);
  const K: Intrinsics = {
    fx: fx * factor,
    fy: fy * factor,
    cx: (cx - camera.width / 2) * factor + width / 2,
    cy: (cy - camera.height / 2) * factor + height / 2,
  };
  return { ...camera, K, width, height };
}

/** Pixel (x, y) of a point of the scene, and its depth along z; undefined for points that are not in front of the camera. */
export function projected(camera: Camera, point: Vector): { x: number; y: number; depth: number } | undefined {
  const from = along(point, center(camera), -1);
  const [x, y, depth] = axes(camera).map((axis) => dot(axis, from)) as [number, number, number];
  if (!(depth > 0)) return undefined;
  return { x: (camera.K.fx * x) / depth + camera.K.cx, y: (camera.K.fy * y) / depth + camera.K.cy, depth };
}

/** The point of the scene that pixel (x, y) shows at `depth` along z. */
export function unprojected(camera: Camera, x: number, y: number, depth: number): Vector {
  const { fx, fy, cx, cy } = camera.K;
  const [right, down, forward] = axes(camera);
  const sideways = along(scaled(right, ((x - cx) / fx) * depth), down, ((y - cy) / fy) * depth);
  return along(along(center(camera), sideways), forward, depth);
}

/** The corners of the camera's view at `depth`: top left, top right, bottom right, bottom left. */
export function frustum(camera: Camera, depth: number): readonly [Vector, Vector, Vector, Vector] {
  const { width, height } = camera;
  return [
    unprojected(camera, 0, 0, depth),
    unprojected(camera, width, 0, depth),
    unprojected(camera, width, height, depth),
    unprojected(camera, 0, height, depth),
  ];
}

/**
 * A camera `share` of the way from one to another, with the picture's size of the first.
 *
 * @param around the path goes around this point, at distances between those of the ends; straight if undefined
 */
export function between(from: Camera, to: Camera, share: number, around?: Vector): Camera {
  const end = fitted(to, from.width, from.height);
  const mixed = (a: number, b: number) => a + (b - a) * share;
  const [first, last] = [center(from), center(end)];
  let eye = along(scaled(first, 1 - share), last, share);
  if (around) {
    const [a, b] = [along(first, around, -1), along(last, around, -1)];
    eye = along(around, directionBetween(a, b, share), mixed(length(a), length(b)));
  }
  return {
    viewmat: viewmatOf(eye, rotationBetween(axes(from), axes(end), share)),
    K: {
      // A zoom looks uniform if the logarithm of the focal length is linear.
      fx: Math.exp(mixed(Math.log(from.K.fx), Math.log(end.K.fx))),
      fy: Math.exp(mixed(Math.log(from.K.fy), Math.log(end.K.fy))),
      cx: mixed(from.K.cx, end.K.cx),
      cy: mixed(from.K.cy, end.K.cy),
    },
    width: from.width,
    height: from.height,
    near: mixed(from.near, end.near),
  };
}

/** Whether two cameras give the same picture of the same scene. */
export function sameCamera(a: Camera, b: Camera): boolean {
  if (a === b) return true;
  const { fx, fy, cx, cy } = a.K;
  const sameK = fx === b.K.fx && fy === b.K.fy && cx === b.K.cx && cy === b.K.cy;
  const sameSize = a.width === b.width && a.height === b.height && a.near === b.near;
  return sameK && sameSize && a.viewmat.every((value, i) => value === b.viewmat[i]);
}
