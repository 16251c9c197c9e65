// SPDX-License-Identifier: Apache-2.0
/** What runs in the browser: frames by Spark in a three.js scene, and by the player's own renderer. */

import { SparkRenderer } from "@sparkjsdev/spark";
import { readStream, type StreamReader } from "@structgstream/core";
import { type Camera, resized, rigCamera, SplatRenderer } from "@structgstream/gl";
import { Matrix4, PerspectiveCamera, Scene, WebGLRenderer } from "three";
import { base64, pixelsOf } from "../../gl/test/support/pixels.ts";
import { StreamSplats } from "../src/index.ts";

/** Spark sorts in a worker; a picture is in order once sorting has been idle for so many pictures in a row. */
const PICTURES = 4;
const PAUSE_MILLISECONDS = 100;

export class Pair {
  readonly splats: StreamSplats;
  private readonly renderer = new WebGLRenderer({ preserveDrawingBuffer: true });
  private readonly scene = new Scene();
  private readonly spark: SparkRenderer;
  private readonly own: SplatRenderer;

  constructor(private readonly reader: StreamReader) {
    this.splats = new StreamSplats(reader.header!);
    this.own = new SplatRenderer(document.createElement("canvas"), { sorter: new URL("/sorter.js", location.href) });
    // The package draws no environment.
    const known = [...reader.header!.static].filter(([name]) => name !== "environment");
    this.own.load({ ...reader.header!, static: new Map(known) });
    // The low-pass of the training pictures is in the scales; the order is that of depth.
    const rules = { preBlurAmount: 0, blurAmount: 0, sortRadial: false, maxStdDev: 3, clipXY: 4 };
    this.spark = new SparkRenderer({ renderer: this.renderer, ...rules });
    this.scene.add(this.spark, this.splats);
  }

  /**
   * RGBA of a frame as a camera of the rig sees it, on a picture of `size` times its own, by Spark and by our
   * own renderer, as base64.
   */
  async pictures(
    index: number,
    name: string,
    size = 1,
  ): Promise<{ spark: string; own: string; width: number; height: number }> {
    const { fields, ptsSeconds } = this.reader.frame(index);
    const filmed = rigCamera(this.reader.header!, name);
    const [width, height] = [Math.round(size * filmed.width), Math.round(size * filmed.height)];
    const camera = resized(filmed, width, height);
    const changed = [...fields].filter(([name]) => this.reader.header!.dynamic.has(name));
    this.own.update({ index, ptsSeconds, fields: new Map(changed) });
    await this.own.renderSettled(camera);
    const own = await pixelsOf(await this.own.screenshot());
    this.splats.show(fields);
    // What smaller pictures lack against aliasing.
    this.spark.blurAmount = Math.max(0.15 - 0.3 * size * size, 0);
    this.renderer.setSize(width, height, false);
    const eye = this.threeCamera(name, camera);
    for (let atRest = 0; atRest < PICTURES; ) {
      this.renderer.render(this.scene, eye);
      await new Promise((resolve) => setTimeout(resolve, PAUSE_MILLISECONDS));
      const { sorting, sortDirty, activeSplats } = this.spark;
      atRest = sorting || sortDirty || activeSplats === 0 ? 0 : atRest + 1;
    }
    const { domElement } = this.renderer;
    const png = await new Promise<Blob>((resolve) => domElement.toBlob((blob) => resolve(blob!)));
    return { spark: base64(await pixelsOf(png)), own: base64(own), width, height };
  }

  /** Splats that Spark is given, and what it says of our generator. */
  state(): { splats: number; error: string } {
    return { splats: this.splats.numSplats, error: String(this.splats.generatorError ?? "") };
  }

  close(): void {
    this.own.destroy();
    this.splats.dispose();
    this.renderer.dispose();
  }

  /** The same camera in three's axes, in units of the capture. */
  private threeCamera(name: string, { K, width, height }: Camera): PerspectiveCamera {
    const { viewmat, near } = this.reader.header!.cameras.find((camera) => camera.name === name)!;
    const camera = new PerspectiveCamera();
    const flip = new Matrix4().makeScale(1, -1, -1);
    const toWorld = new Matrix4()
      .fromArray([...viewmat])
      .transpose()
      .invert();
    flip.clone().multiply(toWorld).multiply(flip).decompose(camera.position, camera.quaternion, camera.scale);
    const [x, y] = [near / K.fx, near / K.fy];
    const far = 1000 * near;
    camera.projectionMatrix.makePerspective(-K.cx * x, (width - K.cx) * x, K.cy * y, (K.cy - height) * y, near, far);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    return camera;
  }
}

async function open(url: string): Promise<Pair> {
  return new Pair(readStream(new Uint8Array(await (await fetch(url)).arrayBuffer())));
}

export const stage = { open };
Object.assign(globalThis, { stage });
