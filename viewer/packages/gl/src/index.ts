// SPDX-License-Identifier: Apache-2.0

export {
  axes,
  between,
  center,
  fitted,
  frustum,
  lookAt,
  projected,
  resized,
  rigCamera,
  rigCameras,
  sameCamera,
  unprojected,
  viewmatOf,
} from "./cameraMath.js";
export { GlError } from "./errors.js";
export { SplatRenderer } from "./renderer.js";
export { focusPoint, upAxis } from "./rig.js";
export type {
  Camera,
  EyeView,
  Intrinsics,
  MlpPath,
  RendererOptions,
  RenderOptions,
  RenderStats,
  ResourceCounts,
  SceneUpdate,
  Views,
} from "./types.js";
export {
  across,
  along,
  cross,
  dot,
  length,
  mean,
  type Rotation,
  scaled,
  unit,
  type Vector,
} from "./vectors.js";
