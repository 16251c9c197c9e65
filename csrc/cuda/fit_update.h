// SPDX-License-Identifier: Apache-2.0
// What an iteration adds to the pictures' gradient, and the step: smoothness, the rate term, Adam, sums for the
// mean; and the numbers that it reports. Sums have a fixed order, or are sums of integers.
#pragma once

#include <cmath>
#include <cstdint>

#include "../include/structgstream.h"
#include "fit_lists.h"

namespace structgstream {
namespace cuda {
namespace fit {

constexpr int kTerms = 5;
constexpr double kFixed = 1099511627776.0;  // 2^40: gradients of shares are summed as integers of this unit

// Values as they are drawn: multiples of their steps.
struct Round {
    struct Part {
        const float* values;
        float* rounded;
        int64_t end;  // of its numbers among those of all parts
        float step;
    };
    Part parts[SGS_LEAVES];
    int count;

    SGS_ELEMENT void operator()(int64_t n) const {
        int64_t begin = 0;
        for (int p = 0; p < count; ++p) {
            if (n < parts[p].end) {
                parts[p].rounded[n - begin] = rintf(parts[p].values[n - begin] / parts[p].step) * parts[p].step;
                return;
            }
            begin = parts[p].end;
        }
    }
};

// A picture as the camera corrects it, black where its mask is zero; and the gradient back, in place.
struct Correct {
    const uint8_t* mask;
    const float *gains, *biases, *image;
    float* corrected;
    SGS_ELEMENT void operator()(int64_t n) const {
        corrected[n] = mask[n / 3] ? image[n] * gains[n % 3] + biases[n % 3] : 0.0f;
    }
};
struct CorrectBackward {
    const uint8_t* mask;
    const float* gains;
    float* gradient;
    SGS_ELEMENT void operator()(int64_t n) const { gradient[n] = mask[n / 3] ? gradient[n] * gains[n % 3] : 0.0f; }
};

// Difference of an anchor's displacement from its neighbours' (reference_losses.neighbour_difference).
struct Smooth {
    const State* state;
    const float *positions, *start;
    const int64_t* neighbours;
    const float* shares;
    int64_t each;
    float pixel, slack;
    float* sums;         // [M]
    int64_t* gradients;  // [M, 3], zero before

    SGS_ELEMENT float moved(int64_t n) const { return (positions[n] - start[n]) / pixel; }

    SGS_LANES_FN void operator()(int64_t i) const {
        if (state->stopped >= 0) return;
        const float own[3] = {moved(3 * i), moved(3 * i + 1), moved(3 * i + 2)};
        float sum = 0.0f;
        int64_t from[3] = {};
        for (int64_t n = each * i; n < each * (i + 1); ++n) {
            const int64_t other = neighbours[n];
            float apart[3], square = slack * slack;
            for (int axis = 0; axis < 3; ++axis) {
                apart[axis] = moved(3 * other + axis) - own[axis];
                square += apart[axis] * apart[axis];
            }
            const float distance = sqrtf(square), slope = shares[n] / distance;
            sum += shares[n] * (distance - slack);
            for (int axis = 0; axis < 3 && distance > 0.0f; ++axis) {
                const int64_t fixed = static_cast<int64_t>(static_cast<double>(slope * apart[axis]) * kFixed);
                add_to(gradients + 3 * other + axis, fixed);
                from[axis] += fixed;
            }
        }
        for (int axis = 0; axis < 3; ++axis) add_to(gradients + 3 * i + axis, -from[axis]);
        sums[i] = sum;
    }
};

constexpr int kUpdateThreads = 256;

// Regularisers, Adam and mean of a number of a leaf. A thread is a number.
struct Update {
    static constexpr int kThreads = kUpdateThreads;
    struct Shared {
        float bits[kUpdateThreads];
    };
    struct Part {
        sgs_leaf leaf;
        const float* gradient;
        int64_t end;  // of its numbers among those of all leaves that are trained
        float step_size;
        bool steps, smooth;
    };
    Part parts[SGS_LEAVES];
    int count;
    const State* state;
    const int64_t* smoothness;  // [M, 3]
    float smooth_factor, rate;
    float beta1, beta2, rest1, rest2, correction, eps;
    bool sums;
    float* bits;                // [blocks]

    SGS_LANES_FN void operator()(int block, Shared& s, const Threads& threads) const {
        if (state->stopped >= 0) return;
        threads.each([&](int t) { s.bits[t] = step(static_cast<int64_t>(block) * kThreads + t); });
        for (int half = kThreads / 2; half > 0; half /= 2)
            threads.each([&](int t) {
                if (t < half) s.bits[t] += s.bits[t + half];
            });
        threads.each([&](int t) {
            if (t == 0) bits[block] = s.bits[0];
        });
    }

    // Updates the n-th number; returns the bits of its change.
    SGS_LANES_FN float step(int64_t n) const {
        int64_t begin = 0;
        for (int p = 0; p < count; ++p) {
            if (n < parts[p].end) return step_of(parts[p], n - begin);
            begin = parts[p].end;
        }
        return 0.0f;
    }

    SGS_LANES_FN float step_of(const Part& part, int64_t i) const {
        const sgs_leaf& leaf = part.leaf;
        float g = part.gradient[i], value = leaf.values[i], found = 0.0f, regularizer = 0.0f;
        if (leaf.before != nullptr && i < leaf.before_count) {
            const float difference = value - leaf.before[i], inverse = 1.0f / leaf.step;
            const float ratio = 1.0f + fabsf(difference) * inverse;
            found = log2f(ratio);
            regularizer = difference == 0.0f ? 0.0f : copysignf(1.44269504f * inverse, difference) / ratio * rate;
        }
        if (part.smooth) regularizer += static_cast<float>(static_cast<double>(smoothness[i]) / kFixed) * smooth_factor;
        g += regularizer;
        if (part.steps) {
            const float m = beta1 * leaf.first[i] + rest1 * g, v = beta2 * leaf.second[i] + rest2 * g * g;
            leaf.first[i] = m, leaf.second[i] = v;
            value -= part.step_size * m / (sqrtf(v) * correction + eps);
            leaf.values[i] = value;
        }
        if (leaf.sums != nullptr && sums) leaf.sums[i] += value;
        return found;
    }
};

// Squared error of sixteen pixels of a row, in the tiles of a view; a thread is a tile's row.
struct SquaredErrors {
    const State* state;
    const uint8_t *tiles, *mask;
    const float *gains, *biases, *image;
    const uint8_t* picture;
    int columns, width;
    float* sums;       // [H, columns]
    int32_t* counts;

    SGS_ELEMENT void operator()(int64_t n) const {
        if (state->stopped >= 0) return;
        const int64_t y = n / columns;
        const int column = static_cast<int>(n % columns);
        float sum = 0.0f;
        int32_t counted = 0;
        if (tiles[y / kTilePixels * columns + column])
            for (int x = column * kTilePixels; x < (column + 1) * kTilePixels && x < width; ++x) {
                const int64_t pixel = y * width + x;
                if (mask != nullptr && !mask[pixel]) continue;
                ++counted;
                for (int c = 0; c < 3; ++c) {
                    const float shown = image[3 * pixel + c] * gains[c] + biases[c];
                    const float apart = fminf(fmaxf(shown, 0.0f), 1.0f) - static_cast<float>(picture[3 * pixel + c]) / 255.0f;
                    sum += apart * apart;
                }
            }
        sums[n] = sum, counts[n] = counted;
    }
};

// Terms of the loss and the squared error of an iteration, by one block.
struct Report {
    static constexpr int kThreads = 256;
    struct Shared {
        double sums[4][kThreads];
    };
    State* state;
    const float* means;  // L1 and SSIM
    const float* bits;
    int64_t bit_count;
    const float* smooth_sums;  // [anchors], or null
    int64_t anchors;
    const float* squares;      // [segments], or null
    const int32_t* counts;
    int64_t segments;
    float l1, ssim, volume, smoothness, rate;
    bool mean_volume;
    float* terms;              // [kTerms]
    double* squared_error;

    SGS_LANES_FN void operator()(int, Shared& s, const Threads& threads) const {
        if (state->stopped >= 0) return;
        threads.each([&](int t) {
            for (int j = 0; j < 4; ++j) s.sums[j][t] = 0.0;
            for (int64_t i = t; i < bit_count; i += kThreads) s.sums[0][t] += static_cast<double>(bits[i]);
            for (int64_t i = t; i < anchors && smooth_sums != nullptr; i += kThreads)
                s.sums[1][t] += static_cast<double>(smooth_sums[i]);
            for (int64_t i = t; i < segments && squares != nullptr; i += kThreads)
                s.sums[2][t] += static_cast<double>(squares[i]), s.sums[3][t] += counts[i];
        });
        for (int half = kThreads / 2; half > 0; half /= 2)
            threads.each([&](int t) {
                if (t < half)
                    for (int j = 0; j < 4; ++j) s.sums[j][t] += s.sums[j][t + half];
            });
        threads.each([&](int t) {
            if (t != 0) return;
            const int32_t count = mean_volume && state->visible > 1 ? state->visible : 1;
            terms[0] = means[0], terms[1] = 1.0f - means[1];
            terms[2] = volume == 0.0f ? 0.0f : state->volume / static_cast<float>(count);
            terms[3] = smooth_sums == nullptr ? 0.0f : static_cast<float>(s.sums[1][0]) / static_cast<float>(anchors);
            terms[4] = l1 * terms[0] + ssim * terms[1] + volume * terms[2] + smoothness * terms[3] +
                       rate * static_cast<float>(s.sums[0][0]);
            if (squares != nullptr) *squared_error = s.sums[2][0] / (3.0 * (s.sums[3][0] > 1.0 ? s.sums[3][0] : 1.0));
        });
    }
};

}  // namespace fit
}  // namespace cuda
}  // namespace structgstream
