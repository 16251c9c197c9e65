// SPDX-License-Identifier: Apache-2.0
/** Our own pictures of a stream, and its rig's cameras as engines with y up have them: what their pictures are compared with. */

import type { StreamReader } from "@structgstream/core";
import { type Camera, resized, rigCamera, SplatRenderer } from "@structgstream/gl";
import { pixelsOf } from "./pixels.js";

export class OwnPictures {
  private readonly renderer: SplatRenderer;

  constructor(private readonly reader: StreamReader) {
    this.renderer = new SplatRenderer(document.createElement("canvas"), {
      sorter: new URL("/sorter.js", location.href),
    });
    // The packages for engines draw no environment.
    const known = [...reader.header!.static].filter(([name]) => name !== "environment");
    this.renderer.load({ ...reader.header!, static: new Map(known) });
  }

  /** RGBA of a frame. */
  async picture(index: number, camera: Camera): Promise<Uint8ClampedArray> {
    const { fields, ptsSeconds } = this.reader.frame(index);
    const changed = [...fields].filter(([name]) => this.reader.header!.dynamic.has(name));
    this.renderer.update({ index, ptsSeconds, fields: new Map(changed) });
    await this.renderer.renderSettled(camera);
    return pixelsOf(await this.renderer.screenshot());
  }

  destroy(): void {
    this.renderer.destroy();
  }
}

/** A camera of the rig with y up and z back, in units of the capture, on a picture of `size` times its own. */
export interface EngineCamera {
  readonly own: Camera;
  /** Camera to world, column by column. */
  readonly toWorld: readonly number[];
  /** Sides of the frustum at `near`. */
  readonly left: number;
  readonly right: number;
  readonly bottom: number;
  readonly top: number;
  readonly near: number;
  readonly far: number;
}

export function engineCamera({ header }: StreamReader, name: string, size: number): EngineCamera {
  const filmed = rigCamera(header!, name);
  const own = resized(filmed, Math.round(size * filmed.width), Math.round(size * filmed.height));
  const { viewmat: v, near } = header!.cameras.find((camera) => camera.name === name)!;
  const axis = (row: number) => [v[4 * row]!, v[4 * row + 1]!, v[4 * row + 2]!] as const;
  const eye = [0, 1, 2].map((i) => -(axis(0)[i]! * v[3]! + axis(1)[i]! * v[7]! + axis(2)[i]! * v[11]!));
  // Both sides are turned around x by 180 degrees.
  const column = ([x, y, z]: readonly number[], sign: number) => [sign * x!, -sign * y!, -sign * z!];
  const toWorld = [
    ...[...column(axis(0), 1), 0],
    ...[...column(axis(1), -1), 0],
    ...[...column(axis(2), -1), 0],
    ...[...column(eye, 1), 1],
  ];
  const { K, width, height } = own;
  const [x, y] = [near / K.fx, near / K.fy];
  const sides = { left: -K.cx * x, right: (width - K.cx) * x, bottom: (K.cy - height) * y, top: K.cy * y };
  return { own, toWorld, ...sides, near, far: 1000 * near };
}
