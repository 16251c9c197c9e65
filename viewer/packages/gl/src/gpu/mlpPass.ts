// SPDX-License-Identifier: Apache-2.0
/** What both ways of evaluating the MLPs have in common. */

import type { Vector } from "../vectors.js";
import type { SceneTextures } from "./sceneTextures.js";

/** Evaluates the MLPs of the visible anchors and keeps what they say. */
export interface MlpPass {
  /** GLSL that reads it (`readingGlsl`). */
  readonly reading: string;
  /** @throws GlError more visible anchors than this device has room for */
  evaluate(scene: SceneTextures, eye: Vector): void;
  /** What `reading` reads, for `bindTextures`. */
  outputs(): {
    readonly textures: Readonly<Record<string, WebGLTexture | undefined>>;
    readonly arrays: Readonly<Record<string, WebGLTexture | undefined>>;
  };
  /** Its uniform of this name. */
  readonly passTexels: number;
  delete(): void;
}
