// SPDX-License-Identifier: Apache-2.0
// Arguments of the generation of structured Gaussians; the layouts are those of the C interface.
#pragma once

#include <stdint.h>

// One MLP with one hidden ReLU layer, row-major: w1 [hidden, inputs], b1, w2 [outputs, hidden], b2.
struct sgs_head {
    const float* w1;
    const float* b1;
    const float* w2;
    const float* b2;
};

// Output gradients of a head; all null if it is not trained.
struct sgs_head_gradient {
    float* w1;
    float* b1;
    float* w2;
    float* b2;
};

struct sgs_anchors {
    const float* positions;          // [M, 3]
    const float* log_offset_scales;  // [M, 3]
    const float* log_base_scales;    // [M, 3]
    const float* offsets;            // [M, K, 3]
    const float* features;           // [M, D]
    const int64_t* visible;          // [m] ascending
    struct sgs_head heads[3];        // opacity (K, tanh), color (3 K, sigmoid), covariance (7 K)
    float camera_center[3];
    int32_t visible_count;           // m
    int32_t offsets_per_anchor;      // K
    int32_t feature_size;            // D
    int32_t hidden_size;
    int32_t distance_input;          // 0 or 1
};

// Results of the first pass. An anchor is active if one of its opacities is positive.
struct sgs_selection {
    float* raw_opacities;    // [m, K]
    int32_t* relu_bits;      // [m, 3, ceil(hidden / 32)]: which hidden units are on
    int32_t* active;         // [m]: rows of `visible`, the first active_count of them set
    int64_t* starts;         // [m + 1]: first Gaussian of each active row
    int64_t active_count;
    int64_t gaussian_count;  // N
};

struct sgs_gaussians {
    float* means;       // [N, 3]
    float* quats;       // [N, 4]
    float* scales;      // [N, 3]
    float* opacities;   // [N]
    float* colors;      // [N, 3]
    int64_t* ids;       // [N]
    float* quat_norms;  // [N] one over the quaternion's length before it was normalised
};

struct sgs_gaussian_gradients {
    const float* means;
    const float* quats;
    const float* scales;
    const float* opacities;
    const float* colors;
};

// Any pointer may be null: that gradient is not computed. Rows of anchors that are not active are set to zero.
struct sgs_anchor_gradients {
    int64_t anchors;  // rows of the arrays
    float* positions;
    float* log_offset_scales;
    float* log_base_scales;
    float* offsets;
    float* features;
    struct sgs_head_gradient heads[3];
};
