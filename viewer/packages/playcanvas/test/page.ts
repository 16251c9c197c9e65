// SPDX-License-Identifier: Apache-2.0
/** What runs in the browser: frames by PlayCanvas, and by the player's own renderer. */

import { readStream, type StreamReader } from "@structgstream/core";
import {
  AppBase,
  AppOptions,
  CameraComponentSystem,
  Color,
  createGraphicsDevice,
  Entity,
  type GraphicsDevice,
  GSplatComponentSystem,
  Mat4,
  RESOLUTION_FIXED,
} from "playcanvas";
import { engineCamera, OwnPictures } from "../../gl/test/support/ownPictures.ts";
import { base64, pixelsOf } from "../../gl/test/support/pixels.ts";
import { RENDERING, StreamSplats } from "../src/index.ts";

/** The engine sorts in a worker; a picture is in order once it has been the same so often. */
const SAME_PICTURES = 4;
const PAUSE_MILLISECONDS = 100;

export class Pair {
  readonly splats: StreamSplats;
  private readonly camera = new Entity("camera");
  private readonly own: OwnPictures;

  constructor(
    private readonly app: AppBase,
    private readonly reader: StreamReader,
  ) {
    this.own = new OwnPictures(reader);
    this.camera.addComponent("camera", { clearColor: Color.BLACK });
    app.root.addChild(this.camera);
    Object.assign(app.scene.gsplat, RENDERING);
    this.splats = new StreamSplats(app, this.camera, reader.header!);
    app.root.addChild(this.splats.entity);
  }

  /** RGBA of a frame as a camera of the rig sees it, on a picture of `size` times its own, as base64. */
  async pictures(
    index: number,
    name: string,
    size = 1,
  ): Promise<{ engine: string; own: string; width: number; height: number }> {
    const view = engineCamera(this.reader, name, size);
    const { width, height } = view.own;
    const own = await this.own.picture(index, view.own);
    this.splats.show(this.reader.frame(index).fields);
    this.app.setCanvasResolution(RESOLUTION_FIXED, width, height);
    const camera = this.camera.camera!;
    camera.nearClip = view.near;
    camera.farClip = view.far;
    camera.calculateProjection = (matrix) => {
      matrix.setFrustum(view.left, view.right, view.bottom, view.top, view.near, view.far);
    };
    const toWorld = new Mat4().set([...view.toWorld]);
    this.camera.setLocalPosition(toWorld.getTranslation());
    this.camera.setLocalEulerAngles(toWorld.getEulerAngles());
    let [last, same] = ["", 0];
    while (same < SAME_PICTURES) {
      await new Promise((resolve) => setTimeout(resolve, PAUSE_MILLISECONDS));
      const next = base64(await pixelsOf(await this.picture()));
      same = next === last ? same + 1 : 0;
      last = next;
    }
    return { engine: last, own: base64(own), width, height };
  }

  close(): void {
    this.own.destroy();
    this.splats.destroy();
    this.app.destroy();
  }

  /** The next picture as PNG. */
  private picture(): Promise<Blob> {
    const canvas = this.app.graphicsDevice.canvas as HTMLCanvasElement;
    return new Promise((resolve) => {
      this.app.once("frameend", () => canvas.toBlob((blob) => resolve(blob!)));
      this.app.tick();
    });
  }
}

async function open(url: string): Promise<Pair> {
  const reader = readStream(new Uint8Array(await (await fetch(url)).arrayBuffer()));
  const canvas = document.body.appendChild(document.createElement("canvas"));
  const options = new AppOptions();
  const device: GraphicsDevice = await createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
  options.graphicsDevice = device;
  options.componentSystems = [CameraComponentSystem, GSplatComponentSystem];
  const app = new AppBase(canvas);
  app.init(options);
  app.start();
  return new Pair(app, reader);
}

export const stage = { open };
Object.assign(globalThis, { stage });
