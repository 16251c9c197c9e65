// SPDX-License-Identifier: Apache-2.0
/** Plays streams in a PlayCanvas scene, side by side: index.html?src=clip.sgs&src=ball.sgs. Dragging turns the camera. */

import { RENDERING, StreamClip } from "@structgstream/playcanvas";
import {
  AppBase,
  AppOptions,
  CameraComponentSystem,
  createGraphicsDevice,
  Entity,
  GSplatComponentSystem,
  Quat,
  RESOLUTION_FIXED,
} from "playcanvas";
import { controlsOf } from "../../gl/examples/controls.js";

const BAR_PIXELS = 40;
const DEGREES_PER_PIXEL = 0.3;
const sources = new URLSearchParams(location.search).getAll("src");

const canvas = document.createElement("canvas");
const options = new AppOptions();
options.graphicsDevice = await createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
options.componentSystems = [CameraComponentSystem, GSplatComponentSystem];
const app = new AppBase(canvas);
app.init(options);
app.setCanvasResolution(RESOLUTION_FIXED, innerWidth, innerHeight - BAR_PIXELS);
Object.assign(app.scene.gsplat, RENDERING);

const camera = new Entity("camera");
camera.addComponent("camera", { nearClip: 0.01 });
app.root.addChild(camera);
export const clips = await Promise.all(
  (sources.length ? sources : ["clip.sgs"]).map((source) => StreamClip.load(app, camera, source)),
);
const { eye, target, up } = clips[0]!.view();
for (const [i, { entity }] of clips.entries()) {
  entity.translate(i * eye.distance(target), 0, 0);
  app.root.addChild(entity);
}
camera.setPosition(eye);
camera.lookAt(target, up);
canvas.addEventListener("pointermove", ({ buttons, movementX }) => {
  if (!buttons) return;
  const turn = new Quat().setFromAxisAngle(up, -movementX * DEGREES_PER_PIXEL);
  camera.setPosition(turn.transformVector(camera.getPosition().clone().sub(target)).add(target));
  camera.lookAt(target, up);
});

const bar = controlsOf(clips.map(({ playback }) => playback));
document.body.append(canvas, bar.element);
app.on("update", () => bar.update());
app.start();

/** Removes the streams; the scene goes on. */
export function removeStreams(): void {
  for (const clip of clips) clip.destroy();
}
