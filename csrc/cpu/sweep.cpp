// SPDX-License-Identifier: Apache-2.0
// Plane sweep: along each ray, the depth at which several views show the same new content (kernels/reference_motion.py).

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "structgstream.h"

namespace {

constexpr float kSupporting = 0.3f, kContradicting = 0.05f, kFrontShare = 1.03f;
constexpr float kMostDifference = 0.3f, kMissCost = 0.15f, kLonelyCost = 0.05f, kEqualCost = 0.01f;

// Projection into a view of a ray that is a + z b in the world: a and b in camera coordinates.
struct Line {
    float from[3], along[3];
};

Line line_in(const sgs_sweep_view& v, const float* origin, const float* ray) {
    Line line;
    for (int i = 0; i < 3; ++i) {
        const float* m = v.viewmat + 4 * i;
        line.from[i] = m[0] * origin[0] + m[1] * origin[1] + m[2] * origin[2] + m[3];
        line.along[i] = m[0] * ray[0] + m[1] * ray[1] + m[2] * ray[2];
    }
    return line;
}

struct Votes {
    int supports = 0, contradictions = 0;
    float difference = 0.0f;

    void add(const sgs_sweep_view& v, const Line& line, float z, const float* color) {
        const float depth = line.from[2] + z * line.along[2];
        if (!(depth > v.near_plane)) return;
        const float column = std::floor(v.K[0] * (line.from[0] + z * line.along[0]) / depth + v.K[2]);
        const float row = std::floor(v.K[4] * (line.from[1] + z * line.along[1]) / depth + v.K[5]);
        if (!(column >= 0.0f && column < v.width && row >= 0.0f && row < v.height)) return;
        const int64_t at = static_cast<int64_t>(row) * v.width + static_cast<int64_t>(column);
        if (!(depth < kFrontShare * v.depths[at])) return;
        const float missing = v.missing[at];
        contradictions += missing < kContradicting;
        if (!(missing > kSupporting)) return;
        ++supports;
        const float* seen = v.colors + 3 * at;
        const float apart =
            (std::abs(seen[0] - color[0]) + std::abs(seen[1] - color[1]) + std::abs(seen[2] - color[2])) / 3.0f;
        difference += std::min(apart, kMostDifference);
    }

    float cost(int least_supports, float most_contradictions) const {
        const float share = static_cast<float>(contradictions) / static_cast<float>(std::max(supports + contradictions, 1));
        if (supports < least_supports || share > most_contradictions) return std::numeric_limits<float>::infinity();
        const float some = static_cast<float>(std::max(supports, 1));
        return difference / some + kMissCost * share + kLonelyCost / some;
    }
};

}  // namespace

extern "C" void sgs_sweep(
    const sgs_sweep_view* views, int view_count, int view_index, const int64_t* pixels, const float* farthest,
    int64_t count, int planes, int least_supports, float most_contradictions, float* depths, float* costs, int threads) {
    const sgs_sweep_view& own = views[view_index];
    float origin[3];  // of the camera in the world: minus R^T t
    for (int i = 0; i < 3; ++i)
        origin[i] = -(own.viewmat[i] * own.viewmat[3] + own.viewmat[4 + i] * own.viewmat[7] + own.viewmat[8 + i] * own.viewmat[11]);
#pragma omp parallel num_threads(threads) if (threads > 1)
  {
    std::vector<Line> lines(view_count);
    std::vector<float> cost(planes);
#pragma omp for schedule(dynamic, 16)
    for (int64_t n = 0; n < count; ++n) {
        const int64_t x = pixels[2 * n], y = pixels[2 * n + 1];
        const float local[3] = {(x + 0.5f - own.K[2]) / own.K[0], (y + 0.5f - own.K[5]) / own.K[4], 1.0f};
        float ray[3];
        for (int i = 0; i < 3; ++i)
            ray[i] = own.viewmat[i] * local[0] + own.viewmat[4 + i] * local[1] + own.viewmat[8 + i] * local[2];
        for (int v = 0; v < view_count; ++v) lines[v] = line_in(views[v], origin, ray);
        const float* color = own.colors + 3 * (y * own.width + x);
        const auto depth_of = [&](int plane) {
            const float step = planes > 1 ? static_cast<float>(plane) / static_cast<float>(planes - 1) : 0.0f;
            return 1.0f / (1.0f / own.near_plane + step * (1.0f / farthest[n] - 1.0f / own.near_plane));
        };
        for (int plane = 0; plane < planes; ++plane) {
            const float z = depth_of(plane);
            Votes votes;
            for (int v = 0; v < view_count; ++v)
                if (v != view_index) votes.add(views[v], lines[v], z, color);
            cost[plane] = votes.cost(least_supports, most_contradictions);
        }
        const int best = static_cast<int>(std::min_element(cost.begin(), cost.end()) - cost.begin());
        // On an untextured surface a range of depths has equal costs; its middle is chosen.
        int first = best, last = best;
        while (first > 0 && cost[first - 1] <= cost[best] + kEqualCost) --first;
        while (last + 1 < planes && cost[last + 1] <= cost[best] + kEqualCost) ++last;
        costs[n] = cost[best];
        depths[n] = std::isfinite(cost[best]) ? depth_of((first + last) / 2) : 0.0f;
    }
  }
}
