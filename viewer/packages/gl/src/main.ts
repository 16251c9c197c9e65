// SPDX-License-Identifier: Apache-2.0

export { GlError } from "./errors.js";
export type {
  Camera,
  Intrinsics,
  MlpPath,
  Renderer,
  RendererOptions,
  RenderOptions,
  RenderStats,
  ResourceCounts,
  SceneUpdate,
} from "./types.js";
