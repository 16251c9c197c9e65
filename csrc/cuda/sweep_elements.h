// SPDX-License-Identifier: Apache-2.0
// Work of a thread for a point of a ray in one view, and for a ray; see kernels/reference_motion.py.
#pragma once

#include <cmath>

#include "element.h"
#include "sweep.h"

namespace structgstream {
namespace cuda {

constexpr float kSupporting = 0.3f, kContradicting = 0.05f, kFrontShare = 1.03f;
constexpr float kMostDifference = 0.3f, kMissCost = 0.15f, kLonelyCost = 0.05f, kEqualCost = 0.01f;

// Rays of one view and the depths on them.
struct Rays {
    sgs_cuda_sweep_view own;
    const int64_t* pixels;
    const float* farthest;
    int planes;

    SGS_ELEMENT float depth(int64_t ray, int plane) const {
        const float step = planes > 1 ? static_cast<float>(plane) / static_cast<float>(planes - 1) : 0.0f;
        const float nearest = 1.0f / own.near_plane;
        return 1.0f / (nearest + step * (1.0f / farthest[ray] - nearest));
    }
};

// Vote of another view on a point: whether it supports or contradicts the point, and its colour difference.
struct SweepVote {
    Rays rays;
    sgs_cuda_sweep_view other;
    int64_t points;
    float* votes;

    SGS_ELEMENT void operator()(int64_t point) const {
        const int64_t ray = point / rays.planes;
        const int64_t x = rays.pixels[2 * ray], y = rays.pixels[2 * ray + 1];
        const sgs_cuda_sweep_view& own = rays.own;
        const float z = rays.depth(ray, static_cast<int>(point - ray * rays.planes));
        const float* m = own.viewmat;
        const float local[3] = {(x + 0.5f - own.K[2]) / own.K[0] * z - m[3], (y + 0.5f - own.K[5]) / own.K[4] * z - m[7],
                                z - m[11]};
        float world[3], seen[3];
        for (int i = 0; i < 3; ++i) world[i] = m[i] * local[0] + m[4 + i] * local[1] + m[8 + i] * local[2];
        for (int i = 0; i < 3; ++i) {
            const float* row = other.viewmat + 4 * i;
            seen[i] = row[0] * world[0] + row[1] * world[1] + row[2] * world[2] + row[3];
        }
        if (!(seen[2] > other.near_plane)) return;
        const float column = floorf(other.K[0] * seen[0] / seen[2] + other.K[2]);
        const float row = floorf(other.K[4] * seen[1] / seen[2] + other.K[5]);
        if (!(column >= 0.0f && column < other.width && row >= 0.0f && row < other.height)) return;
        const int64_t at = static_cast<int64_t>(row) * other.width + static_cast<int64_t>(column);
        if (!(seen[2] < kFrontShare * other.depths[at])) return;
        const float missing = other.missing[at];
        if (missing < kContradicting) votes[points + point] += 1.0f;
        if (!(missing > kSupporting)) return;
        const float *there = other.colors + 3 * at, *here = own.colors + 3 * (y * own.width + x);
        const float apart = (fabsf(there[0] - here[0]) + fabsf(there[1] - here[1]) + fabsf(there[2] - here[2])) / 3.0f;
        votes[point] += 1.0f;
        votes[2 * points + point] += fminf(apart, kMostDifference);
    }
};

// The middle of the range of a ray with the least cost.
struct SweepBest {
    Rays rays;
    int64_t points;
    const float* votes;
    int least_supports;
    float most_contradictions;
    float *depths, *costs;

    SGS_ELEMENT float cost(int64_t point) const {
        const float supports = votes[point], contradictions = votes[points + point];
        const float share = contradictions / fmaxf(supports + contradictions, 1.0f);
        if (supports < static_cast<float>(least_supports) || share > most_contradictions) return INFINITY;
        const float some = fmaxf(supports, 1.0f);
        return votes[2 * points + point] / some + kMissCost * share + kLonelyCost / some;
    }

    SGS_ELEMENT void operator()(int64_t ray) const {
        const int64_t start = ray * rays.planes;
        int best = 0;
        float least = cost(start);
        for (int plane = 1; plane < rays.planes; ++plane) {
            const float found = cost(start + plane);
            if (found < least) {
                least = found;
                best = plane;
            }
        }
        int first = best, last = best;
        while (first > 0 && cost(start + first - 1) <= least + kEqualCost) --first;
        while (last + 1 < rays.planes && cost(start + last + 1) <= least + kEqualCost) ++last;
        costs[ray] = least;
        depths[ray] = least < INFINITY ? rays.depth(ray, (first + last) / 2) : 0.0f;
    }
};

}  // namespace cuda
}  // namespace structgstream
