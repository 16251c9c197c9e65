// SPDX-License-Identifier: Apache-2.0
// Depth order and tile lists. One radix sort by depth, then binning in that order: each tile's list is front to back
// without a sort of its own.

#include <algorithm>
#include <cstring>
#include <limits>
#include <new>

#include "bin.h"

namespace structgstream {
namespace {

struct Tiles {
    uint16_t x0, y0, x1, y1;  // the last ones included
};

struct Entry {
    int32_t splat;
    int32_t slot;
    Tiles tiles;
};

Tiles tiles_of(const Splat& s) {
    const auto tile = [](int pixel) { return static_cast<uint16_t>(pixel / kTile); };
    return {tile(s.box[0]), tile(s.box[1]), tile(s.box[2] - 1), tile(s.box[3] - 1)};
}

// The drawn splats front to back. Positive floats order as their bits do; the index breaks ties, so the order is total.
std::vector<uint64_t> by_depth(const std::vector<Splat>& splats) {
    constexpr int kDigit = 11, kBuckets = 1 << kDigit, kPasses = 3;
    std::vector<uint64_t> keys, other;
    keys.reserve(splats.size());
    size_t counts[kPasses][kBuckets + 1] = {};
    for (size_t i = 0; i < splats.size(); ++i) {
        if (splats[i].box[0] >= splats[i].box[2]) continue;
        uint32_t bits;
        std::memcpy(&bits, &splats[i].depth, sizeof bits);
        keys.push_back(static_cast<uint64_t>(bits) << 32 | i);
        for (int pass = 0; pass < kPasses; ++pass) ++counts[pass][(bits >> kDigit * pass & (kBuckets - 1)) + 1];
    }
    other.resize(keys.size());
    for (int pass = 0; pass < kPasses; ++pass) {
        size_t* next = counts[pass];
        for (int b = 0; b < kBuckets; ++b) next[b + 1] += next[b];
        for (uint64_t key : keys) other[next[key >> (32 + kDigit * pass) & (kBuckets - 1)]++] = key;
        keys.swap(other);
    }
    return keys;
}

constexpr Tiles kNoTiles = {1, 1, 0, 0};

// The part of a box in a band of rows of tiles.
template <typename Visit>
inline void for_tiles(const Raster& raster, const Tiles& t, int first_row, int end_row, Visit visit) {
    for (int y = std::max<int>(t.y0, first_row); y <= std::min<int>(t.y1, end_row - 1); ++y)
        for (int x = t.x0; x <= t.x1; ++x)
            if (raster.draws(y * raster.tiles_x + x)) visit(y * raster.tiles_x + x);
}

}  // namespace

// Each thread owns a band of rows of tiles and passes over all splats: what it writes, nobody else does.
void bin(Raster& raster, int threads) {
    const int tiles = raster.tiles_x * raster.tiles_y, bands = std::max(1, std::min(threads, raster.tiles_y));
    const auto band_begin = [&](int band) { return raster.tiles_y * band / bands; };
    const int64_t count = static_cast<int64_t>(raster.splats.size());
    std::vector<Tiles> rectangles(count);
    raster.starts.assign(tiles + 1, 0);
    raster.slots.assign(count + 1, 0);
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
    for (int64_t i = 0; i < count; ++i) {
        const Splat& s = raster.splats[i];
        rectangles[i] = s.box[0] < s.box[2] ? tiles_of(s) : kNoTiles;
        int32_t pairs = 0;
        for_tiles(raster, rectangles[i], 0, raster.tiles_y, [&](int) { ++pairs; });
        raster.slots[i + 1] = pairs;
    }
    int64_t total = 0;
    for (int64_t i = 0; i < count; ++i) {
        total += raster.slots[i + 1];
        if (total > std::numeric_limits<int32_t>::max()) throw std::bad_alloc();  // 80 GB of gradients, anyway
        raster.slots[i + 1] = static_cast<int32_t>(total);
    }
#pragma omp parallel for num_threads(bands) schedule(static, 1) if (bands > 1)
    for (int band = 0; band < bands; ++band)
        for (const Tiles& t : rectangles)
            for_tiles(raster, t, band_begin(band), band_begin(band + 1), [&](int tile) { ++raster.starts[tile + 1]; });
    for (int t = 0; t < tiles; ++t) raster.starts[t + 1] += raster.starts[t];
    // Once in order of depth, small entries instead of whole splats: what follows is bound by memory.
    const std::vector<uint64_t> keys = by_depth(raster.splats);
    std::vector<Entry> order(keys.size());
    const int64_t drawn = static_cast<int64_t>(keys.size());
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
    for (int64_t i = 0; i < drawn; ++i) {
        const int32_t splat = static_cast<int32_t>(keys[i] & 0xffffffffu);
        order[i] = {splat, raster.slots[splat], rectangles[splat]};
    }
    raster.pairs.resize(raster.starts[tiles]);
    raster.pair_slots.resize(raster.starts[tiles]);
    std::vector<int32_t> next(raster.starts.begin(), raster.starts.end() - 1);
#pragma omp parallel for num_threads(bands) schedule(static, 1) if (bands > 1)
    for (int band = 0; band < bands; ++band)
        for (const Entry& e : order) {
            int32_t slot = e.slot;
            for_tiles(raster, e.tiles, 0, band_begin(band), [&](int) { ++slot; });  // those of the bands before
            for_tiles(raster, e.tiles, band_begin(band), band_begin(band + 1), [&](int tile) {
                const int32_t at = next[tile]++;
                raster.pairs[at] = e.splat;
                raster.pair_slots[at] = slot++;
            });
        }
}

}  // namespace structgstream
