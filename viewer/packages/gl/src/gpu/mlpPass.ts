// SPDX-License-Identifier: Apache-2.0
/** What both ways of evaluating the MLPs have in common. */

import type { Vector } from "../vectors.js";
import type { Program } from "./resources.js";
import type { SceneTextures } from "./sceneTextures.js";

/** Evaluates the MLPs of the visible anchors and keeps what they say. */
export interface MlpPass {
  /** GLSL that reads it (`readingGlsl`). */
  readonly reading: string;
  /** @throws GlError more visible anchors than this device has room for */
  evaluate(scene: SceneTextures, eye: Vector): void;
  /** What `reading` reads, for `bindTextures`; after that, `set`. */
  outputs(): {
    readonly textures: Readonly<Record<string, WebGLTexture | undefined>>;
    readonly arrays: Readonly<Record<string, WebGLTexture | undefined>>;
  };
  set(program: Program): void;
  /** Waits for the GPU: 12 numbers for each Gaussian of the `count` first anchors (`shaders/mlp.ts`). For tests. */
  read(count: number): Float32Array;
  delete(): void;
}
