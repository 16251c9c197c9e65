// SPDX-License-Identifier: Apache-2.0
/** Plays streams in a three.js scene, side by side: index.html?src=clip.sgs&src=ball.sgs */

import { SparkRenderer } from "@sparkjsdev/spark";
import { RENDERING, StreamClip } from "@structgstream/spark";
import { PerspectiveCamera, Scene, WebGLRenderer } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { controlsOf } from "../../gl/examples/controls.js";

const BAR_PIXELS = 40;
const sources = new URLSearchParams(location.search).getAll("src");

const renderer = new WebGLRenderer();
const scene = new Scene();
const camera = new PerspectiveCamera(45, 1, 0.01, 1000);
scene.add(new SparkRenderer({ renderer, ...RENDERING }));

export const clips = await Promise.all(
  (sources.length ? sources : ["clip.sgs"]).map((source) => StreamClip.load(source)),
);
const { eye, target, up } = clips[0]!.view();
for (const [i, clip] of clips.entries()) {
  clip.position.x += i * eye.distanceTo(target);
  scene.add(clip);
}
camera.position.copy(eye);
camera.up.copy(up);
const orbit = new OrbitControls(camera, renderer.domElement);
orbit.target.copy(target);
orbit.update();

const bar = controlsOf(clips.map(({ playback }) => playback));
document.body.append(renderer.domElement, bar.element);
renderer.setSize(innerWidth, innerHeight - BAR_PIXELS);
camera.aspect = innerWidth / (innerHeight - BAR_PIXELS);
camera.updateProjectionMatrix();
renderer.setAnimationLoop(() => {
  bar.update();
  renderer.render(scene, camera);
});

/** Removes the streams; the scene goes on. */
export function removeStreams(): void {
  for (const clip of clips) {
    scene.remove(clip);
    clip.dispose();
  }
}
