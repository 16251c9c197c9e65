/* SPDX-License-Identifier: Apache-2.0 */
/* The C interface of the generation of Gaussians on a GPU: the steps before and after the MLPs, which are matrix products.
 * Plain pointers to the GPU's memory; tensors are contiguous, row-major, float32 unless stated otherwise; `stream` is a
 * cudaStream_t. No function waits for the GPU or allocates memory. All return 0, or CUDA's error number. */
#pragma once

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The inputs of the MLPs in each of V views of one size, and which anchors' balls of Gaussians reach the picture, or one of its
 * tiles.
 * positions, log_offset_scales, log_base_scales [M,3], offsets [M,K,3], features [M,D]; intervals [M], the size of a training
 * pixel at each anchor, or null; viewmats [V,4,4], intrinsics [V,3,3],
 * centers [V,3], of directions and distances; tiles [V,.]: a byte for each tile of 16 x 16 pixels, or null for all. Out: inputs
 * [V,M,D+3+distance_input], seen [V,M], a byte each. */
int sgs_cuda_anchor_inputs(
    const float* positions, const float* log_offset_scales, const float* log_base_scales, const float* offsets,
    const float* features, const float* intervals, int anchors, int offsets_per_anchor, int feature_size,
    int distance_input, int views,
    const float* viewmats, const float* intrinsics, const float* centers, int width, int height, float near,
    const uint8_t* tiles, float* inputs, uint8_t* seen, void* stream);
/* Out: v_positions [M,3], from v_inputs, the gradient of the inputs. That of the features is its first D columns. */
int sgs_cuda_anchor_inputs_backward(
    const float* positions, int anchors, int feature_size, int distance_input, const float* center,
    const float* v_inputs, float* v_positions, void* stream);
/* The Gaussians of all anchors in V views. opacity [V,M,K], color [V,M,K,3], covariance [V,M,K,7]: the MLPs' outputs before
 * activation. Out: means, scales, colors [V,M,K,3], quats [V,M,K,4], opacities, raw_opacities [V,M,K], ids [V,M,K] int64. Gaussians that are not
 * drawn have opacity and scale 0; raw opacities of anchors that are not visible are -1. */
int sgs_cuda_anchor_outputs(
    const float* positions, const float* log_offset_scales, const float* log_base_scales, const float* offsets,
    int anchors, int offsets_per_anchor, int views, const float* opacity, const float* color, const float* covariance,
    const uint8_t* seen, float* means, float* quats, float* scales, float* opacities, float* colors,
    float* raw_opacities, int64_t* ids, void* stream);
/* From gradients of the Gaussians to gradients of the inputs of sgs_cuda_anchor_outputs, of the same shapes; v_offsets may
 * be null. */
int sgs_cuda_anchor_outputs_backward(
    const float* log_offset_scales, const float* log_base_scales, const float* offsets, int anchors,
    int offsets_per_anchor, const float* color, const float* covariance, const float* raw_opacities,
    const float* v_means, const float* v_quats, const float* v_scales, const float* v_opacities, const float* v_colors,
    float* v_positions, float* v_log_offset_scales, float* v_log_base_scales, float* v_offsets, float* v_opacity,
    float* v_color, float* v_covariance, void* stream);

#ifdef __cplusplus
}
#endif
