// SPDX-License-Identifier: Apache-2.0
// Work of a thread for an anchor or for one of its Gaussians; the formulas are those of kernels/reference_anchors.py.
#pragma once

#include <cmath>

#include "element.h"

namespace structgstream {
namespace cuda {

constexpr float kBallDeviations = 3.4f;   // reference_anchors.BALL_DEVIATIONS
constexpr float kBoxMargin = 2.0f;        // pixels, reference_anchors.BOX_MARGIN_PIXELS
constexpr float kBallIntervals = 1.86226f;  // reference_anchors.BALL_INTERVALS
constexpr float kLeastLength = 1e-12f;

SGS_ELEMENT float least(float a, float b) { return a < b ? a : b; }
SGS_ELEMENT float most(float a, float b) { return a > b ? a : b; }
SGS_ELEMENT float sigmoid(float x) { return 1.0f / (1.0f + expf(-x)); }
SGS_ELEMENT float length(float x, float y, float z) { return sqrtf(x * x + y * y + z * z); }

// Whether the ball of an anchor's Gaussians reaches the picture, or one of its tiles.
struct Seen {
    const float *positions, *log_offset_scales, *log_base_scales, *offsets, *intervals;
    int k;
    const float *viewmat, *intrinsics;
    int size[2];
    float near;
    const uint8_t* tiles;
    uint8_t* seen;

    SGS_ELEMENT float radius(int64_t i) const {
        float reach = 0.0f, base = log_base_scales[3 * i];
        const float* log_scale = log_offset_scales + 3 * i;
        const float scale[3] = {expf(log_scale[0]), expf(log_scale[1]), expf(log_scale[2])};
        for (int j = 0; j < k; ++j) {
            const float* offset = offsets + 3 * (i * k + j);
            reach = most(reach, length(offset[0] * scale[0], offset[1] * scale[1], offset[2] * scale[2]));
        }
        for (int axis = 1; axis < 3; ++axis) base = most(base, log_base_scales[3 * i + axis]);
        const float ball = reach + kBallDeviations * expf(base);
        return intervals == nullptr ? ball : ball + kBallIntervals * intervals[i];
    }

    SGS_ELEMENT bool reaches_tile(const float* low, const float* high) const {
        int first[2], last[2], columns = (size[0] + kTilePixels - 1) / kTilePixels;
        for (int axis = 0; axis < 2; ++axis) {
            const float limit = static_cast<float>(size[axis] - 1);
            first[axis] = static_cast<int>(least(most(low[axis], 0.0f), limit)) / kTilePixels;
            last[axis] = static_cast<int>(least(most(high[axis], 0.0f), limit)) / kTilePixels;
        }
        for (int row = first[1]; row <= last[1]; ++row)
            for (int column = first[0]; column <= last[0]; ++column)
                if (tiles[row * columns + column]) return true;
        return false;
    }

    SGS_ELEMENT bool reaches(int64_t i) const {
        const float* p = positions + 3 * i;
        float point[3];
        for (int axis = 0; axis < 3; ++axis) {
            const float* row = viewmat + 4 * axis;
            point[axis] = row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3];
        }
        const float r = radius(i), closest = point[2] - r, furthest = point[2] + r;
        bool found = furthest > near;
        const bool around = closest <= 0.0f;  // A ball that contains the camera plane has no box.
        float low[2], high[2];
        for (int axis = 0; axis < 2; ++axis) {
            const float below = point[axis] - r, above = point[axis] + r, extent = static_cast<float>(size[axis]);
            const float focal = intrinsics[4 * axis], middle = intrinsics[3 * axis + 2];
            low[axis] = focal * (below / (below < 0.0f ? closest : furthest)) + middle - kBoxMargin;
            high[axis] = focal * (above / (above < 0.0f ? furthest : closest)) + middle + kBoxMargin;
            if (!around) {
                found = found && low[axis] < extent && high[axis] > 0.0f;
                continue;
            }
            for (int side = 0; side < 2; ++side) {
                const float sign = side == 0 ? 1.0f : -1.0f, edge = side == 0 ? middle : extent - middle;
                const float slope = (edge + kBoxMargin) / focal;
                const float distance = (sign * point[axis] + slope * point[2]) / sqrtf(1.0f + slope * slope);
                found = found && distance > -1.1f * r;
            }
            low[axis] = 0.0f;
            high[axis] = extent;
        }
        return found && (tiles == nullptr || reaches_tile(low, high));
    }

    SGS_ELEMENT void operator()(int64_t i) const { seen[i] = reaches(i) ? 1 : 0; }
};

// The same in several views of one size, anchor by anchor.
struct SeenInViews {
    Seen first;
    int64_t anchors, tile_count;

    SGS_ELEMENT void operator()(int64_t n) const {
        const int64_t view = n / anchors;
        Seen of_view = first;
        of_view.viewmat += 16 * view, of_view.intrinsics += 9 * view, of_view.seen += anchors * view;
        if (of_view.tiles != nullptr) of_view.tiles += tile_count * view;
        of_view(n % anchors);
    }
};

// One number of the MLPs' inputs: the feature, the direction to the anchor, and its distance; in view after view.
struct Input {
    const float *positions, *features, *centers;
    int64_t anchors;
    int feature_size, width;
    float* inputs;

    SGS_ELEMENT void operator()(int64_t n) const {
        const int64_t row = n / width, i = row % anchors;
        const int column = static_cast<int>(n - row * width);
        if (column < feature_size) {
            inputs[n] = features[i * feature_size + column];
            return;
        }
        const float *p = positions + 3 * i, *center = centers + 3 * (row / anchors);
        const float to[3] = {p[0] - center[0], p[1] - center[1], p[2] - center[2]};
        const float distance = most(length(to[0], to[1], to[2]), kLeastLength);
        const int axis = column - feature_size;
        inputs[n] = axis < 3 ? to[axis] / distance : distance;
    }
};

struct InputBackward {
    const float *positions, *center;
    int feature_size, width;
    const float* v_inputs;
    float* v_positions;

    SGS_ELEMENT void operator()(int64_t i) const {
        const float* p = positions + 3 * i;
        const float* v = v_inputs + i * width + feature_size;
        const float to[3] = {p[0] - center[0], p[1] - center[1], p[2] - center[2]};
        const float found = length(to[0], to[1], to[2]), distance = most(found, kLeastLength);
        float along = 0.0f;
        if (found >= kLeastLength) {
            for (int axis = 0; axis < 3; ++axis) along += v[axis] * to[axis];
            along = -along / (distance * distance);
            if (width > feature_size + 3) along += v[3];
        }
        for (int axis = 0; axis < 3; ++axis)
            v_positions[3 * i + axis] = (v[axis] + along * to[axis]) / distance;
    }
};

// One Gaussian of an anchor, in view after view.
struct Output {
    const float *positions, *log_offset_scales, *log_base_scales, *offsets;
    int64_t anchors;
    int k;
    const float *opacity, *color, *covariance;
    const uint8_t* seen;
    float *means, *quats, *scales, *opacities, *colors, *raw_opacities;
    int64_t* ids;

    SGS_ELEMENT void operator()(int64_t n) const {
        const int64_t i = n / k % anchors, id = n % (anchors * k);
        const float raw = seen[n / k] ? tanhf(opacity[n]) : -1.0f;
        const bool drawn = raw > 0.0f;
        const float* q = covariance + 7 * n;
        for (int axis = 0; axis < 3; ++axis) {
            means[3 * n + axis] = positions[3 * i + axis] + offsets[3 * id + axis] * expf(log_offset_scales[3 * i + axis]);
            scales[3 * n + axis] = drawn ? expf(log_base_scales[3 * i + axis]) * sigmoid(q[axis]) : 0.0f;
            colors[3 * n + axis] = sigmoid(color[3 * n + axis]);
        }
        const float norm = most(sqrtf(q[3] * q[3] + q[4] * q[4] + q[5] * q[5] + q[6] * q[6]), kLeastLength);
        for (int part = 0; part < 4; ++part) quats[4 * n + part] = q[3 + part] / norm;
        opacities[n] = drawn ? raw : 0.0f;
        raw_opacities[n] = raw;
        ids[n] = id;
    }
};

// All Gaussians of an anchor, in one thread, which also computes the sums over them.
struct OutputBackward {
    const float *log_offset_scales, *log_base_scales, *offsets;
    int k;
    const float *color, *covariance, *raw_opacities;
    const float *v_means, *v_quats, *v_scales, *v_opacities, *v_colors;
    float *v_positions, *v_log_offset_scales, *v_log_base_scales, *v_offsets, *v_opacity, *v_color, *v_covariance;

    SGS_ELEMENT void operator()(int64_t i) const {
        float position[3] = {}, offset_scale[3] = {}, base_scale[3] = {}, reach[3], base[3];
        for (int axis = 0; axis < 3; ++axis) {
            reach[axis] = expf(log_offset_scales[3 * i + axis]);
            base[axis] = expf(log_base_scales[3 * i + axis]);
        }
        for (int64_t n = i * k; n < (i + 1) * k; ++n) {
            const bool drawn = raw_opacities[n] > 0.0f;
            v_opacity[n] = drawn ? v_opacities[n] * (1.0f - raw_opacities[n] * raw_opacities[n]) : 0.0f;
            for (int axis = 0; axis < 3; ++axis) {
                const float v_mean = v_means[3 * n + axis], c = sigmoid(color[3 * n + axis]);
                position[axis] += v_mean;
                offset_scale[axis] += v_mean * offsets[3 * n + axis] * reach[axis];
                if (v_offsets != nullptr) v_offsets[3 * n + axis] = v_mean * reach[axis];
                v_color[3 * n + axis] = v_colors[3 * n + axis] * c * (1.0f - c);
                const float share = sigmoid(covariance[7 * n + axis]);
                const float v_scale = drawn ? v_scales[3 * n + axis] * base[axis] * share : 0.0f;
                base_scale[axis] += v_scale;
                v_covariance[7 * n + axis] = v_scale * (1.0f - share);
            }
            rotation(n);
        }
        for (int axis = 0; axis < 3; ++axis) {
            v_positions[3 * i + axis] = position[axis];
            v_log_offset_scales[3 * i + axis] = offset_scale[axis];
            v_log_base_scales[3 * i + axis] = base_scale[axis];
        }
    }

    SGS_ELEMENT void rotation(int64_t n) const {
        const float *q = covariance + 7 * n + 3, *v = v_quats + 4 * n;
        const float found = sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        const float norm = most(found, kLeastLength);
        float along = 0.0f;
        if (found >= kLeastLength)
            for (int part = 0; part < 4; ++part) along += v[part] * q[part] / (norm * norm);
        for (int part = 0; part < 4; ++part) v_covariance[7 * n + 3 + part] = (v[part] - along * q[part]) / norm;
    }
};

}  // namespace cuda
}  // namespace structgstream
