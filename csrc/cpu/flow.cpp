// SPDX-License-Identifier: Apache-2.0
// Forward-backward consistent flow, in one pass over the pixels.

#include <algorithm>
#include <cstdint>

#include "structgstream.h"

extern "C" void sgs_confident_flow(
    const float* flow, const float* back, const uint8_t* mask, int height, int width, float relative, float absolute,
    float* maps, int threads) {
    const int64_t pixels = static_cast<int64_t>(height) * width;
    const float last_x = static_cast<float>(width - 1), last_y = static_cast<float>(height - 1);
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
    for (int row = 0; row < height; ++row) {
        for (int column = 0; column < width; ++column) {
            const int64_t at = static_cast<int64_t>(row) * width + column;
            const float fx = flow[2 * at], fy = flow[2 * at + 1];
            const float x = fx + static_cast<float>(column), y = fy + static_cast<float>(row);
            float confidence = 0.0f;
            // NaN counts as outside.
            if (x >= 0.0f && x <= last_x && y >= 0.0f && y <= last_y && (mask == nullptr || mask[at])) {
                const int x0 = static_cast<int>(x), y0 = static_cast<int>(y);
                const int x1 = std::min(x0 + 1, width - 1), y1 = std::min(y0 + 1, height - 1);
                const float across = x - static_cast<float>(x0), down = y - static_cast<float>(y0);
                const float weights[4] = {
                    (1.0f - across) * (1.0f - down), across * (1.0f - down), (1.0f - across) * down, across * down};
                const int64_t places[4] = {
                    static_cast<int64_t>(y0) * width + x0, static_cast<int64_t>(y0) * width + x1,
                    static_cast<int64_t>(y1) * width + x0, static_cast<int64_t>(y1) * width + x1};
                float bx = 0.0f, by = 0.0f;
                for (int corner = 0; corner < 4; ++corner) {
                    bx += weights[corner] * back[2 * places[corner]];
                    by += weights[corner] * back[2 * places[corner] + 1];
                }
                const float rest = (fx + bx) * (fx + bx) + (fy + by) * (fy + by);
                const float lengths = fx * fx + fy * fy + bx * bx + by * by;
                confidence = rest <= relative * lengths + absolute ? 1.0f : 0.0f;
            }
            maps[at] = confidence;
            maps[pixels + at] = confidence > 0.0f ? fx : 0.0f;
            maps[2 * pixels + at] = confidence > 0.0f ? fy : 0.0f;
        }
    }
}
