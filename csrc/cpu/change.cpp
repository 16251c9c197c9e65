// SPDX-License-Identifier: Apache-2.0
// The pixels that changed between two pictures of one camera. Only integers are used, so every instruction set and the
// reference give the same result.

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <vector>

#include "structgstream.h"

namespace {

constexpr int kChannels = 3;

// out[x] = the sum or the largest of in[x - reach] ... in[x + reach], as far as they exist.
template <typename T, typename Join>
void across(const T* in, int width, int reach, T* out, Join join) {
    for (int x = 0; x < width; ++x) out[x] = in[x];
    for (int d = 1; d <= reach; ++d) {
        for (int x = d; x < width; ++x) out[x] = join(out[x], in[x - d]);
        for (int x = 0; x + d < width; ++x) out[x] = join(out[x], in[x + d]);
    }
}

template <typename T, typename Join>
void down(const T* rows, int height, int width, int y, int reach, T* out, Join join) {
    const int first = std::max(0, y - reach), last = std::min(height - 1, y + reach);
    std::copy_n(rows + static_cast<size_t>(first) * width, width, out);
    for (int other = first + 1; other <= last; ++other) {
        const T* row = rows + static_cast<size_t>(other) * width;
        for (int x = 0; x < width; ++x) out[x] = join(out[x], row[x]);
    }
}

}  // namespace

extern "C" int sgs_changed_pixels(
    const uint8_t* before, const uint8_t* now, int height, int width, float threshold, int reach, uint8_t* changed,
    int threads) try {
    const size_t pixels = static_cast<size_t>(height) * width;
    std::vector<uint16_t> sums(pixels);   // three pixels across; at most 9 * 255 after the second pass: 6885
    std::vector<uint8_t> marks(pixels);
    const auto add = [](auto a, auto b) { return static_cast<decltype(a)>(a + b); };
    const auto most = [](auto a, auto b) { return std::max(a, b); };
#pragma omp parallel num_threads(threads) if (threads > 1)
    {
        std::vector<uint16_t> line(width), total(width);
        std::vector<uint8_t> mark(width);
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) {
            const size_t at = static_cast<size_t>(y) * width * kChannels;
            for (int x = 0; x < width; ++x) {
                const uint8_t* a = before + at + kChannels * x;
                const uint8_t* b = now + at + kChannels * x;
                line[x] = static_cast<uint16_t>(std::abs(a[0] - b[0]) + std::abs(a[1] - b[1]) + std::abs(a[2] - b[2]));
            }
            across(line.data(), width, 1, sums.data() + static_cast<size_t>(y) * width, add);
        }
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y) {
            down(sums.data(), height, width, y, 1, total.data(), add);
            const int rows = std::min(height - 1, y + 1) - std::max(0, y - 1) + 1;
            for (int x = 0; x < width; ++x) {
                const int columns = std::min(width - 1, x + 1) - std::max(0, x - 1) + 1;
                mark[x] = total[x] > threshold * static_cast<float>(255 * kChannels * rows * columns);
            }
            across(mark.data(), width, reach, marks.data() + static_cast<size_t>(y) * width, most);
        }
#pragma omp for schedule(static)
        for (int y = 0; y < height; ++y)
            down(marks.data(), height, width, y, reach, changed + static_cast<size_t>(y) * width, most);
    }
    return 0;
} catch (const std::bad_alloc&) {
    return 1;
}
