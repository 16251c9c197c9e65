// SPDX-License-Identifier: Apache-2.0
// Depth order and tile lists: one radix sort by depth, then binning in that order, so each tile's list is front to back
// without a separate sort.

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

// Visits the tiles of a rectangle.
template <typename Visit>
inline void for_tiles(int tiles_x, const Tiles& t, Visit visit) {
    for (int y = t.y0; y <= t.y1; ++y)
        for (int tile = y * tiles_x + t.x0, end = y * tiles_x + t.x1; tile <= end; ++tile) visit(tile);
}

constexpr size_t kAhead = 8;
constexpr int kDigit = 11, kBuckets = 1 << kDigit, kPasses = 3;

// Sorts keys by their upper halves, which are bits of positive floats and so have their order; the lower ones break ties.
void sort_by_depth(std::vector<uint64_t>& keys) {
    size_t counts[kPasses][kBuckets + 1] = {};
    for (uint64_t key : keys)
        for (int pass = 0; pass < kPasses; ++pass) ++counts[pass][(key >> (32 + kDigit * pass) & (kBuckets - 1)) + 1];
    std::vector<uint64_t> other(keys.size());
    for (int pass = 0; pass < kPasses; ++pass) {
        size_t* next = counts[pass];
        for (int b = 0; b < kBuckets; ++b) next[b + 1] += next[b];
        for (uint64_t key : keys) other[next[key >> (32 + kDigit * pass) & (kBuckets - 1)]++] = key;
        keys.swap(other);
    }
}

}  // namespace

void bin(Raster& raster) {
    const int tiles = raster.tiles_x * raster.tiles_y, tiles_x = raster.tiles_x;
    // Tiles that are not drawn are visited, too, and add nothing: whether one is drawn is hardly predictable.
    const std::vector<uint8_t> all(raster.drawn_tiles.empty() ? tiles : 0, 1);
    const uint8_t* drawn = all.empty() ? raster.drawn_tiles.data() : all.data();
    raster.starts.assign(tiles + 1, 0);
    raster.slots.resize(raster.splats.size() + 1);
    raster.slots[0] = 0;
    // Small entries of what is drawn instead of whole splats, because the following steps are bound by memory.
    std::vector<Entry> entries;
    std::vector<uint64_t> keys;
    entries.reserve(raster.splats.size()), keys.reserve(raster.splats.size());
    int64_t total = 0;
    for (size_t i = 0; i < raster.splats.size(); ++i) {
        const Splat& s = raster.splats[i];
        if (s.box[0] < s.box[2]) {
            const Tiles t = tiles_of(s);
            uint32_t depth;
            std::memcpy(&depth, &s.depth, sizeof depth);
            keys.push_back(static_cast<uint64_t>(depth) << 32 | entries.size());
            entries.push_back({static_cast<int32_t>(i), static_cast<int32_t>(total), t});
            int32_t* counts = raster.starts.data() + 1;
            for_tiles(tiles_x, t, [&](int tile) { total += drawn[tile], counts[tile] += drawn[tile]; });
            if (total > std::numeric_limits<int32_t>::max()) throw std::bad_alloc();  // gradients would need 80 GB
        }
        raster.slots[i + 1] = static_cast<int32_t>(total);
    }
    for (int t = 0; t < tiles; ++t) raster.starts[t + 1] += raster.starts[t];
    sort_by_depth(keys);
    raster.pairs.resize(raster.starts[tiles] + 1);  // the last one takes those of tiles that are not drawn
    std::vector<int32_t> next(raster.starts.begin(), raster.starts.end() - 1);
    for (int t = 0; t < tiles; ++t)
        if (!drawn[t]) next[t] = raster.starts[tiles];
    Pair* pairs = raster.pairs.data();
    int32_t* places = next.data();
    for (size_t i = 0; i < keys.size(); ++i) {
        __builtin_prefetch(&entries[keys[std::min(i + kAhead, keys.size() - 1)] & 0xffffffffu]);
        const Entry& e = entries[keys[i] & 0xffffffffu];
        int32_t slot = e.slot;
        for_tiles(tiles_x, e.tiles, [&](int tile) {
            pairs[places[tile]] = {e.splat, slot};
            places[tile] += drawn[tile], slot += drawn[tile];
        });
    }
}

}  // namespace structgstream
