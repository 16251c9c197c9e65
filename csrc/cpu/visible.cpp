// SPDX-License-Identifier: Apache-2.0
// The anchors in a camera's view. An anchor is represented by a ball that contains all its Gaussians at 3.4 standard
// deviations; the ball's box on the picture decides. The test is conservative: it changes the cost of a rendering, never
// its pixels.

#include "visible.h"

#include <algorithm>
#include <cmath>

#include "vec.h"

namespace structgstream {
namespace SGS_ISA {

// visible: a byte for each anchor. covered: see csrc/cpu/visible.h.
void anchors_visible(const sgs_anchors& a, int64_t count, const View& view, const int32_t* covered, uint8_t* visible,
                     int threads) {
    const int k = a.offsets_per_anchor;
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
    for (int64_t begin = 0; begin < count; begin += kLanes) {
        // Lanes are anchors; those beyond the end repeat the last one.
        float rows[9][kLanes], base[kLanes];
        int64_t lane_anchor[kLanes];
        for (int l = 0; l < kLanes; ++l) {
            const int64_t i = lane_anchor[l] = std::min(begin + l, count - 1);
            for (int j = 0; j < 3; ++j) {
                rows[j][l] = a.positions[3 * i + j];
                rows[3 + j][l] = a.log_offset_scales[3 * i + j];
            }
            const float* s = a.log_base_scales + 3 * i;
            base[l] = std::max(s[0], std::max(s[1], s[2]));
        }
        vf scale[3], square[3], reach = splat(0.0f);
        for (int j = 0; j < 3; ++j) scale[j] = exponential(load(rows[3 + j]));
        for (int n = 0; n < k; ++n) {
            for (int l = 0; l < kLanes; ++l)
                for (int j = 0; j < 3; ++j) rows[6 + j][l] = a.offsets[(lane_anchor[l] * k + n) * 3 + j];
            for (int j = 0; j < 3; ++j) square[j] = load(rows[6 + j]) * scale[j];
            reach = largest(reach, square[0] * square[0] + square[1] * square[1] + square[2] * square[2]);
        }
        float radii[kLanes], points[3][kLanes];
        const vf size = exponential(load(base)) * kBallDeviations;
        store(radii, reach);
        for (int l = 0; l < kLanes; ++l) radii[l] = std::sqrt(radii[l]);
        store(radii, load(radii) + size);
        if (view.intervals)
            for (int l = 0; l < kLanes; ++l) radii[l] += kBallIntervals * view.intervals[lane_anchor[l]];
        for (int j = 0; j < 3; ++j) {
            const float* v = view.viewmat + 4 * j;
            store(points[j], load(rows[0]) * v[0] + load(rows[1]) * v[1] + load(rows[2]) * v[2] + v[3]);
        }
        for (int l = 0; l < kLanes && begin + l < count; ++l)
            visible[begin + l] = view.sees(points[0][l], points[1][l], points[2][l], radii[l], covered);
    }
}

}  // namespace SGS_ISA
}  // namespace structgstream
