// SPDX-License-Identifier: Apache-2.0
// Residual of a rendering, reduced to a picture's size: mean absolute difference over channels and 3 x 3 pixels.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <new>
#include <vector>

#include "splat.h"
#include "structgstream.h"

namespace {

using structgstream::kTile;

// The pixels of `length` that pixel `i` of `size` covers, as in torch's area interpolation.
struct Span {
    int begin, end;
    Span(int i, int length, int size)
        : begin(static_cast<int>(static_cast<int64_t>(i) * length / size)),
          end(static_cast<int>((static_cast<int64_t>(i + 1) * length + size - 1) / size)) {}
};

// One row of the rendering as its camera would have recorded it; outside the tiles, the row of the picture.
void record_row(const sgs_residual& r, int row, const float* gains, const float* biases, float* out) {
    const int numbers = 3 * r.width;
    const float* drawn = r.rendering + static_cast<size_t>(row) * numbers;
    for (int i = 0; i < numbers; ++i) out[i] = std::min(1.0f, std::max(0.0f, drawn[i] * gains[i] + biases[i]));
    if (!r.tiles) return;
    const int tiles_x = (r.width + kTile - 1) / kTile;
    const uint8_t* tiles = r.tiles + static_cast<size_t>(row / kTile) * tiles_x;
    const uint8_t* shown = r.outside + static_cast<size_t>(row) * numbers;
    for (int t = 0; t < tiles_x; ++t)
        if (!tiles[t])
            for (int i = 3 * kTile * t; i < std::min(3 * kTile * (t + 1), numbers); ++i) out[i] = shown[i] / 255.0f;
}

// Means of `rows` rows' sums [3 W] by columns.
void mean_across(const std::vector<Span>& columns, int width, const float* sums, int rows, float* out) {
    const int count = static_cast<int>(columns.size());
    if (count == width) {
        const float share = 1.0f / static_cast<float>(rows);
        for (int i = 0; i < 3 * width; ++i) out[i] = sums[i] * share;
        return;
    }
    for (int x = 0; x < count; ++x) {
        const Span span = columns[x];
        float mean[3] = {0.0f, 0.0f, 0.0f};
        for (int i = span.begin; i < span.end; ++i)
            for (int c = 0; c < 3; ++c) mean[c] += sums[3 * i + c];
        const float share = 1.0f / static_cast<float>(rows * (span.end - span.begin));
        for (int c = 0; c < 3; ++c) out[3 * x + c] = mean[c] * share;
    }
}

}  // namespace

extern "C" int sgs_picture_residual(const struct sgs_residual* residual, float* found) {
    const sgs_residual& r = *residual;
    const int width = r.reduced_width, height = r.reduced_height, numbers = 3 * r.width;
    try {
        std::vector<float> gains(numbers), biases(numbers), row(numbers), sums(numbers), mean(3 * static_cast<size_t>(width));
        std::vector<float> lines(static_cast<size_t>(height) * width), difference(3 * static_cast<size_t>(width));
        std::vector<Span> columns;
        for (int x = 0; x < width; ++x) columns.emplace_back(x, r.width, width);
        for (int i = 0; i < numbers; ++i) gains[i] = r.gains ? r.gains[i % 3] : 1.0f, biases[i] = r.biases ? r.biases[i % 3] : 0.0f;
        for (int y = 0; y < height; ++y) {
            const Span span(y, r.height, height);
            std::fill(sums.begin(), sums.end(), 0.0f);
            for (int from = span.begin; from < span.end; ++from) {
                record_row(r, from, gains.data(), biases.data(), row.data());
                for (int i = 0; i < numbers; ++i) sums[i] += row[i];
            }
            mean_across(columns, r.width, sums.data(), span.end - span.begin, mean.data());
            const size_t first = static_cast<size_t>(y) * width;
            const uint8_t* picture = r.picture + 3 * first;
            float* off = lines.data() + first;
            for (int i = 0; i < 3 * width; ++i) difference[i] = std::fabs(mean[i] - picture[i] / 255.0f);
            for (int x = 0; x < width; ++x)
                off[x] = (difference[3 * x] + difference[3 * x + 1] + difference[3 * x + 2]) / 3.0f;
            for (int x = 0; x < width && r.mask; ++x)
                if (!r.mask[first + x]) off[x] = 0.0f;
        }
        // Sums of three rows, then of three columns, over the pixels that exist.
        std::vector<float> down(width);
        for (int y = 0; y < height; ++y) {
            const int top = std::max(0, y - 1), bottom = std::min(height, y + 2);
            std::copy_n(lines.data() + static_cast<size_t>(top) * width, width, down.data());
            for (int from = top + 1; from < bottom; ++from) {
                const float* line = lines.data() + static_cast<size_t>(from) * width;
                for (int x = 0; x < width; ++x) down[x] += line[x];
            }
            float* out = found + static_cast<size_t>(y) * width;
            const auto mean_of = [&](int left, int right) {
                float sum = 0.0f;
                for (int from = left; from < right; ++from) sum += down[from];
                return sum / static_cast<float>((bottom - top) * (right - left));
            };
            const float share = 1.0f / static_cast<float>(3 * (bottom - top));
            for (int x = 1; x < width - 1; ++x) out[x] = (down[x - 1] + down[x] + down[x + 1]) * share;
            out[0] = mean_of(0, std::min(2, width));
            out[width - 1] = mean_of(std::max(0, width - 2), width);
            for (int x = 0; x < width && r.mask; ++x)
                if (!r.mask[static_cast<size_t>(y) * width + x]) out[x] = 0.0f;
        }
        return 0;
    } catch (const std::bad_alloc&) {
        return 1;
    }
}
