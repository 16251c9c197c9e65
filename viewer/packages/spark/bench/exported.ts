// SPDX-License-Identifier: Apache-2.0
/** Exported frames as Spark reads and draws them, with its own settings. */

import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { PerspectiveCamera, Scene, WebGLRenderer } from "three";
import { exportedStage, sortedPicture } from "../../gl/test/support/exportedPage.ts";
import type { EngineCamera } from "../../gl/test/support/ownPictures.ts";

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
  const found = await sortedPicture(() => {
    renderer.render(scene, camera);
    return new Promise((resolve) => renderer.domElement.toBlob((blob) => resolve(blob!)));
  });
  mesh.dispose();
  renderer.dispose();
  return found;
}

Object.assign(globalThis, { stage: exportedStage(picture) });
