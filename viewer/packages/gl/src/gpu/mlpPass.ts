// SPDX-License-Identifier: Apache-2.0
/** Common interface of both ways to evaluate the MLPs. */

import type { Vector } from "../vectors.js";
import type { SceneTextures } from "./sceneTextures.js";

/** Evaluates the MLPs of the visible anchors and stores their outputs. */
export interface MlpPass {
  /** GLSL that reads it (`shaders/reading.ts`). */
  readonly reading: string;
  /** @throws GlError the device has not enough memory for the visible anchors */
  evaluate(scene: SceneTextures, eye: Vector): void;
  /** The textures that `reading` needs, for `bindTextures`. */
  outputs(): {
    readonly textures: Readonly<Record<string, WebGLTexture | undefined>>;
    readonly arrays: Readonly<Record<string, WebGLTexture | undefined>>;
  };
  /** Its uniform of this name. */
  readonly passTexels: number;
}
