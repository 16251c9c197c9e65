// SPDX-License-Identifier: Apache-2.0
/** Exported frames as PlayCanvas' engine reads and draws them, with its own settings. */

import {
  AppBase,
  AppOptions,
  Asset,
  CameraComponentSystem,
  Color,
  ContainerHandler,
  type ContainerResource,
  createGraphicsDevice,
  Entity,
  GSplatComponentSystem,
  GSplatHandler,
  Mat4,
  RESOLUTION_FIXED,
  RenderComponentSystem,
  TextureHandler,
} from "playcanvas";
import { exportedStage, sortedPicture } from "../../gl/test/support/exportedPage.ts";
import type { EngineCamera } from "../../gl/test/support/ownPictures.ts";

async function loaded(app: AppBase, url: string): Promise<Entity> {
  const type = url.endsWith(".glb") ? "container" : "gsplat";
  const asset = new Asset(url, type, { url, filename: url });
  app.assets.add(asset);
  await new Promise((resolve, reject) => {
    asset.once("load", resolve);
    asset.once("error", (message: string) => reject(new Error(message)));
    app.assets.load(asset);
  });
  if (type === "container") return (asset.resource as ContainerResource).instantiateRenderEntity();
  const entity = new Entity(url);
  entity.addComponent("gsplat", { asset });
  return entity;
}

async function picture(url: string, yDown: boolean, view: EngineCamera, settings: object): Promise<Uint8ClampedArray> {
  const canvas = document.body.appendChild(document.createElement("canvas"));
  const options = new AppOptions();
  options.graphicsDevice = await createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
  options.componentSystems = [CameraComponentSystem, GSplatComponentSystem, RenderComponentSystem];
  options.resourceHandlers = [GSplatHandler, ContainerHandler, TextureHandler];
  const app = new AppBase(canvas);
  app.init(options);
  app.setCanvasResolution(RESOLUTION_FIXED, view.own.width, view.own.height);
  Object.assign(app.scene.gsplat, settings);
  app.autoRender = false;
  app.start();
  const entity = await loaded(app, url);
  if (yDown) entity.setLocalEulerAngles(180, 0, 0);
  app.root.addChild(entity);
  const camera = new Entity("camera");
  camera.addComponent("camera", { clearColor: Color.BLACK, nearClip: view.near, farClip: view.far });
  camera.camera!.calculateProjection = (matrix) => {
    matrix.setFrustum(view.left, view.right, view.bottom, view.top, view.near, view.far);
  };
  const toWorld = new Mat4().set([...view.toWorld]);
  camera.setLocalPosition(toWorld.getTranslation());
  camera.setLocalEulerAngles(toWorld.getEulerAngles());
  app.root.addChild(camera);
  const found = await sortedPicture(() => {
    app.renderNextFrame = true;
    return new Promise((resolve) => {
      app.once("postrender", () => canvas.toBlob((blob) => resolve(blob!)));
    });
  });
  app.destroy();
  canvas.remove();
  return found;
}

Object.assign(globalThis, { stage: exportedStage(picture) });
