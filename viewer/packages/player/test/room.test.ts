// SPDX-License-Identifier: Apache-2.0
/** The room of a headset in the scene: where the viewer stands, how large it is, and what the eyes see. */

import { readFileSync } from "node:fs";
import { readStream } from "@structgstream/core";
import { axes, type Camera, center, dot, length, projected, unprojected, type Vector } from "@structgstream/gl";
import { describe, expect, test } from "vitest";
import { looked, viewOf } from "../src/view/navigator.ts";
import { type Rig, rigOf } from "../src/view/rig.ts";
import {
  assumedMetres,
  eyeCamera,
  floorHeight,
  inScene,
  middleOf,
  pulled,
  type Room,
  standingAt,
  turned,
} from "../src/xr/room.ts";

/** Metres, z up, cameras 1.2 m above z = 0, 3 m from the z axis; the middle one looks along y (`make_dots.py`). */
const HEADER = readStream(new Uint8Array(readFileSync(new URL("./fixtures/dots.sgs", import.meta.url)))).header!;
const RIG = rigOf(HEADER);
const SCALE = HEADER.similarity.scale;
const START = viewOf(RIG.first.camera, RIG.focus);
const HEAD_HEIGHT = 1.7;
/** z = 0 in the scene. */
const FLOOR = scenePoint(0, 0, 0)[2];

/** A point of the capture in the scene. */
function scenePoint(...point: [number, number, number]): Vector {
  return point.map((value, i) => (value - HEADER.similarity.center[i]!) * SCALE) as unknown as Vector;
}

/** A pose at a place, turned to the left and then up: 16 numbers, column by column. */
function pose([x, y, z]: Vector, left = 0, up = 0): number[] {
  const [s, c, t, d] = [Math.sin(left), Math.cos(left), Math.sin(up), Math.cos(up)];
  return [c, 0, -s, 0, s * t, d, c * t, 0, s * d, -t, c * d, 0, x, y, z, 1];
}

/** As of WebXR, from the tangents of the four sides. */
function projection(left: number, right: number, down: number, up: number): number[] {
  const [w, h] = [right - left, up - down];
  return [2 / w, 0, 0, 0, 0, 2 / h, 0, 0, (right + left) / w, (up + down) / h, -1, -1, 0, 0, -0.2, 0];
}

function multiplied(a: readonly number[], point: readonly number[]): number[] {
  return [0, 1, 2, 3].map((row) => point.reduce((sum, value, column) => sum + a[4 * column + row]! * value, 0));
}

/** The inverse of a rigid matrix. */
function inverse(m: readonly number[]): number[] {
  const rows = [0, 1, 2].map((i) => [m[4 * i]!, m[4 * i + 1]!, m[4 * i + 2]!]);
  const shift = rows.map((row) => -(row[0]! * m[12]! + row[1]! * m[13]! + row[2]! * m[14]!));
  return [0, 1, 2].flatMap((column) => [...rows.map((row) => row[column]!), 0]).concat([...shift, 1]);
}

function expectNear(a: readonly number[], b: readonly number[], digits = 6): void {
  expect(a.length).toBe(b.length);
  for (const [i, value] of a.entries()) expect(value).toBeCloseTo(b[i]!, digits);
}

describe("the room", () => {
  const head = pose([0, HEAD_HEIGHT, 0]);
  const room = standingAt(START, RIG.up, FLOOR, SCALE, head);

  test("has its floor below the cameras, and its viewer at the camera, facing what it shows", () => {
    expectNear(inScene(room, [0, HEAD_HEIGHT, 0]), scenePoint(0, -3, HEAD_HEIGHT));
    expectNear(inScene(room, [0, 0, -3]), scenePoint(0, 0, 0));
    expectNear(inScene(room, [1, 0, -3]), scenePoint(1, 0, 0));
  });

  test("is the same for a viewer who is elsewhere in it, and looks elsewhere, at the start", () => {
    const from = pose([0.7, 1.2, -0.4], 2.1, 0.3);
    const other = standingAt(START, RIG.up, FLOOR, SCALE, from);
    expectNear(inScene(other, [0.7, 1.2, -0.4]), scenePoint(0, -3, 1.2));
    const ahead = multiplied(from, [0, 0, -1, 0]);
    const flat = Math.hypot(ahead[0]!, ahead[2]!);
    const target = [0.7 + (3 * ahead[0]!) / flat, 0, -0.4 + (3 * ahead[2]!) / flat] as Vector;
    expectNear(inScene(other, target), scenePoint(0, 0, 0));
  });

  test("is level for a camera that looks down or up", () => {
    for (const pitch of [-Math.PI / 2, -0.8, 0.8]) {
      const tilted = looked(START, 0, pitch, RIG.up);
      const found = standingAt(tilted, RIG.up, FLOOR, SCALE, head);
      expectNear(found.axes[1], RIG.up);
      expectNear(inScene(found, [0, 0, -3]), scenePoint(0, 0, 0), 4);
    }
  });

  test("turns around its viewer, to the right", () => {
    const at: Vector = [0.4, HEAD_HEIGHT, -1];
    const right = turned(room, at, Math.PI / 2);
    expectNear(inScene(right, at), inScene(room, at));
    // What was a metre to the right is now a metre ahead.
    expectNear(inScene(right, [0.4, 0, -2]), inScene(room, [1.4, 0, -1]));
  });

  test("comes along with a hand", () => {
    const moved = pulled(room, [[0, 1, -0.5]], [[0.2, 1.3, -0.1]]);
    expectNear(inScene(moved, [0.2, 1.3, -0.1]), inScene(room, [0, 1, -0.5]));
    expectNear(moved.axes.flat(), room.axes.flat());
    expect(pulled(room, [], [])).toBe(room);
  });

  test("turns and grows between two hands", () => {
    const before: Vector[] = [
      [-0.2, 1, -0.5],
      [0.2, 1, -0.5],
    ];
    const after: Vector[] = [
      [0, 1.1, -0.1],
      [0, 1.1, -0.9],
    ];
    const moved = pulled(room, before, after);
    for (const i of [0, 1]) expectNear(inScene(moved, after[i]!), inScene(room, before[i]!));
    expect(moved.scale).toBeCloseTo(room.scale / 2, 9);
    expectNear(moved.axes[1], RIG.up);
    const closed = pulled(room, before, [
      [0, 1, -0.5],
      [0, 1, -0.5],
    ]);
    expect(closed.scale).toBe(room.scale);
  });
});

describe("the floor", () => {
  const anchors = (...heights: number[]) => Float32Array.from(heights.flatMap((height) => scenePoint(0, 0.5, height)));

  test("is below the anchors around the focus, but for a few, and for those elsewhere", () => {
    const many = Array.from({ length: 100 }, (_, i) => 0.2 + 0.02 * i);
    expect(floorHeight(RIG, SCALE, anchors(-1, ...many, -0.5))).toBeCloseTo(scenePoint(0, 0, 0.26)[2], 4);
    const far = Float32Array.from(Array.from({ length: 50 }, () => scenePoint(0, 8, -1)).flat());
    expect(floorHeight(RIG, SCALE, Float32Array.from([...anchors(...many), ...far]))).toBeCloseTo(
      scenePoint(0, 0, 0.3)[2],
      4,
    );
  });

  test("is 1.5 m below the cameras where nothing is known, and never far from there", () => {
    expect(floorHeight(RIG, SCALE, undefined)).toBeCloseTo(scenePoint(0, 0, -0.3)[2], 5);
    expect(floorHeight(RIG, SCALE, anchors(1))).toBeCloseTo(scenePoint(0, 0, 0.7)[2], 5);
    // Of a capture whose unit is 4 metres.
    expect(floorHeight(RIG, SCALE / 4, undefined)).toBeCloseTo(scenePoint(0, 0, 1.2 - 1.5 / 4)[2], 5);
    expect(floorHeight(RIG, SCALE / 4, anchors(0))).toBeCloseTo(scenePoint(0, 0, 1.2 - 3 / 4)[2], 5);
  });
});

describe("metres", () => {
  /** The rig with all lengths multiplied. */
  const times = (factor: number): Rig => {
    const grown = (camera: Camera): Camera => {
      const viewmat = Float64Array.from(camera.viewmat, (value, i) => (i % 4 === 3 && i < 12 ? value * factor : value));
      return { ...camera, viewmat };
    };
    const first = { ...RIG.first, camera: grown(RIG.first.camera) };
    return { ...RIG, first, focus: RIG.focus.map((value) => value * factor) as unknown as Vector };
  };

  test("are the capture's unit where people film from such a distance", () => {
    expect(assumedMetres(RIG, SCALE)).toBe(1);
    expect(assumedMetres(times(0.5), SCALE)).toBe(1);
    expect(assumedMetres(times(3), SCALE)).toBe(1);
  });

  test("otherwise put the focus at 3 m: of millimetres, say, or of a reconstruction without a scale", () => {
    expect(assumedMetres(times(1000), SCALE)).toBeCloseTo(0.001, 9);
    expect(assumedMetres(times(0.1), SCALE)).toBeCloseTo(10, 5);
  });
});

describe("the eyes", () => {
  const room: Room = turned(standingAt(START, RIG.up, FLOOR, SCALE, pose([0, HEAD_HEIGHT, 0])), [0, 0, 0], 0.3);
  const [WIDTH, HEIGHT] = [200, 160];
  const poses = [pose([-0.032, 1.6, 0.1], 0.05, 0.2), pose([0.032, 1.6, 0.1], -0.05, 0.2)];
  // Sides are not alike: outside, an eye sees farther than inside.
  const projections = [projection(-1.2, 0.9, -1.1, 0.8), projection(-0.9, 1.2, -1.1, 0.8)];
  const eyes = poses.map((at, i) => eyeCamera(room, at, projections[i]!, WIDTH, HEIGHT, 0.01));

  test("see a point where WebXR's matrices have it", () => {
    for (const [i, eye] of eyes.entries()) {
      for (const point of [[0.3, 1.9, -2] as Vector, [-0.4, 0.4, -1.1] as Vector, [0, 1.6, -30] as Vector]) {
        const clip = multiplied(projections[i]!, multiplied(inverse(poses[i]!), [...point, 1]));
        const [x, y] = [clip[0]! / clip[3]!, clip[1]! / clip[3]!];
        const found = projected(eye, inScene(room, point))!;
        expectNear([found.x, found.y], [((x + 1) / 2) * WIDTH, ((1 - y) / 2) * HEIGHT]);
        expect(found.depth).toBeCloseTo(clip[3]! * SCALE, 6);
      }
    }
  });

  test("have a camera between them that sees what they see", () => {
    const middle = middleOf(eyes);
    expect(
      length(center(middle).map((value, i) => value - inScene(room, [0, 1.6, 0.1])[i]!) as unknown as Vector),
    ).toBeLessThan(1e-9);
    const [right, down, forward] = axes(middle);
    expectNear([dot(right, down), dot(right, forward), dot(down, forward), length(down)], [0, 0, 0, 1]);
    for (const eye of eyes) {
      for (const [x, y] of [
        [0, 0],
        [WIDTH, 0],
        [WIDTH, HEIGHT],
        [0, HEIGHT],
      ] as const) {
        // Far away, where the distance of the eyes is nothing.
        const found = projected(middle, unprojected(eye, x, y, 1e6))!;
        expect(found.x).toBeGreaterThan(-0.01);
        expect(found.x).toBeLessThan(WIDTH + 0.01);
        expect(found.y).toBeGreaterThan(-0.01);
        expect(found.y).toBeLessThan(HEIGHT + 0.01);
      }
    }
    expect(middleOf([eyes[0]!])).toBe(eyes[0]);
  });
});
