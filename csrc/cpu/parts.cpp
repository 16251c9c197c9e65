// SPDX-License-Identifier: Apache-2.0
// Division of a picture for the loss: bands of rows, one per thread, or few rectangles that cover the tiles that count.
// A row's sums do not depend on the bands, and rectangles depend only on the tiles, so results do not depend on threads.

#include "ssim.h"

#include <algorithm>

#include "splat.h"

namespace structgstream {
namespace {

constexpr int kLeastRows = 4;  // smallest height of a band

std::vector<Part> bands(int height, int width, int threads) {
    const int count = std::max(1, std::min(threads, height / kLeastRows));
    std::vector<Part> found;
    for (int n = 0; n < count; ++n) {
        const int top = static_cast<int>(static_cast<int64_t>(height) * n / count);
        const int bottom = static_cast<int>(static_cast<int64_t>(height) * (n + 1) / count);
        found.push_back({0, top, width, bottom, nullptr, nullptr});
    }
    return found;
}

// Runs of tiles, extended down as far as the run is the same: every seam computes ten rows or columns twice.
std::vector<Part> rectangles(int height, int width, const uint8_t* tiles) {
    const int tiles_x = (width + kTile - 1) / kTile, tiles_y = (height + kTile - 1) / kTile;
    std::vector<uint8_t> left_over(tiles, tiles + static_cast<size_t>(tiles_x) * tiles_y);
    std::vector<Part> found;
    for (int y = 0; y < tiles_y; ++y) {
        for (int x = 0; x < tiles_x; ++x) {
            if (!left_over[static_cast<size_t>(y) * tiles_x + x]) continue;
            int end = x, last = y;
            while (end < tiles_x && left_over[static_cast<size_t>(y) * tiles_x + end]) ++end;
            const auto same_run = [&](int row) {
                const uint8_t* line = left_over.data() + static_cast<size_t>(row) * tiles_x;
                return (x == 0 || !line[x - 1]) && (end == tiles_x || !line[end]) &&
                       std::all_of(line + x, line + end, [](uint8_t tile) { return tile != 0; });
            };
            while (last < tiles_y && same_run(last)) {
                std::fill_n(left_over.data() + static_cast<size_t>(last) * tiles_x + x, end - x, uint8_t{0});
                ++last;
            }
            found.push_back({x * kTile, y * kTile, std::min(end * kTile, width), std::min(last * kTile, height),
                             nullptr, nullptr});
        }
    }
    return found;
}

}  // namespace

Parts::Parts(int height, int width, const uint8_t* tiles, int threads)
    : parts_(tiles == nullptr ? bands(height, width, threads) : rectangles(height, width, tiles)) {
    size_t rows = 0;
    for (const Part& part : parts_) rows += part.bottom - part.top;
    sums_.assign(2 * rows, 0.0);
    double* next = sums_.data();
    for (Part& part : parts_) {
        part.row_l1 = next, next += part.bottom - part.top;
        part.row_ssim = next, next += part.bottom - part.top;
    }
}

void Parts::add_to(double* row_l1, double* row_ssim) const {
    for (const Part& part : parts_)
        for (int row = part.top; row < part.bottom; ++row) {
            row_l1[row] += part.row_l1[row - part.top];
            row_ssim[row] += part.row_ssim[row - part.top];
        }
}

}  // namespace structgstream
