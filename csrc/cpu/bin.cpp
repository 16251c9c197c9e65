// SPDX-License-Identifier: Apache-2.0
// Depth order and tile lists: one radix sort by depth, then binning in that order, so each tile's list is front to back
// without a separate sort.

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

// The drawn splats front to back. Positive floats have the order of their bits; the index breaks ties.
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

}  // namespace

void bin(Raster& raster) {
    const int tiles = raster.tiles_x * raster.tiles_y;
    raster.starts.assign(tiles + 1, 0);
    raster.slots.assign(raster.splats.size() + 1, 0);
    int64_t total = 0;
    for (size_t i = 0; i < raster.splats.size(); ++i) {
        const Splat& s = raster.splats[i];
        if (s.box[0] < s.box[2]) {
            const Tiles t = tiles_of(s);
            for (int y = t.y0; y <= t.y1; ++y)
                for (int x = t.x0; x <= t.x1; ++x) {
                    const int tile = y * raster.tiles_x + x;
                    if (raster.draws(tile)) ++total, ++raster.starts[tile + 1];
                }
            if (total > std::numeric_limits<int32_t>::max()) throw std::bad_alloc();  // gradients would need 80 GB
        }
        raster.slots[i + 1] = static_cast<int32_t>(total);
    }
    for (int t = 0; t < tiles; ++t) raster.starts[t + 1] += raster.starts[t];
    // Small entries in depth order instead of whole splats, because the following steps are bound by memory.
    const std::vector<uint64_t> keys = by_depth(raster.splats);
    std::vector<Entry> order(keys.size());
    for (size_t i = 0; i < keys.size(); ++i) {
        const int32_t splat = static_cast<int32_t>(keys[i] & 0xffffffffu);
        order[i] = {splat, raster.slots[splat], tiles_of(raster.splats[splat])};
    }
    raster.pairs.resize(raster.starts[tiles]);
    raster.pair_slots.resize(raster.starts[tiles]);
    std::vector<int32_t> next(raster.starts.begin(), raster.starts.end() - 1);
    for (const Entry& e : order) {
        int32_t slot = e.slot;
        for (int y = e.tiles.y0; y <= e.tiles.y1; ++y)
            for (int x = e.tiles.x0; x <= e.tiles.x1; ++x) {
                const int tile = y * raster.tiles_x + x;
                if (!raster.draws(tile)) continue;
                const int32_t at = next[tile]++;
                raster.pairs[at] = e.splat;
                raster.pair_slots[at] = slot++;
            }
    }
}

}  // namespace structgstream
