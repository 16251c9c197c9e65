// SPDX-License-Identifier: Apache-2.0
/**
 * The parameters of a link to a player: `?src=&t=&view=&embed=1`.
 *
 * Anyone can write a link, so it may only choose a stream of the page's own origin, and numbers are accepted only if they
 * are those of a view.
 */

import {
  along,
  axes,
  type Camera,
  center,
  cross,
  length,
  type Rotation,
  unit,
  type Vector,
  viewmatOf,
} from "@structgstream/gl";
import type { View } from "./navigator.js";

const FAR = 1e6;
const FOCAL: readonly [number, number] = [0.05, 50];
const DIGITS = 5;
const MAX_SECONDS = 1e7;

/** A view as text, in units of the scene, whatever the picture's size. */
export interface LinkedView {
  readonly eye: Vector;
  readonly forward: Vector;
  readonly down: Vector;
  readonly distance: number;
  /** Focal length in widths of the picture. */
  readonly focal: number;
}

export interface Link {
  /** An absolute address of the page's own origin. */
  readonly src: string | undefined;
  readonly seconds: number | undefined;
  readonly view: LinkedView | undefined;
  readonly embed: boolean;
  /** A sentence for each refused parameter. */
  readonly refused: readonly string[];
}

export function linkOf(page: URL): Link {
  const { searchParams } = page;
  const refused: string[] = [];
  const taken = <Value>(name: string, value: (text: string) => Value | undefined, expected: string) => {
    const text = searchParams.get(name);
    const found = text === null ? undefined : value(text);
    if (text !== null && found === undefined) refused.push(`The link's "${name}" was not taken: expected ${expected}.`);
    return found;
  };
  return {
    src: taken("src", (text) => ownAddress(text, page), "a stream of this page's own origin"),
    seconds: taken("t", secondsOf, "seconds"),
    view: taken("view", linkedView, "the eleven numbers of a view"),
    embed: searchParams.get("embed") === "1",
    refused,
  };
}

/** The link to the present stream, time and view. */
export function linkTo(page: URL, src: string | undefined, seconds: number, view: View): string {
  const link = new URL(page);
  link.hash = "";
  if (src !== undefined) link.searchParams.set("src", src);
  link.searchParams.set("t", String(Number(seconds.toFixed(3))));
  link.searchParams.set("view", textOf(view));
  return link.href;
}

/** The camera of a linked view on a picture like that of `like`. */
export function viewFrom({ eye, forward, down, distance, focal }: LinkedView, like: Camera): View {
  const x = unit(cross(down, forward));
  const rotation: Rotation = [x, cross(forward, x), forward];
  const [width, height] = [like.width, like.height];
  const K = { fx: focal * width, fy: focal * width, cx: width / 2, cy: height / 2 };
  const camera = { viewmat: viewmatOf(eye, rotation), K, width, height, near: like.near };
  return { camera, pivot: along(eye, forward, distance) };
}

function textOf({ camera, pivot }: View): string {
  const [, down, forward] = axes(camera);
  const eye = center(camera);
  const numbers = [...eye, ...forward, ...down, length(along(pivot, eye, -1)), camera.K.fx / camera.width];
  return numbers.map((value) => String(Number(value.toFixed(DIGITS)))).join(",");
}

function linkedView(text: string): LinkedView | undefined {
  const numbers =
    text.length < 400 ? text.split(",").map((part) => (part.trim() === "" ? Number.NaN : Number(part))) : [];
  if (numbers.length !== 11 || !numbers.every((value) => Math.abs(value) < FAR)) return undefined;
  const [eye, forward, down] = [0, 3, 6].map((at) => numbers.slice(at, at + 3) as unknown as Vector);
  const [distance, focal] = [numbers[9]!, numbers[10]!];
  const sine = length(cross(down!, forward!));
  const lengths = [forward!, down!].map(length);
  if (!lengths.every((value) => Math.abs(value - 1) < 0.01) || sine < 0.9) return undefined;
  if (distance <= 0 || focal < FOCAL[0] || focal > FOCAL[1]) return undefined;
  return { eye: eye!, forward: unit(forward!), down: down!, distance, focal };
}

function secondsOf(text: string): number | undefined {
  const value = /^\d{1,9}(\.\d{1,9})?$/.test(text) ? Number(text) : Number.NaN;
  return value <= MAX_SECONDS ? value : undefined;
}

function ownAddress(text: string, page: URL): string | undefined {
  if (!URL.canParse(text, page.href)) return undefined;
  const found = new URL(text, page.href);
  const isWeb = found.protocol === "http:" || found.protocol === "https:";
  return isWeb && found.origin === page.origin && !found.username && !found.password ? found.href : undefined;
}
