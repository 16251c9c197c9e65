// SPDX-License-Identifier: Apache-2.0
// Depth order and tile lists. One radix sort by depth, then binning in that order: each tile's list is front to back
// without a sort of its own.

#include <cstring>

#include "bin.h"

namespace structgstream {
namespace {

// Positive floats order as their bits do; the index breaks ties, so the order is total.
std::vector<int32_t> by_depth(const std::vector<Splat>& splats) {
    std::vector<uint64_t> keys, other;
    keys.reserve(splats.size());
    for (size_t i = 0; i < splats.size(); ++i) {
        if (splats[i].box[0] >= splats[i].box[2]) continue;
        uint32_t bits;
        std::memcpy(&bits, &splats[i].depth, sizeof bits);
        keys.push_back(static_cast<uint64_t>(bits) << 32 | i);
    }
    other.resize(keys.size());
    constexpr int kDigit = 11, kBuckets = 1 << kDigit;
    for (int pass = 0; pass < 3; ++pass) {
        const int shift = 32 + kDigit * pass;
        size_t counts[kBuckets + 1] = {};
        for (uint64_t key : keys) ++counts[(key >> shift & (kBuckets - 1)) + 1];
        for (int b = 0; b < kBuckets; ++b) counts[b + 1] += counts[b];
        for (uint64_t key : keys) other[counts[key >> shift & (kBuckets - 1)]++] = key;
        keys.swap(other);
    }
    std::vector<int32_t> order(keys.size());
    for (size_t i = 0; i < keys.size(); ++i) order[i] = static_cast<int32_t>(keys[i] & 0xffffffffu);
    return order;
}

}  // namespace

void bin(Raster& raster) {
    const int tiles = raster.tiles_x * raster.tiles_y;
    raster.starts.assign(tiles + 1, 0);
    raster.slots.assign(raster.splats.size() + 1, 0);
    const auto columns = [](const Splat& s) { return (s.box[2] - 1) / kTile - s.box[0] / kTile + 1; };
    const auto rows = [](const Splat& s) { return (s.box[3] - 1) / kTile - s.box[1] / kTile + 1; };
    for (size_t i = 0; i < raster.splats.size(); ++i) {
        const Splat& s = raster.splats[i];
        const bool drawn = s.box[0] < s.box[2];
        raster.slots[i + 1] = raster.slots[i] + (drawn ? columns(s) * rows(s) : 0);
    }
    const std::vector<int32_t> order = by_depth(raster.splats);
    for (int32_t i : order) {
        const int32_t* box = raster.splats[i].box;
        for (int y = box[1] / kTile; y <= (box[3] - 1) / kTile; ++y)
            for (int x = box[0] / kTile; x <= (box[2] - 1) / kTile; ++x) ++raster.starts[y * raster.tiles_x + x + 1];
    }
    for (int t = 0; t < tiles; ++t) raster.starts[t + 1] += raster.starts[t];
    raster.pairs.resize(raster.starts[tiles]);
    raster.pair_slots.resize(raster.starts[tiles]);
    std::vector<int32_t> next(raster.starts.begin(), raster.starts.end() - 1);
    for (int32_t i : order) {
        const int32_t* box = raster.splats[i].box;
        int32_t slot = raster.slots[i];
        for (int y = box[1] / kTile; y <= (box[3] - 1) / kTile; ++y)
            for (int x = box[0] / kTile; x <= (box[2] - 1) / kTile; ++x) {
                const int32_t at = next[y * raster.tiles_x + x]++;
                raster.pairs[at] = i;
                raster.pair_slots[at] = slot++;
            }
    }
}

}  // namespace structgstream
