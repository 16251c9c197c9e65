// SPDX-License-Identifier: Apache-2.0
/** Exported frames as Spark reads and draws them, with its own settings. */

import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { PerspectiveCamera, Scene, WebGLRenderer } from "three";
import { exportedStage } from "../../gl/test/support/exportedPage.ts";
import type { EngineCamera } from "../../gl/test/support/ownPictures.ts";
import { pixelsOf } from "../../gl/test/support/pixels.ts";

/** Pictures that must be the same one after the other: sorting has ended. */
const SAME_PICTURES = 1;
const PAUSE_MILLISECONDS = 1500;

async function picture(url: string, yDown: boolean, view: EngineCamera, settings: object): Promise<Uint8ClampedArray> {
  const renderer = new WebGLRenderer({ preserveDrawingBuffer: true });
  renderer.setSize(view.own.width, view.own.height, false);
  const scene = new Scene();
  const mesh = new SplatMesh({ url });
  await mesh.initialized;
  if (yDown) mesh.rotation.x = Math.PI;
  scene.add(new SparkRenderer({ renderer, ...settings }), mesh);
  const camera = new PerspectiveCamera();
  camera.matrix.fromArray([...view.toWorld]).decompose(camera.position, camera.quaternion, camera.scale);
  camera.projectionMatrix.makePerspective(view.left, view.right, view.top, view.bottom, view.near, view.far);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  let last: Uint8ClampedArray = new Uint8ClampedArray();
  for (let same = 0; same < SAME_PICTURES; ) {
    renderer.render(scene, camera);
    const png = await new Promise<Blob>((resolve) => renderer.domElement.toBlob((blob) => resolve(blob!)));
    const next = await pixelsOf(png);
    const black = next.every((value, i) => i % 4 === 3 || value === 0);
    same = !black && next.length === last.length && next.every((value, i) => value === last[i]) ? same + 1 : 0;
    last = next;
    await new Promise((resolve) => setTimeout(resolve, PAUSE_MILLISECONDS));
  }
  mesh.dispose();
  renderer.dispose();
  return last;
}

Object.assign(globalThis, { stage: exportedStage(picture) });
