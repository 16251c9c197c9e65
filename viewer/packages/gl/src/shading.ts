// SPDX-License-Identifier: Apache-2.0
/** The MLPs and the low-pass of the training pictures as GLSL and numbers, for other renderers than `SplatRenderer`. */

export { center, rigCameras } from "./cameraMath.js";
export { fetchStream } from "./fetchStream.js";
export { FieldTables, TABLE_NAMES, type TableName } from "./fieldTables.js";
export { TABLE_WIDTH_BITS } from "./gpu/table.js";
export { focusPoint, upAxis } from "./rig.js";
export { type TrainingCameras, trainingCamerasOf } from "./sampling.js";
export { type Shape, sameShape, shapeOf, sizesOf } from "./scene.js";
export { streamSplatGlsl } from "./shaders/streamSplat.js";
export type { Vector } from "./vectors.js";
