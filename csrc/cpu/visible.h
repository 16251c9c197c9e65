// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "anchors.h"
#include "splat.h"

namespace structgstream {

constexpr float kBallDeviations = 3.4f;  // alpha = 1/255 is reached before 3.33 at any opacity
constexpr float kBoxMargin = 2.0f;       // pixels: width of the smallest Gaussian after the rasteriser's low-pass
constexpr float kBallIntervals = 1.86226f;  // kBallDeviations times the root of kLowPass

struct View {
    float viewmat[12];
    float fx, fy, cx, cy, near;
    int width, height, tiles_x, tiles_y;
    const float* intervals;  // of each anchor, or null

    [[gnu::always_inline]] static bool beyond(float x, float z, float radius, float focal, float edge) {
        const float slope = (edge + kBoxMargin) / focal;
        return !((x + slope * z) / std::sqrt(1.0f + slope * slope) > -1.1f * radius);
    }

    // A ball at (x, y, z) in camera coordinates. covered: null, or a summed-area table of the tiles
    // [tiles_y + 1][tiles_x + 1], from which the number of tiles in a box needs four reads.
    [[gnu::always_inline]] bool sees(float x, float y, float z, float radius, const int32_t* covered) const {
        if (!(z + radius > near)) return false;
        const float closest = z - radius, furthest = z + radius;
        float box[4] = {0.0f, 0.0f, static_cast<float>(width), static_cast<float>(height)};
        if (closest > 0.0f) {
            const float left = x - radius, right = x + radius, top = y - radius, bottom = y + radius;
            box[0] = fx * left / (left < 0.0f ? closest : furthest) + cx - kBoxMargin;
            box[1] = fy * top / (top < 0.0f ? closest : furthest) + cy - kBoxMargin;
            box[2] = fx * right / (right < 0.0f ? furthest : closest) + cx + kBoxMargin;
            box[3] = fy * bottom / (bottom < 0.0f ? furthest : closest) + cy + kBoxMargin;
            if (!(box[0] < width && box[1] < height && box[2] > 0.0f && box[3] > 0.0f)) return false;
        } else if (beyond(x, z, radius, fx, cx) || beyond(-x, z, radius, fx, width - cx) ||
                   beyond(y, z, radius, fy, cy) || beyond(-y, z, radius, fy, height - cy)) {
            return false;  // A ball that contains the camera plane has no box, but may be outside the frustum.
        }
        if (covered == nullptr) return true;
        const int x0 = static_cast<int>(std::max(box[0], 0.0f)) / kTile;
        const int y0 = static_cast<int>(std::max(box[1], 0.0f)) / kTile;
        const int x1 = static_cast<int>(std::min(box[2], width - 1.0f)) / kTile + 1;
        const int y1 = static_cast<int>(std::min(box[3], height - 1.0f)) / kTile + 1;
        const int row = tiles_x + 1;
        return covered[y1 * row + x1] - covered[y0 * row + x1] - covered[y1 * row + x0] + covered[y0 * row + x0] > 0;
    }
};

}  // namespace structgstream
