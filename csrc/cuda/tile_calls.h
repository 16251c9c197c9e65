// SPDX-License-Identifier: Apache-2.0
// The interface of tiles.h, implemented with the elements of tile_elements.h. tiles.cu compiles it for a GPU,
// emulate_elements.cpp for a CPU.
#pragma once

#include "tile_elements.h"
#include "tiles.h"

int sgs_cuda_tile_depths(const int32_t* radii, const float* depths, int count, float* keys, void* stream) {
    using namespace structgstream::cuda;
    return for_each(TileDepth{radii, depths, keys}, count, stream);
}

int sgs_cuda_tile_counts(
    const float* means2d, const int32_t* radii, const int64_t* order, int count, int columns, int rows, int64_t* pairs,
    void* stream) {
    using namespace structgstream::cuda;
    return for_each(TileCount{{means2d, radii, columns, rows}, order, pairs}, count, stream);
}

int sgs_cuda_tile_fill(
    const float* means2d, const int32_t* radii, const int64_t* order, const int64_t* ends, int count, int columns,
    int rows, int64_t capacity, int32_t* tiles, int32_t* ids, void* stream) {
    using namespace structgstream::cuda;
    return for_each(TileFill{{means2d, radii, columns, rows}, order, ends, count, tiles, ids}, capacity, stream);
}

int sgs_cuda_tile_starts(
    const int32_t* sorted_tiles, const int64_t* by_tile, const int32_t* ids, int64_t capacity, int columns, int rows,
    int32_t* starts, int32_t* sorted_ids, void* stream) {
    using namespace structgstream::cuda;
    const TileStart start = {sorted_tiles, by_tile, ids, capacity, (rows + 1) * columns, starts, sorted_ids};
    return for_each(start, capacity, stream);
}

int sgs_cuda_tile_reached(
    const float* means2d, const int32_t* radii, int count, const uint8_t* mask, int width, int height, float* drawn,
    void* stream) {
    using namespace structgstream::cuda;
    return for_each(TileReached{means2d, radii, mask, {width, height}, drawn}, count, stream);
}
