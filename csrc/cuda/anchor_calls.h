// SPDX-License-Identifier: Apache-2.0
// The interface of anchors.h, implemented with the elements of anchor_elements.h. anchors.cu compiles it for a GPU,
// emulate_elements.cpp for a CPU.
#pragma once

#include "anchor_elements.h"
#include "anchors.h"

int sgs_cuda_anchor_inputs(
    const float* positions, const float* log_offset_scales, const float* log_base_scales, const float* offsets,
    const float* features, const float* intervals, int anchors, int offsets_per_anchor, int feature_size,
    int distance_input, int views,
    const float* viewmats, const float* intrinsics, const float* centers, int width, int height, float near,
    const uint8_t* tiles, float* inputs, uint8_t* seen, void* stream) {
    using namespace structgstream::cuda;
    const int columns = feature_size + 3 + (distance_input ? 1 : 0);
    const int64_t rows = static_cast<int64_t>(views) * anchors;
    const Seen first = {positions, log_offset_scales, log_base_scales, offsets, intervals, offsets_per_anchor, viewmats,
                        intrinsics, {width, height}, near, tiles, seen};
    const int64_t tile_count =
        static_cast<int64_t>((width + kTilePixels - 1) / kTilePixels) * ((height + kTilePixels - 1) / kTilePixels);
    const int error = for_each(SeenInViews{first, anchors, tile_count}, rows, stream);
    if (error) return error;
    const Input input = {positions, features, centers, anchors, feature_size, columns, inputs};
    return for_each(input, rows * columns, stream);
}

int sgs_cuda_anchor_inputs_backward(
    const float* positions, int anchors, int feature_size, int distance_input, const float* center,
    const float* v_inputs, float* v_positions, void* stream) {
    using namespace structgstream::cuda;
    const int columns = feature_size + 3 + (distance_input ? 1 : 0);
    const InputBackward backward = {positions, center, feature_size, columns, v_inputs, v_positions};
    return for_each(backward, anchors, stream);
}

int sgs_cuda_anchor_outputs(
    const float* positions, const float* log_offset_scales, const float* log_base_scales, const float* offsets,
    int anchors, int offsets_per_anchor, int views, const float* opacity, const float* color, const float* covariance,
    const uint8_t* seen, float* means, float* quats, float* scales, float* opacities, float* colors,
    float* raw_opacities, int64_t* ids, void* stream) {
    using namespace structgstream::cuda;
    const Output output = {positions, log_offset_scales, log_base_scales, offsets, anchors, offsets_per_anchor, opacity,
                           color, covariance, seen, means, quats, scales, opacities, colors, raw_opacities, ids};
    return for_each(output, static_cast<int64_t>(views) * anchors * offsets_per_anchor, stream);
}

int sgs_cuda_anchor_outputs_backward(
    const float* log_offset_scales, const float* log_base_scales, const float* offsets, int anchors,
    int offsets_per_anchor, const float* color, const float* covariance, const float* raw_opacities,
    const float* v_means, const float* v_quats, const float* v_scales, const float* v_opacities, const float* v_colors,
    float* v_positions, float* v_log_offset_scales, float* v_log_base_scales, float* v_offsets, float* v_opacity,
    float* v_color, float* v_covariance, void* stream) {
    using namespace structgstream::cuda;
    const OutputBackward backward = {
        log_offset_scales, log_base_scales, offsets, offsets_per_anchor, color, covariance, raw_opacities, v_means,
        v_quats, v_scales, v_opacities, v_colors, v_positions, v_log_offset_scales, v_log_base_scales, v_offsets,
        v_opacity, v_color, v_covariance};
    return for_each(backward, anchors, stream);
}
