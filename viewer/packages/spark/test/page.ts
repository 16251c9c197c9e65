// SPDX-License-Identifier: Apache-2.0
/** What runs in the browser: frames by Spark in a three.js scene, and by the player's own renderer. */

import { SparkRenderer } from "@sparkjsdev/spark";
import { readStream, type StreamReader } from "@structgstream/core";
import { PerspectiveCamera, Scene, WebGLRenderer } from "three";
import { type EngineCamera, engineCamera, OwnPictures } from "../../gl/test/support/ownPictures.ts";
import { base64, pixelsOf } from "../../gl/test/support/pixels.ts";
import { blurAmount, RENDERING, StreamSplats } from "../src/index.ts";

/** Spark sorts in a worker; a picture is in order once sorting has been idle for so many pictures in a row. */
const PICTURES = 4;
const PAUSE_MILLISECONDS = 100;

export class Pair {
  readonly splats: StreamSplats;
  private readonly renderer = new WebGLRenderer({ preserveDrawingBuffer: true });
  private readonly scene = new Scene();
  private readonly spark: SparkRenderer;
  private readonly own: OwnPictures;

  constructor(private readonly reader: StreamReader) {
    this.splats = new StreamSplats(reader.header!);
    this.own = new OwnPictures(reader);
    this.spark = new SparkRenderer({ renderer: this.renderer, ...RENDERING });
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
    const camera = engineCamera(this.reader, name, size);
    const { width, height } = camera.own;
    const own = await this.own.picture(index, camera.own);
    this.splats.show(this.reader.frame(index).fields);
    this.spark.blurAmount = blurAmount(size);
    this.renderer.setSize(width, height, false);
    const eye = threeCamera(camera);
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
}

function threeCamera({ toWorld, left, right, top, bottom, near, far }: EngineCamera): PerspectiveCamera {
  const camera = new PerspectiveCamera();
  camera.matrix.fromArray([...toWorld]).decompose(camera.position, camera.quaternion, camera.scale);
  camera.projectionMatrix.makePerspective(left, right, top, bottom, near, far);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  return camera;
}

async function open(url: string): Promise<Pair> {
  return new Pair(readStream(new Uint8Array(await (await fetch(url)).arrayBuffer())));
}

export const stage = { open };
Object.assign(globalThis, { stage });
