// SPDX-License-Identifier: Apache-2.0
// Anchors and free Gaussians to splats of a view, and gradients of splats back to them; the formulas are those of
// csrc/cpu/anchors.cpp. Intermediate numbers of an anchor are columns [number, anchor], so that the threads of a warp read
// and write neighbours.
#pragma once

#include <cmath>
#include <cstdint>

#include "../include/structgstream.h"
#include "anchor_elements.h"
#include "fit_lists.h"

namespace structgstream {
namespace cuda {
namespace fit {

enum Leaf {
    kPositions, kOffsetScales, kBaseScales, kOffsets, kFeatures, kAppearance,
    kFreeMeans, kFreeScales, kFreeQuats, kFreeOpacities, kFreeColors
};
constexpr int kHeads = 3;

SGS_ELEMENT int outputs_of(int head) { return head == 0 ? 1 : head == 1 ? 3 : 7; }    // for each offset
SGS_ELEMENT int first_output(int head) { return head == 0 ? 0 : head == 1 ? 1 : 4; }  // for each offset

// What is drawn, and the memory of an iteration.
struct Model {
    int64_t anchors, free;
    int k, d, inputs, hidden, rank;
    const float* values[SGS_LEAVES];  // as they are drawn: rounded
    float* gradients[SGS_LEAVES];     // null where a leaf is not trained
    sgs_head heads[kHeads];
    const float *basis, *anchor_intervals, *free_intervals;
    // Columns: inputs [inputs, M], hidden [3 hidden, M], outputs [11 k, M] and their gradients.
    float *x, *to_x, *h, *to_h, *out, *to_out;
    uint8_t* seen;                    // [M]
    // Rows: k of each anchor, then the free Gaussians.
    float *means, *quats, *scales, *opacities, *colors, *inverse_norms, *to_means, *to_scales;
    Splat* splats;
    int32_t* slots;                   // number of slots of each

    SGS_ELEMENT int64_t rows() const { return anchors * k + free; }
    SGS_ELEMENT bool trains_inputs() const {
        return gradients[kPositions] != nullptr || gradients[kFeatures] != nullptr || gradients[kAppearance] != nullptr;
    }
};

// y[r] = bias[r] + sum of weights[r * row + c * column] x[c]; four sums at a time, to hide the latency of memory.
template <typename Finish>
SGS_ELEMENT void product(
    const float* weights, int rows, int columns, int row, int column, const float* bias, const float* x, int64_t stride,
    const Finish& finish) {
    for (int r = 0; r < rows; r += 4) {
        const int n = rows - r < 4 ? rows - r : 4;
        float sums[4];
        const float* w[4];
        for (int j = 0; j < 4; ++j) {
            const int at = r + (j < n ? j : n - 1);
            sums[j] = bias == nullptr ? 0.0f : bias[at];
            w[j] = weights + at * row;
        }
        for (int c = 0; c < columns; ++c) {
            const float value = x[c * stride];
            for (int j = 0; j < 4; ++j) sums[j] += w[j][c * column] * value;
        }
        for (int j = 0; j < n; ++j) finish(r + j, sums[j]);
    }
}

// Whether an anchor is seen, and the inputs of its MLPs. A thread is an anchor.
struct AnchorInputs {
    Model m;
    Seen seen;
    const float* center;

    SGS_ELEMENT void operator()(int64_t i) const {
        seen(i);
        if (!m.seen[i]) return;
        for (int c = 0; c < m.d; ++c) {
            float sum = 0.0f;
            for (int r = 0; r < m.rank; ++r) sum += m.values[kAppearance][i * m.rank + r] * m.basis[r * m.d + c];
            m.x[c * m.anchors + i] = m.values[kFeatures][i * m.d + c] + sum;
        }
        const float* p = m.values[kPositions] + 3 * i;
        const float to[3] = {p[0] - center[0], p[1] - center[1], p[2] - center[2]};
        const float distance = most(length(to[0], to[1], to[2]), kLeastLength);
        for (int axis = 0; axis < 3; ++axis) m.x[(m.d + axis) * m.anchors + i] = to[axis] / distance;
        if (m.inputs > m.d + 3) m.x[(m.d + 3) * m.anchors + i] = distance;
    }
};

// One MLP of an anchor.
struct AnchorHead {
    Model m;

    SGS_ELEMENT void operator()(int64_t n) const {
        const int head = static_cast<int>(n / m.anchors);
        const int64_t i = n % m.anchors, stride = m.anchors;
        if (!m.seen[i]) return;
        const sgs_head& w = m.heads[head];
        float* h = m.h + head * m.hidden * stride + i;
        float* out = m.out + first_output(head) * m.k * stride + i;
        product(w.w1, m.hidden, m.inputs, m.inputs, 1, w.b1, m.x + i, stride, [&](int unit, float sum) {
            h[unit * stride] = sum > 0.0f ? sum : 0.0f;
        });
        product(w.w2, outputs_of(head) * m.k, m.hidden, m.hidden, 1, w.b2, h, stride, [&](int o, float sum) {
            out[o * stride] = sum;
        });
    }
};

struct AnchorHeadBackward {
    Model m;
    const State* state;

    SGS_ELEMENT void operator()(int64_t n) const {
        const int head = static_cast<int>(n / m.anchors);
        const int64_t i = n % m.anchors, stride = m.anchors;
        if (state->stopped >= 0 || !m.seen[i]) return;
        const sgs_head& w = m.heads[head];
        const float* h = m.h + head * m.hidden * stride + i;
        float* to_h = m.to_h + head * m.hidden * stride + i;
        float* to_x = m.to_x + head * m.inputs * stride + i;
        const float* to_out = m.to_out + first_output(head) * m.k * stride + i;
        product(w.w2, m.hidden, outputs_of(head) * m.k, 1, m.hidden, nullptr, to_out, stride, [&](int unit, float sum) {
            to_h[unit * stride] = h[unit * stride] > 0.0f ? sum : 0.0f;
        });
        product(w.w1, m.inputs, m.hidden, 1, m.inputs, nullptr, to_h, stride, [&](int input, float sum) {
            to_x[input * stride] = sum;
        });
    }
};

// A dynamic Gaussian and its splat. A thread is a row.
struct DecodeGaussians {
    Model m;
    Camera camera;
    const uint8_t* drawn;
    int32_t* tile_counts;

    SGS_LANES_FN void operator()(int64_t n) const {
        const int64_t structured = m.anchors * m.k;
        int64_t row = n;
        const float* interval = nullptr;
        if (n < structured) {
            const int64_t i = n % m.anchors, stride = m.anchors;
            const int offset = static_cast<int>(n / m.anchors);
            row = i * m.k + offset;
            if (!of_anchor(row, i, offset, m.out + i, stride)) {
                m.opacities[row] = 0.0f;
                for (int axis = 0; axis < 3; ++axis) m.scales[3 * row + axis] = 0.0f;
                m.splats[row] = Splat{};
                m.slots[row] = 0;
                return;
            }
            if (m.anchor_intervals != nullptr) interval = m.anchor_intervals + i;
        } else {
            of_free(row, n - structured);
            if (m.anchor_intervals != nullptr) interval = m.free_intervals + (n - structured);
        }
        const Splat s = projected(
            camera, m.means + 3 * row, m.quats + 4 * row, m.scales + 3 * row, m.opacities[row], m.colors + 3 * row,
            interval);
        m.splats[row] = s;
        m.slots[row] = slots_of(s);
        count_tiles(s, drawn, camera.columns(), tile_counts);
    }

    // Whether it is drawn.
    SGS_ELEMENT bool of_anchor(int64_t row, int64_t i, int offset, const float* out, int64_t stride) const {
        if (!m.seen[i]) return false;
        const float opacity = tanhf(out[offset * stride]);
        if (!(opacity > 0.0f)) return false;
        m.opacities[row] = opacity;
        const float *color = out + (m.k + 3 * offset) * stride, *covariance = out + (4 * m.k + 7 * offset) * stride;
        float q[4], square = 0.0f;
        for (int axis = 0; axis < 3; ++axis) {
            const float reach = expf(m.values[kOffsetScales][3 * i + axis]);
            m.means[3 * row + axis] = m.values[kPositions][3 * i + axis] + m.values[kOffsets][3 * row + axis] * reach;
            m.scales[3 * row + axis] = expf(m.values[kBaseScales][3 * i + axis]) * sigmoid(covariance[axis * stride]);
            m.colors[3 * row + axis] = sigmoid(color[axis * stride]);
        }
        for (int part = 0; part < 4; ++part) q[part] = covariance[(3 + part) * stride], square += q[part] * q[part];
        const float inverse = 1.0f / most(sqrtf(square), kLeastLength);
        for (int part = 0; part < 4; ++part) m.quats[4 * row + part] = q[part] * inverse;
        m.inverse_norms[row] = inverse;
        return true;
    }

    SGS_ELEMENT void of_free(int64_t row, int64_t i) const {
        for (int axis = 0; axis < 3; ++axis) {
            m.means[3 * row + axis] = m.values[kFreeMeans][3 * i + axis];
            m.scales[3 * row + axis] = expf(m.values[kFreeScales][3 * i + axis]);
            m.colors[3 * row + axis] = m.values[kFreeColors][3 * i + axis];
        }
        for (int part = 0; part < 4; ++part) m.quats[4 * row + part] = m.values[kFreeQuats][4 * i + part];
        m.opacities[row] = sigmoid(m.values[kFreeOpacities][i]);
    }
};

// From the moments of a row's slots to gradients of the MLPs' outputs or of a free Gaussian.
struct DecodeGaussiansBackward {
    Model m;
    Camera camera;
    const State* state;
    const uint8_t* drawn;
    const int32_t* slots;
    const float* moments;
    float volume;  // weight
    bool mean_volume;

    SGS_ELEMENT void operator()(int64_t n) const {
        if (state->stopped >= 0) return;
        const int64_t structured = m.anchors * m.k;
        const bool is_free = n >= structured;
        const int64_t i = is_free ? n - structured : n % m.anchors;
        const int offset = is_free ? 0 : static_cast<int>(n / m.anchors);
        const int64_t row = is_free ? n : i * m.k + offset;
        AttributeGradients g = {};
        const float opacity = m.opacities[row], *scale = m.scales + 3 * row;
        const Splat& s = m.splats[row];
        if (s.tiles[0] < s.tiles[2]) {
            float sums[kMoments];
            sum_moments(s, drawn, camera.columns(), slots[row], moments, sums);
            g = projected_backward(camera, s, sums, m.means + 3 * row, m.quats + 4 * row, scale, opacity);
        }
        if (volume != 0.0f) {
            const int32_t count = mean_volume && state->visible > 1 ? state->visible : 1;
            const float factor = volume / static_cast<float>(count);
            g.scale[0] += factor * scale[1] * scale[2];
            g.scale[1] += factor * scale[0] * scale[2];
            g.scale[2] += factor * scale[0] * scale[1];
        }
        if (is_free)
            to_free(g, row, i);
        else
            to_anchor(g, row, i, offset);
    }

    SGS_ELEMENT void to_free(const AttributeGradients& g, int64_t row, int64_t i) const {
        float* const* to = m.gradients;
        const float opacity = m.opacities[row];
        for (int axis = 0; axis < 3; ++axis) {
            if (to[kFreeMeans] != nullptr) to[kFreeMeans][3 * i + axis] = g.mean[axis];
            if (to[kFreeScales] != nullptr) to[kFreeScales][3 * i + axis] = g.scale[axis] * m.scales[3 * row + axis];
            if (to[kFreeColors] != nullptr) to[kFreeColors][3 * i + axis] = g.color[axis];
        }
        for (int part = 0; part < 4; ++part)
            if (to[kFreeQuats] != nullptr) to[kFreeQuats][4 * i + part] = g.quat[part];
        if (to[kFreeOpacities] != nullptr) to[kFreeOpacities][i] = g.opacity * (1.0f - opacity) * opacity;
    }

    SGS_ELEMENT void to_anchor(const AttributeGradients& g, int64_t row, int64_t i, int offset) const {
        const int64_t stride = m.anchors;
        float* out = m.to_out + i;
        float *color = out + (m.k + 3 * offset) * stride, *covariance = out + (4 * m.k + 7 * offset) * stride;
        const float opacity = m.opacities[row];
        const bool drawn_at_all = opacity > 0.0f;
        out[offset * stride] = drawn_at_all ? g.opacity * (1.0f - opacity * opacity) : 0.0f;
        float along = 0.0f;
        for (int part = 0; part < 4 && drawn_at_all; ++part) along += g.quat[part] * m.quats[4 * row + part];
        for (int part = 0; part < 4; ++part)
            covariance[(3 + part) * stride] =
                drawn_at_all ? (g.quat[part] - along * m.quats[4 * row + part]) * m.inverse_norms[row] : 0.0f;
        for (int axis = 0; axis < 3; ++axis) {
            const float value = m.colors[3 * row + axis], scale = m.scales[3 * row + axis];
            const float to_scale = drawn_at_all ? g.scale[axis] * scale : 0.0f;
            color[axis * stride] = drawn_at_all ? g.color[axis] * value * (1.0f - value) : 0.0f;
            covariance[axis * stride] = to_scale * (1.0f - scale / expf(m.values[kBaseScales][3 * i + axis]));
            m.to_means[3 * row + axis] = drawn_at_all ? g.mean[axis] : 0.0f;
            m.to_scales[3 * row + axis] = to_scale;
        }
    }
};

// Gradients of an anchor's numbers.
struct AnchorBackward {
    Model m;
    const State* state;

    SGS_ELEMENT float to_input(int input, int64_t i) const {
        float sum = 0.0f;
        for (int head = 0; head < kHeads; ++head) sum += m.to_x[(head * m.inputs + input) * m.anchors + i];
        return sum;
    }

    SGS_ELEMENT void operator()(int64_t i) const {
        if (state->stopped >= 0) return;
        float* const* to = m.gradients;
        const bool seen = m.seen[i] != 0;
        float mean[3] = {}, reach_sum[3] = {}, base[3] = {};
        for (int axis = 0; axis < 3; ++axis) {
            const float reach = expf(m.values[kOffsetScales][3 * i + axis]);
            for (int64_t row = i * m.k; row < (i + 1) * m.k; ++row) {
                const float to_mean = m.to_means[3 * row + axis];
                mean[axis] += to_mean, base[axis] += m.to_scales[3 * row + axis];
                reach_sum[axis] += to_mean * m.values[kOffsets][3 * row + axis];
                if (to[kOffsets] != nullptr) to[kOffsets][3 * row + axis] = to_mean * reach;
            }
            if (to[kOffsetScales] != nullptr) to[kOffsetScales][3 * i + axis] = reach_sum[axis] * reach;
            if (to[kBaseScales] != nullptr) to[kBaseScales][3 * i + axis] = base[axis];
        }
        if (to[kFeatures] != nullptr)
            for (int c = 0; c < m.d; ++c) to[kFeatures][i * m.d + c] = seen ? to_input(c, i) : 0.0f;
        if (to[kAppearance] != nullptr)
            for (int r = 0; r < m.rank; ++r) {
                float sum = 0.0f;
                for (int c = 0; c < m.d && seen; ++c) sum += to_input(c, i) * m.basis[r * m.d + c];
                to[kAppearance][i * m.rank + r] = sum;
            }
        if (to[kPositions] == nullptr) return;
        if (seen) to_position(i, mean);
        for (int axis = 0; axis < 3; ++axis) to[kPositions][3 * i + axis] = mean[axis];
    }

    // Adds the gradient through the direction and the distance.
    const float* center;
    SGS_ELEMENT void to_position(int64_t i, float* mean) const {
        const float* p = m.values[kPositions] + 3 * i;
        const float to[3] = {p[0] - center[0], p[1] - center[1], p[2] - center[2]};
        const float distance = most(length(to[0], to[1], to[2]), kLeastLength);
        float gradient[3], along = 0.0f;
        for (int axis = 0; axis < 3; ++axis) {
            gradient[axis] = to_input(m.d + axis, i);
            along += gradient[axis] * to[axis] / distance;
        }
        const float to_distance = m.inputs > m.d + 3 ? to_input(m.d + 3, i) : 0.0f;
        for (int axis = 0; axis < 3; ++axis) {
            const float direction = to[axis] / distance;
            mean[axis] += (gradient[axis] - along * direction) / distance + to_distance * direction;
        }
    }
};

}  // namespace fit
}  // namespace cuda
}  // namespace structgstream
