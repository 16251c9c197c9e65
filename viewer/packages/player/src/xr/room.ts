// SPDX-License-Identifier: Apache-2.0
/** The viewer's room in the scene, and the cameras of the eyes; without state. */

import {
  along,
  axes,
  type Camera,
  center,
  cross,
  dot,
  frustum,
  length,
  mean,
  type Rotation,
  scaled,
  unit,
  type Vector,
  viewmatOf,
} from "@structgstream/gl";
import type { View } from "../view/navigator.js";
import type { Rig } from "../view/rig.js";

/** A reference space of WebXR (metres, y up, the floor at 0) in the scene. */
export interface Room {
  /** The room's origin in the scene. */
  readonly origin: Vector;
  /** The room's x (right), y (up) and z (back) in the scene. */
  readonly axes: Rotation;
  /** Scene units per metre. */
  readonly scale: number;
}

/** Sixteen numbers, column by column, as WebXR has them. */
export type Matrix = ArrayLike<number>;

/** Height of a rig's cameras above the floor, on average, where nothing is known of it; and the least and largest one. */
const LENS_METRES = 1.5;
const [MIN_LENS_METRES, MAX_LENS_METRES] = [0.5, 3];
/** Share of the anchors around the focus that may be below the floor: reflections, and what floats. */
const BELOW_FLOOR = 0.05;
/** Distances from a camera to the rig's focus that people film at; at others, lengths are taken to be in another unit than metres. */
const USUAL_METRES = [1, 10] as const;
const SUBJECT_METRES = 3;
/** Hands closer together than this do not scale. */
const MIN_HANDS_METRES = 0.03;

/**
 * Metres per unit of the capture, as far as the rig tells: 1, if the distance from its first camera to its focus is then a
 * usual one; otherwise what makes this distance 3 m.
 *
 * @param scale scene units per unit of the capture
 */
export function assumedMetres({ first, focus }: Rig, scale: number): number {
  const units = length(along(focus, center(first.camera), -1)) / scale;
  return units >= USUAL_METRES[0] && units <= USUAL_METRES[1] ? 1 : SUBJECT_METRES / units;
}

/**
 * Height of the floor along the rig's up direction, in scene units: below the anchors around the focus, but 0.5 to 3 m below
 * the cameras' mean; 1.5 m without anchors.
 *
 * @param scale scene units per metre
 * @param anchors [M, 3] in the scene; undefined where they are not known yet
 */
export function floorHeight(
  { cameras, first, focus, up }: Rig,
  scale: number,
  anchors: Float32Array | undefined,
): number {
  const lens = dot(mean(cameras.map(({ camera }) => center(camera))), up);
  const reach = length(along(focus, center(first.camera), -1));
  const heights: number[] = [];
  for (let i = 0; i < (anchors?.length ?? 0); i += 3) {
    const point: Vector = [anchors![i]!, anchors![i + 1]!, anchors![i + 2]!];
    if (length(along(point, focus, -1)) < reach) heights.push(dot(point, up));
  }
  const lowest = Float64Array.from(heights).sort()[Math.floor(BELOW_FLOOR * heights.length)];
  const metres = lowest === undefined ? LENS_METRES : (lens - lowest) / scale;
  return lens - Math.min(Math.max(metres, MIN_LENS_METRES), MAX_LENS_METRES) * scale;
}

/**
 * A room whose viewer stands where the camera of `view` stands, and faces what it shows.
 *
 * @param up the scene's
 * @param floor height along `up` in scene units
 * @param scale scene units per metre
 * @param head the viewer's pose in the room
 */
export function standingAt(view: View, up: Vector, floor: number, scale: number, head: Matrix): Room {
  const eye = center(view.camera);
  const level = (vector: Vector, along_: Vector) => along(vector, along_, -dot(vector, along_));
  const ahead = level(along(view.pivot, eye, -1), up);
  // A camera that looks straight down has what is ahead at the top of its picture.
  const faced = length(ahead) > 1e-6 ? ahead : level(scaled(axes(view.camera)[1], -1), up);
  const back = scaled(unit(faced), -1);
  const straight: Room = { origin: [0, 0, 0], axes: [cross(up, back), up, back], scale };
  const position = positionOf(head);
  const [x, , z] = position;
  const turn = Math.atan2(head[8]!, head[10]!); // of the head, to the left
  const facing = turned(straight, position, turn);
  return anchored(facing, [x, 0, z], along(eye, up, floor - dot(eye, up)));
}

export function positionOf(pose: Matrix): Vector {
  return [pose[12]!, pose[13]!, pose[14]!];
}

/** A point of the room in the scene. */
export function inScene({ origin, axes: [x, y, z], scale }: Room, [a, b, c]: Vector): Vector {
  return along(along(along(origin, x, a * scale), y, b * scale), z, c * scale);
}

/** The room moved such that `point` in it is `at` in the scene. */
function anchored(room: Room, point: Vector, at: Vector): Room {
  return { ...room, origin: along(room.origin, along(at, inScene(room, point), -1)) };
}

/** The room turned to the right in the scene by an angle, around a point of it: so turns a viewer who is there. */
export function turned(room: Room, around: Vector, radians: number): Room {
  const [x, y, z] = room.axes;
  const [cosine, sine] = [Math.cos(radians), Math.sin(radians)];
  const rotation: Rotation = [along(scaled(x, cosine), z, sine), y, along(scaled(z, cosine), x, -sine)];
  return anchored({ ...room, axes: rotation }, around, inScene(room, around));
}

/** The scene pulled along with one hand, or turned and scaled by two, whose positions in the room were `before`. */
export function pulled(room: Room, before: readonly Vector[], after: readonly Vector[]): Room {
  if (!after.length) return room;
  const [from, to] = [mean(before), mean(after)];
  let moved = room;
  if (after.length === 2) {
    const [a, b] = [along(before[1]!, before[0]!, -1), along(after[1]!, after[0]!, -1)];
    if (Math.min(length(a), length(b)) > MIN_HANDS_METRES) {
      const turn = Math.atan2(a[2], a[0]) - Math.atan2(b[2], b[0]);
      moved = { ...turned(room, from, turn), scale: (room.scale * length(a)) / length(b) };
    }
  }
  return anchored(moved, to, inScene(room, from));
}

/**
 * The camera of an eye.
 *
 * @param pose of the eye in the room
 * @param projection of WebXR, to clip coordinates
 * @param near in scene units
 */
export function eyeCamera(
  room: Room,
  pose: Matrix,
  projection: Matrix,
  width: number,
  height: number,
  near: number,
): Camera {
  const [x, y, z] = room.axes;
  const axis = (at: number, sign: number): Vector =>
    scaled(along(along(scaled(x, pose[at]!), y, pose[at + 1]!), z, pose[at + 2]!), sign);
  const K = {
    fx: (projection[0]! * width) / 2,
    fy: (projection[5]! * height) / 2,
    cx: ((1 - projection[8]!) * width) / 2,
    cy: ((1 + projection[9]!) * height) / 2,
  };
  // Eyes look along -z of WebXR, with y up; cameras along z, with y down.
  const rotation: Rotation = [axis(0, 1), axis(4, -1), axis(8, -1)];
  return { viewmat: viewmatOf(inScene(room, positionOf(pose)), rotation), K, width, height, near };
}

/** A camera between the eyes whose picture has room for all directions of theirs. */
export function middleOf(eyes: readonly Camera[]): Camera {
  const [first] = eyes;
  if (eyes.length === 1) return first!;
  const forward = unit(mean(eyes.map((eye) => axes(eye)[2])));
  const sideways = mean(eyes.map((eye) => axes(eye)[0]));
  const right = unit(along(sideways, forward, -dot(sideways, forward)));
  const rotation: Rotation = [right, cross(forward, right), forward];
  const corners = eyes.flatMap((eye) => frustum(eye, 1).map((corner) => along(corner, center(eye), -1)));
  const slopes = [0, 1].map((i) => corners.map((corner) => dot(corner, rotation[i]!) / dot(corner, forward)));
  const [left, top] = slopes.map((found) => Math.min(...found)) as [number, number];
  const [fx, fy] = [first!.width / (Math.max(...slopes[0]!) - left), first!.height / (Math.max(...slopes[1]!) - top)];
  return {
    ...first!,
    viewmat: viewmatOf(mean(eyes.map(center)), rotation),
    K: { fx, fy, cx: -left * fx, cy: -top * fy },
    near: Math.min(...eyes.map(({ near }) => near)),
  };
}
