// SPDX-License-Identifier: Apache-2.0

import { readFileSync } from "node:fs";
import { readStream } from "@structgstream/core";
import { expect, test } from "vitest";
import {
  axes,
  between,
  type Camera,
  center,
  cross,
  dot,
  fitted,
  focusPoint,
  frustum,
  length,
  lookAt,
  projected,
  resized,
  rigCamera,
  rigCameras,
  sameCamera,
  unprojected,
  upAxis,
  type Vector,
} from "../src/index.ts";
import { quaternionOf, rotationOf } from "../src/vectors.ts";

const CAMERA: Camera = {
  viewmat: lookAt([1, 2, -5], [0.5, 0, 0], [0, -1, 0.1]),
  K: { fx: 300, fy: 310, cx: 158, cy: 121 },
  width: 320,
  height: 240,
  near: 0.1,
};

function expectNear(found: readonly number[], wanted: readonly number[], digits = 9): void {
  expect(found.length).toBe(wanted.length);
  for (const [i, value] of wanted.entries()) expect(found[i]).toBeCloseTo(value, digits);
}

test("a camera that looks at a point has it in its middle, upright", () => {
  const [right, down, forward] = axes(CAMERA);
  expectNear(center(CAMERA), [1, 2, -5]);
  expectNear(cross(right, down), forward);
  const seen = projected(CAMERA, [0.5, 0, 0])!;
  expectNear([seen.x, seen.y], [CAMERA.K.cx, CAMERA.K.cy]);
  expect(dot(down, [0, -1, 0.1])).toBeLessThan(0);
  expect(Math.abs(dot(right, [0, -1, 0.1]))).toBeLessThan(1e-12);
});

test("looking along up, or at itself, still gives a rigid view", () => {
  for (const target of [
    [0, 5, 0],
    [0, 0, 0],
  ] as Vector[]) {
    const [right, down, forward] = axes({ viewmat: lookAt([0, 0, 0], target, [0, 1, 0]) });
    expectNear([length(right), length(down), length(forward), dot(right, down), dot(down, forward)], [1, 1, 1, 0, 0]);
  }
});

test("pixels and points of the scene are each other's inverse", () => {
  const point = unprojected(CAMERA, 17, 201, 3.5);
  const { x, y, depth } = projected(CAMERA, point)!;
  expectNear([x, y, depth], [17, 201, 3.5]);
  expect(projected(CAMERA, [1, 2, -6])).toBeUndefined();
  const corner = projected(CAMERA, frustum(CAMERA, 2)[2])!;
  expectNear([corner.x, corner.y], [320, 240]);
});

test("a picture of another shape shows all that the camera's own showed", () => {
  const wide = fitted(CAMERA, 1000, 240);
  const point = unprojected(CAMERA, 0, 0, 2);
  const found = projected(wide, point)!;
  expectNear([found.x, found.y], [340, 0]);
  const half = projected(resized(CAMERA, 160, 480), point)!;
  expectNear([half.x, half.y], [0, 0]);
  expect(resized(CAMERA, 160, 480).K.fx).toBe(150);
});

test("rotations survive as quaternions, half turns included", () => {
  for (const viewmat of [
    lookAt([0, 0, 0], [0, 0, 1], [0, -1, 0]),
    lookAt([0, 0, 0], [0, 0, -1], [0, 1, 0]),
    CAMERA.viewmat,
  ]) {
    const rotation = axes({ viewmat });
    expectNear(rotationOf(quaternionOf(rotation)).flat(), rotation.flat());
  }
});

test("between two cameras lies a rigid one, and at the ends they themselves", () => {
  const other: Camera = { ...CAMERA, viewmat: lookAt([-4, 1, 2], [0, 0, 0], [0, -1, 0]), K: { ...CAMERA.K, fx: 600 } };
  expectNear([...between(CAMERA, other, 0).viewmat], [...CAMERA.viewmat]);
  expectNear([...between(CAMERA, other, 1).viewmat], [...other.viewmat]);
  const middle = between(CAMERA, other, 0.5, [0, 0, 0]);
  const [right, down, forward] = axes(middle);
  expectNear([length(right), length(down), dot(right, forward), dot(right, down)], [1, 1, 0, 0]);
  expect(length(center(middle))).toBeCloseTo((length([1, 2, -5]) + length([-4, 1, 2])) / 2, 9);
  expect(middle.K.fx).toBeCloseTo(Math.sqrt(300 * 600), 9);
});

test("cameras are the same by what they see", () => {
  expect(sameCamera(CAMERA, { ...CAMERA, viewmat: CAMERA.viewmat.slice() })).toBe(true);
  expect(sameCamera(CAMERA, { ...CAMERA, width: 321 })).toBe(false);
});

/** Upright cameras around an up axis, some looking down. */
function dome(up: Vector, pitches: readonly number[]): Pick<Camera, "viewmat">[] {
  const side = axes({ viewmat: lookAt([0, 0, 0], [up[2], up[0], up[1]], up) });
  return pitches.map((pitch, i) => {
    const angle = (2 * Math.PI * i) / pitches.length;
    const eye = [0, 1, 2].map(
      (j) => 3 * (Math.cos(angle) * side[0][j]! + Math.sin(angle) * cross(up, side[0])[j]!) + pitch * up[j]!,
    ) as unknown as Vector;
    return { viewmat: lookAt(eye, [0, 0, 0], up) };
  });
}

test("up is what the rig's cameras agree on, however they are pitched", () => {
  const up: Vector = [0.6, 0, -0.8];
  expectNear(upAxis(dome(up, [0, 1, 2, 1.5, 3])), up);
  const same = { viewmat: lookAt([0, 0, -4], [0, 1, 0], [0, -1, 0]) };
  expectNear(
    upAxis([same, { viewmat: lookAt([0.3, 0, -4], [0.3, 1, 0], [0, -1, 0]) }]),
    axes(same)[1].map((x) => -x),
  );
});

test("a rig looks at the point where its cameras' axes meet, or ahead when they do not", () => {
  expectNear(focusPoint(dome([0, 1, 0], [0, 1, 2, 1])), [0, 0, 0]);
  const parallel = [-1, 1].map((x) => ({ viewmat: lookAt([x, 0, 0], [x, 0, 1], [0, -1, 0]) }));
  expectNear(focusPoint(parallel), [0, 0, 2]);
});

test("cameras of a header are in the scene's units, and an unknown one is refused by name", () => {
  const bytes = readFileSync(new URL("./fixtures/patch.sgs", import.meta.url));
  const header = readStream(new Uint8Array(bytes)).header!;
  const views = JSON.parse(readFileSync(new URL("./fixtures/patch/views.json", import.meta.url), "utf8")).views;
  const wanted = views.find((view: { name: string }) => view.name.startsWith("camera-cam00")).camera;
  const found = rigCamera(header, "cam00");
  expectNear([...found.viewmat], wanted.viewmat, 12);
  expectNear(
    [found.K.fx, found.K.cy, found.width, found.near],
    [wanted.K.fx, wanted.K.cy, wanted.width, wanted.near],
    12,
  );
  expect(rigCameras(header).length).toBe(header.cameras.length);
  expect(() => rigCamera(header, "cam77")).toThrow('The stream has no camera "cam77"; it has cam00,');
});
