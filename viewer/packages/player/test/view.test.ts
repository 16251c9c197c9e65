// SPDX-License-Identifier: Apache-2.0
/** Cameras moved by hand, on the way, in links; and how much is drawn. */

import { readStream } from "@structgstream/core";
import { along, axes, center, cross, dot, fitted, length, projected, type Vector } from "@structgstream/gl";
import { describe, expect, test } from "vitest";
import { Flight } from "../src/view/flight.ts";
import { linkOf, linkTo, viewFrom } from "../src/view/link.ts";
import { dollied, flown, looked, orbited, panned, type View, viewOf } from "../src/view/navigator.ts";
import { FrameBudget, QualityControl } from "../src/view/quality.ts";
import { nearPlane, rigOf } from "../src/view/rig.ts";
import { CLIP } from "./served.ts";

const RIG = rigOf(readStream(CLIP).header!);
const START = viewOf(RIG.first.camera, RIG.focus);

function expectNear(a: Vector, b: Vector, digits = 6): void {
  for (const i of [0, 1, 2] as const) expect(a[i]).toBeCloseTo(b[i], digits);
}

function expectRigid({ camera }: View): void {
  const [x, y, z] = axes(camera);
  expectNear(cross(x, y), z);
  for (const axis of [x, y, z]) expect(length(axis)).toBeCloseTo(1);
}

/** Where the pivot is in the picture. */
function pivotAt({ camera, pivot }: View): readonly [number, number] {
  const { x, y } = projected(camera, pivot)!;
  return [x, y];
}

test("a rig begins with the camera in its middle, and up is up", () => {
  expect(RIG.cameras.length).toBe(10);
  for (const { camera } of RIG.cameras) expect(dot(axes(camera)[1], RIG.up)).toBeLessThan(-0.5);
  const depth = dot(along(RIG.focus, center(START.camera), -1), axes(START.camera)[2]);
  expect(depth).toBeGreaterThan(0);
});

describe("the near plane", () => {
  const near = (view: View) => nearPlane(RIG, center(view.camera));

  test("at a camera of the rig is that of the capture", () => {
    for (const { camera } of RIG.cameras) expect(near(viewOf(camera, RIG.focus))).toBeCloseTo(camera.near, 9);
  });

  test("of who advances stays where it is", () => {
    const [, , forward] = axes(START.camera);
    const capture = START.camera.near;
    for (const share of [0.2, 0.5, 0.9]) {
      const view = flown(START, 0, 0, share * capture);
      expect(dot(along(center(view.camera), center(START.camera), -1), forward) + near(view)).toBeCloseTo(capture, 9);
    }
    const reach = length(along(START.pivot, center(START.camera), -1));
    // Half way to what is looked at, and beyond it, as good as nothing is cut.
    for (const share of [0.5, 1, 2]) expect(near(flown(START, 0, 0, share * reach))).toBeCloseTo(0.01 * capture, 9);
  });

  test("of who steps aside or back keeps its distance", () => {
    const step = 0.3 * START.camera.near;
    for (const [right, down, forward] of [
      [step, 0, 0],
      [0, -step, 0],
      [0, 0, -step],
      [step, 0, -step],
    ] as const)
      expect(near(flown(START, right, down, forward))).toBeCloseTo(START.camera.near, 9);
  });
});

describe("orbiting", () => {
  test("keeps the distance, the pivot in its place, and the camera rigid", () => {
    let view = START;
    const distance = length(along(center(view.camera), view.pivot, -1));
    for (let i = 0; i < 500; i++) view = orbited(view, 0.11, Math.sin(i) * 0.2, RIG.up);
    expectRigid(view);
    expect(length(along(center(view.camera), view.pivot, -1))).toBeCloseTo(distance);
    expect(pivotAt(view)[0]).toBeCloseTo(pivotAt(START)[0], 3);
    expect(pivotAt(view)[1]).toBeCloseTo(pivotAt(START)[1], 3);
  });

  test("never goes over the top", () => {
    let view = START;
    for (let i = 0; i < 100; i++) view = orbited(view, 0, 0.2, RIG.up);
    const arm = along(center(view.camera), view.pivot, -1);
    expect(dot(arm, RIG.up) / length(arm)).toBeGreaterThan(0.99);
    expect(dot(axes(view.camera)[1], RIG.up)).toBeLessThan(0.1);
    for (let i = 0; i < 100; i++) view = orbited(view, 0, -0.2, RIG.up);
    expect(dot(along(center(view.camera), view.pivot, -1), RIG.up)).toBeLessThan(0);
  });

  test("a drag to the right and down shows what is on the left and above", () => {
    const view = orbited(START, -0.2, 0.2, RIG.up);
    const moved = along(center(view.camera), center(START.camera), -1);
    expect(dot(moved, axes(START.camera)[0])).toBeLessThan(0);
    expect(dot(moved, RIG.up)).toBeGreaterThan(0);
  });
});

test("panning moves the pivot's depth by pixels", () => {
  const view = panned(START, 12, -7);
  const before = projected(START.camera, START.pivot)!;
  const after = projected(view.camera, START.pivot)!;
  expect(after.x - before.x).toBeCloseTo(12);
  expect(after.y - before.y).toBeCloseTo(-7);
});

test("a dolly goes to the pivot and never through it", () => {
  const distance = (view: View) => length(along(center(view.camera), view.pivot, -1));
  expect(distance(dollied(START, 0.5))).toBeCloseTo(distance(START) / 2);
  let view = START;
  for (let i = 0; i < 200; i++) view = dollied(view, 0.5);
  expect(distance(view)).toBeGreaterThan(0);
  expectRigid(view);
});

test("looking around and flying", () => {
  const view = looked(START, 0.3, 0.1, RIG.up);
  expectNear(center(view.camera), center(START.camera));
  expectRigid(view);
  const away = flown(START, 1, 2, 3);
  const [x, y, z] = axes(START.camera);
  expectNear(center(away.camera), along(along(along(center(START.camera), x), y, 2), z, 3));
});

test("a flight begins and ends where it should, at any moment asked", () => {
  const end = viewOf(RIG.cameras[3]!.camera, RIG.focus);
  const flight = new Flight(START, end, RIG.focus, 10, 2);
  expectNear(center(flight.at(9).view.camera), center(START.camera));
  expect(flight.at(11).over).toBe(false);
  expectRigid(flight.at(11).view);
  expect(flight.at(12)).toEqual({ view: end, over: true });
  expect(flight.at(99).over).toBe(true);
});

describe("links", () => {
  const page = new URL("https://here.example/play/?x=1#top");

  test("give the view back", () => {
    const view = orbited(START, 0.4, 0.3, RIG.up);
    const link = linkOf(new URL(linkTo(page, "https://here.example/a.sgs", 1.25, view)));
    expect([link.src, link.seconds, link.refused]).toEqual(["https://here.example/a.sgs", 1.25, []]);
    const again = viewFrom(link.view!, RIG.first.camera);
    expectRigid(again);
    expectNear(center(again.camera), center(view.camera), 4);
    expectNear(axes(again.camera)[2], axes(view.camera)[2], 4);
    expectNear(again.pivot, view.pivot, 3);
    expect(again.camera.K.fx).toBeCloseTo(view.camera.K.fx, 2);
    const shown = fitted(again.camera, 999, 555);
    expect(shown.K.fx).toBeCloseTo(fitted(view.camera, 999, 555).K.fx, 1);
  });

  test("take addresses of their own origin only", () => {
    const src = (text: string, base = page) => linkOf(new URL(`?src=${encodeURIComponent(text)}`, base)).src;
    expect(src("a.sgs")).toBe("https://here.example/play/a.sgs");
    expect(src("/a.sgs")).toBe("https://here.example/a.sgs");
    for (const text of [
      "https://there.example/a.sgs",
      "//there.example/a.sgs",
      "\\\\there.example\\a.sgs",
      "https://here.example@there.example/a.sgs",
      "https://user:word@here.example/a.sgs",
      "http://here.example/a.sgs",
      "https://here.example:444/a.sgs",
      "data:,x",
      "blob:https://here.example/x",
      "javascript:alert(1)",
      "file:///etc/passwd",
      "http://[",
    ]) {
      expect(src(text), text).toBeUndefined();
    }
    expect(src("a.sgs", new URL("file:///home/page.html"))).toBeUndefined();
  });

  test.each([
    "t=-1",
    "t=1e9",
    "t=Infinity",
    "t=",
    "view=1,2,3",
    "view=0,0,0,0,0,2,0,1,0,1,1",
    "view=0,0,0,0,0,1,0,0,1,1,1",
    "view=0,0,0,0,0,1,0,1,0,-1,1",
    "view=0,0,0,0,0,1,0,1,0,1,1e9",
    "view=NaN,0,0,0,0,1,0,1,0,1,1",
    "view=,,,,,,,,,,",
  ])("say what they refuse: %s", (query) => {
    const link = linkOf(new URL(`?${query}`, page));
    expect([link.view, link.seconds]).toEqual([undefined, undefined]);
    expect(link.refused.length).toBe(1);
  });
});

describe("quality", () => {
  const desk = { coarsePointer: false, memoryGigabytes: 8, processors: 8 };
  const phone = { coarsePointer: true, memoryGigabytes: 4, processors: 8 };

  test("a phone gets fewer splats and pixels", () => {
    expect(new QualityControl(desk).current).toEqual({ maxSplats: Number.POSITIVE_INFINITY, pixelScale: 1 });
    const weak = new QualityControl(phone).current;
    expect(weak.maxSplats).toBeGreaterThanOrEqual(150_000);
    expect(weak.maxSplats).toBeLessThanOrEqual(200_000);
    expect(weak.pixelScale).toBeLessThan(1);
  });

  test("slow pictures lose pixels, quick ones get them back, and a choice stays", () => {
    const quality = new QualityControl(desk);
    const pictures = (count: number, seconds: number) => {
      for (let i = 0; i < count; i++) quality.picture(seconds);
    };
    pictures(5, 0.1);
    expect(quality.current.pixelScale).toBe(1);
    pictures(20, 0.1);
    expect(quality.current.pixelScale).toBe(0.75);
    pictures(200, 0.1);
    expect(quality.current.pixelScale).toBe(0.35);
    pictures(700, 0.016);
    expect(quality.current.pixelScale).toBe(0.5);
    quality.choice = { maxSplats: 1000, pixelScale: 1 };
    pictures(100, 0.1);
    expect(quality.current).toEqual({ maxSplats: 1000, pixelScale: 1 });
  });
});

describe("the budget of a headset", () => {
  const desk = { coarsePointer: false, memoryGigabytes: 8, processors: 16 };
  const FRAME = 1 / 72;

  /** A device that draws so many splats at full size in time, and so many pictures on it. */
  function played(budget: FrameBudget, inTime: number, pictures: number, scene = 100_000): number[] {
    return Array.from({ length: pictures }, () => {
      const { maxSplats } = budget.current;
      const splats = Math.min(scene, maxSplats);
      budget.picture(splats > inTime ? 2 * FRAME : FRAME, splats);
      return splats;
    });
  }

  test("is all that there is, as long as pictures come in time", () => {
    const budget = new FrameBudget(new QualityControl(desk), FRAME);
    expect(new Set(played(budget, 200_000, 1000))).toEqual(new Set([100_000]));
    expect(budget.current).toEqual({ maxSplats: Number.POSITIVE_INFINITY, pixelScale: 1 });
  });

  test("is reduced until pictures come in time, in seconds, and then held", () => {
    const budget = new FrameBudget(new QualityControl(desk), FRAME);
    const splats = played(budget, 40_000, 72 * 60);
    expect(splats[0]).toBe(100_000);
    expect(splats.findIndex((count) => count <= 40_000)).toBeLessThan(72 * 3);
    // A larger share is tried more and more seldom.
    const late = splats.filter((count, i) => i >= 72 * 3 && count > 40_000).length;
    expect(late).toBeGreaterThan(0);
    expect(late / splats.length).toBeLessThan(0.05);
    expect(Math.min(...splats)).toBeGreaterThan(25_000);
    expect(budget.current.pixelScale).toBeCloseTo(Math.sqrt(0.75 ** 4), 2);
  });

  test("grows again where there is less to draw, and one hitch changes nothing", () => {
    const budget = new FrameBudget(new QualityControl(desk), FRAME);
    played(budget, 60_000, 300);
    expect(budget.current.maxSplats).toBeLessThan(60_000);
    played(budget, 200_000, 72 * 60);
    expect(budget.current).toEqual({ maxSplats: Number.POSITIVE_INFINITY, pixelScale: 1 });
    budget.picture(0.9, 100_000);
    played(budget, 200_000, 100);
    expect(budget.current.pixelScale).toBe(1);
  });

  test("leaves what the user has chosen, and begins with what the page does", () => {
    const quality = new QualityControl({ coarsePointer: true, memoryGigabytes: 2, processors: 4 });
    const budget = new FrameBudget(quality, FRAME);
    expect(budget.current).toEqual(quality.current);
    quality.choice = { maxSplats: 50_000, pixelScale: 0.75 };
    played(budget, 10_000, 1000);
    expect(budget.current).toEqual({ maxSplats: 50_000, pixelScale: 0.75 });
  });
});
