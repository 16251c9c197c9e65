// SPDX-License-Identifier: Apache-2.0
// Lists of the splats of each tile, front to back: rows are counted where they are projected, then a scan, a scatter in any
// order, and a sort in each tile by depth and row. The lists of a view's static splats are made once and merged.
#pragma once

#include <cmath>
#include <cstdint>

#include "block.h"
#include "fit_project.h"

namespace structgstream {
namespace cuda {
namespace fit {

// What the kernels of an iteration and the host know of each other, in the GPU's memory.
struct State {
    int32_t stopped;      // the iteration for which there are too few slots, and from which on nothing is done; or -1
    int32_t unused;
    int64_t slots;        // that it needs
    float volume;         // of all dynamic Gaussians
    int32_t visible;      // dynamic Gaussians that are drawn or out of the picture
};

// A bit pattern of a positive float has its order; rows break ties.
SGS_ELEMENT uint64_t sort_key(float depth, int64_t row) {
    union {
        float number;
        uint32_t bits;
    } d;
    d.number = depth;
    return static_cast<uint64_t>(d.bits) << 32 | static_cast<uint64_t>(row);
}

// Tiles of a splat's box, drawn or not: its slots for gradients, in rows of tiles.
SGS_ELEMENT int slots_of(const Splat& s) { return (s.tiles[2] - s.tiles[0]) * (s.tiles[3] - s.tiles[1]); }
SGS_ELEMENT int slot_in(const Splat& s, int tile, int columns) {
    return (tile / columns - s.tiles[1]) * (s.tiles[2] - s.tiles[0]) + tile % columns - s.tiles[0];
}

// A splat's moments over its tiles that are drawn; drawn null: all are.
SGS_ELEMENT void sum_moments(
    const Splat& s, const uint8_t* drawn, int columns, int64_t slot, const float* moments, float (&sums)[kMoments]) {
    for (float& sum : sums) sum = 0.0f;
    for (int y = s.tiles[1]; y < s.tiles[3]; ++y)
        for (int x = s.tiles[0]; x < s.tiles[2]; ++x, ++slot)
            if (drawn == nullptr || drawn[y * columns + x])
                for (int j = 0; j < kMoments; ++j) sums[j] += moments[slot * kMoments + j];
}

// Adds a splat to the number of entries of each tile that is drawn; drawn null: all are.
SGS_LANES_FN void count_tiles(const Splat& s, const uint8_t* drawn, int columns, int32_t* counts) {
    for (int y = s.tiles[1]; y < s.tiles[3]; ++y)
        for (int x = s.tiles[0]; x < s.tiles[2]; ++x)
            if (drawn == nullptr || drawn[y * columns + x]) add_to(counts + y * columns + x, 1);
}

// Running sums of `count` numbers, by one block.
constexpr int kScanThreads = 1024;
struct ScanShared {
    int64_t sums[2][kScanThreads];
};
// Calls number(i) and then write(i, sum of those before it); returns nothing: the total is passed to finish.
template <typename Number, typename Write, typename Finish>
SGS_LANES_FN void scan(
    int64_t count, ScanShared& s, const Threads& threads, const Number& number, const Write& write, const Finish& finish) {
    const int64_t each = (count + kScanThreads - 1) / kScanThreads;
    const auto end = [&](int t) { return (t + 1) * each < count ? (t + 1) * each : count; };
    threads.each([&](int t) {
        int64_t sum = 0;
        for (int64_t i = t * each; i < end(t); ++i) sum += number(i);
        s.sums[0][t] = sum;
    });
    int from = 0;
    for (int distance = 1; distance < kScanThreads; distance *= 2, from = 1 - from)
        threads.each([&](int t) {
            s.sums[1 - from][t] = s.sums[from][t] + (t >= distance ? s.sums[from][t - distance] : 0);
        });
    threads.each([&](int t) {
        int64_t sum = t > 0 ? s.sums[from][t - 1] : 0;
        for (int64_t i = t * each; i < end(t); ++i) {
            const int64_t own = number(i);
            write(i, sum);
            sum += own;
        }
        if (t == kScanThreads - 1) finish(s.sums[from][t]);
    });
}

// Starts of the tiles' lists and of the rows' slots; the counts are zero afterwards.
struct Starts {
    static constexpr int kThreads = kScanThreads;
    using Shared = ScanShared;
    int32_t* counts;         // [tiles]
    int64_t tiles;
    int32_t* starts;         // [tiles + 1]
    int32_t* cursors;        // [tiles], the starts again, which the scatter advances
    int64_t rows;
    int32_t* slots;          // [rows] number of slots of each, then the first one; or null
    const float *scales, *opacities;  // [rows] of which the volume is summed, or null
    int32_t iteration;
    int64_t capacity;        // slots
    State* state;            // or null
    int64_t* total;          // entries; or null
    int64_t* total_slots;    // or null

    SGS_LANES_FN void operator()(int, Shared& s, const Threads& threads) const {
        if (state != nullptr && state->stopped >= 0) return;
        if (slots != nullptr) {
            scan(
                rows, s, threads, [&](int64_t i) { return slots[i]; },
                [&](int64_t i, int64_t sum) { slots[i] = static_cast<int32_t>(sum < capacity ? sum : capacity); },
                [&](int64_t sum) {
                    if (total_slots != nullptr) *total_slots = sum;
                    if (state == nullptr) return;
                    state->slots = sum;
                    if (sum > capacity) state->stopped = iteration;
                });
        }
        scan(
            tiles, s, threads, [&](int64_t i) { return counts[i]; },
            [&](int64_t i, int64_t sum) {
                starts[i] = cursors[i] = static_cast<int32_t>(sum);
                counts[i] = 0;
            },
            [&](int64_t sum) {
                starts[tiles] = static_cast<int32_t>(sum);
                if (total != nullptr) *total = sum;
            });
        if (scales == nullptr) return;
        float* volumes = reinterpret_cast<float*>(s.sums[0]);
        int32_t* visible = reinterpret_cast<int32_t*>(s.sums[1]);
        threads.each([&](int t) {
            float sum = 0.0f;
            int32_t found = 0;
            for (int64_t i = t; i < rows; i += kThreads) {
                sum += scales[3 * i] * scales[3 * i + 1] * scales[3 * i + 2];
                found += opacities[i] > 0.0f;
            }
            volumes[t] = sum, visible[t] = found;
        });
        for (int half = kThreads / 2; half > 0; half /= 2)
            threads.each([&](int t) {
                if (t < half) volumes[t] += volumes[t + half], visible[t] += visible[t + half];
            });
        threads.each([&](int t) {
            if (t == 0) state->volume = volumes[0], state->visible = visible[0];
        });
    }
};

// Writes a splat into the lists of its tiles.
struct Scatter {
    const State* state;  // or null
    const Splat* splats;
    const uint8_t* drawn;
    int columns;
    int32_t* cursors;
    uint64_t* keys;

    SGS_LANES_FN void operator()(int64_t i) const {
        if (state != nullptr && state->stopped >= 0) return;
        const Splat& s = splats[i];
        for (int y = s.tiles[1]; y < s.tiles[3]; ++y)
            for (int x = s.tiles[0]; x < s.tiles[2]; ++x)
                if (drawn == nullptr || drawn[y * columns + x]) keys[add_to(cursors + y * columns + x, 1)] = sort_key(s.depth, i);
    }
};

constexpr int kSortThreads = 256, kSortShared = 4096;
struct SortShared {
    uint64_t keys[kSortShared];
};

// Ascending, in place: a bitonic network whose comparisons all go one way, so that keys beyond the end need no place.
SGS_LANES_FN void sort(uint64_t* keys, int count, const Threads& threads) {
    const auto compare = [&](int low, int high) {
        if (high < count && keys[low] > keys[high]) {
            const uint64_t key = keys[low];
            keys[low] = keys[high], keys[high] = key;
        }
    };
    int size = 1;
    while (size < count) size *= 2;
    for (int width = 2; width <= size; width *= 2) {
        threads.each([&](int t) {
            for (int n = t; n < size / 2; n += kSortThreads) {
                const int low = n / (width / 2) * width + n % (width / 2);
                compare(low, low ^ (width - 1));
            }
        });
        for (int half = width / 4; half > 0; half /= 2)
            threads.each([&](int t) {
                for (int n = t; n < size / 2; n += kSortThreads) {
                    const int low = n / half * 2 * half + n % half;
                    compare(low, low + half);
                }
            });
    }
}

// Number of keys below `key`, or up to it.
SGS_ELEMENT int below(const uint64_t* keys, int count, uint64_t key) {
    int low = 0, high = count;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (keys[middle] < key)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

// Sorts a tile's keys; merges them with those of static splats into rows (static ones from `rows` on).
struct Sort {
    static constexpr int kThreads = kSortThreads;
    using Shared = SortShared;
    const State* state;      // or null
    const uint8_t* drawn;
    const int32_t* starts;
    uint64_t* keys;
    const int32_t* static_starts;  // null: there are no static ones, and keys are sorted in place if merged is null, too
    const uint64_t* static_keys;
    int64_t rows;
    int32_t* merged;         // a tile's list begins at the sum of its two starts

    SGS_LANES_FN void operator()(int tile, Shared& s, const Threads& threads) const {
        if ((state != nullptr && state->stopped >= 0) || (drawn != nullptr && !drawn[tile])) return;
        const int start = starts[tile], count = starts[tile + 1] - start;
        const bool fits = count <= kSortShared;
        uint64_t* own = fits ? s.keys : keys + start;
        if (fits) threads.each([&](int t) {
            for (int i = t; i < count; i += kThreads) s.keys[i] = keys[start + i];
        });
        sort(own, count, threads);
        if (merged == nullptr) {
            if (fits) threads.each([&](int t) {
                for (int i = t; i < count; i += kThreads) keys[start + i] = s.keys[i];
            });
            return;
        }
        const int other_start = static_starts == nullptr ? 0 : static_starts[tile];
        const int other_count = static_starts == nullptr ? 0 : static_starts[tile + 1] - other_start;
        const uint64_t* others = static_keys + other_start;
        int32_t* out = merged + start + other_start;
        constexpr uint64_t kDepth = ~uint64_t{0} << 32, kRow = ~kDepth;
        threads.each([&](int t) {  // At equal depths static splats follow, since their rows do.
            for (int i = t; i < count; i += kThreads)
                out[i + below(others, other_count, own[i] & kDepth)] = static_cast<int32_t>(own[i] & kRow);
            for (int i = t; i < other_count; i += kThreads)
                out[i + below(own, count, others[i] | kRow)] = static_cast<int32_t>(rows + (others[i] & kRow));
        });
    }
};

}  // namespace fit
}  // namespace cuda
}  // namespace structgstream
