// SPDX-License-Identifier: Apache-2.0
/** The MLPs and the low-pass of the training pictures as GLSL and numbers, for other programs than `SplatRenderer`. */

export { TABLE_GLSL, TABLE_WIDTH_BITS } from "./gpu/table.js";
export { mlpLayout, packedWeights, paddedRows } from "./gpu/weights.js";
export { TRAINING_LOW_PASS, type TrainingCameras, trainingCamerasOf } from "./sampling.js";
export { type Shape, sameShape, shapeOf, sizesOf } from "./scene.js";
export { evaluation } from "./shaders/mlp.js";
export { SAMPLING_GLSL } from "./shaders/sampling.js";
