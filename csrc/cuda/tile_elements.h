// SPDX-License-Identifier: Apache-2.0
// Work of a thread for a Gaussian or for an entry of the tile lists; see kernels/cuda_tiles.py, Note [Pairs without
// waiting].
#pragma once

#include <cmath>

#include "element.h"

namespace structgstream {
namespace cuda {

// The tiles that a Gaussian's box reaches, inside the picture; none if it is not drawn.
struct Boxes {
    const float* means2d;
    const int32_t* radii;
    int columns, rows;

    struct Box {
        int64_t x0, y0, across, down;
    };

    SGS_ELEMENT static int64_t edge(float tile, int limit) {
        return static_cast<int64_t>(fminf(fmaxf(tile, 0.0f), static_cast<float>(limit)));
    }

    SGS_ELEMENT Box of(int64_t i) const {
        if (radii[2 * i] <= 0 || radii[2 * i + 1] <= 0) return {0, 0, 0, 0};
        const float x = means2d[2 * i] / kTilePixels, y = means2d[2 * i + 1] / kTilePixels;
        const float wide = static_cast<float>(radii[2 * i]) / kTilePixels;
        const float high = static_cast<float>(radii[2 * i + 1]) / kTilePixels;
        const int64_t x0 = edge(floorf(x - wide), columns), x1 = edge(ceilf(x + wide), columns);
        const int64_t y0 = edge(floorf(y - high), rows), y1 = edge(ceilf(y + high), rows);
        return {x0, y0, x1 - x0, y1 - y0};
    }
};

struct TileDepth {
    const int32_t* radii;
    const float* depths;
    float* keys;

    SGS_ELEMENT void operator()(int64_t i) const {
        keys[i] = radii[2 * i] > 0 && radii[2 * i + 1] > 0 ? depths[i] : INFINITY;
    }
};

struct TileCount {
    Boxes boxes;
    const int64_t* order;
    int64_t* pairs;

    SGS_ELEMENT void operator()(int64_t i) const {
        const Boxes::Box box = boxes.of(order[i]);
        pairs[i] = box.across * box.down;
    }
};

struct TileFill {
    Boxes boxes;
    const int64_t *order, *ends;
    int count;
    int32_t *tiles, *ids;

    SGS_ELEMENT void operator()(int64_t place) const {
        if (place >= ends[count - 1]) {
            // Unused entries are spread over the tiles below the picture, so that none has a long list.
            tiles[place] = static_cast<int32_t>(boxes.rows * boxes.columns + place % boxes.columns);
            ids[place] = static_cast<int32_t>(order[count - 1]);
            return;
        }
        int low = 0, high = count - 1;  // The first Gaussian whose pairs end after this place.
        while (low < high) {
            const int middle = (low + high) / 2;
            if (ends[middle] > place)
                high = middle;
            else
                low = middle + 1;
        }
        const Boxes::Box box = boxes.of(order[low]);
        const int64_t nth = place - (ends[low] - box.across * box.down);
        tiles[place] =
            static_cast<int32_t>((box.y0 + nth / box.across) * boxes.columns + box.x0 + nth % box.across);
        ids[place] = static_cast<int32_t>(order[low]);
    }
};

// The starts of the lists: each is written by the first entry of its tile, or of the next tile with an entry.
struct TileStart {
    const int32_t* sorted_tiles;
    const int64_t* by_tile;
    const int32_t* ids;
    int64_t capacity;
    int tile_count;
    int32_t *starts, *sorted_ids;

    SGS_ELEMENT void operator()(int64_t place) const {
        sorted_ids[place] = ids[by_tile[place]];
        const int tile = sorted_tiles[place], before = place == 0 ? -1 : sorted_tiles[place - 1];
        for (int t = before + 1; t <= tile; ++t) starts[t] = static_cast<int32_t>(place);
        if (place == capacity - 1)
            for (int t = tile + 1; t < tile_count; ++t) starts[t] = static_cast<int32_t>(capacity);
    }
};

// The larger radius of a Gaussian whose box contains a pixel centre of a tile, or no pixel centre at all.
struct TileReached {
    const float* means2d;
    const int32_t* radii;
    const uint8_t* mask;
    int size[2];
    float* drawn;

    static constexpr float kSlack = 0.01f;  // pixels, reference_raster.BOX_SLACK_PIXELS

    SGS_ELEMENT void operator()(int64_t i) const {
        const int32_t across = radii[2 * i], down = radii[2 * i + 1];
        drawn[i] = static_cast<float>(across > down ? across : down);
        int first[2], last[2];
        for (int axis = 0; axis < 2; ++axis) {
            const float center = means2d[2 * i + axis], reach = static_cast<float>(radii[2 * i + axis]);
            const float limit = static_cast<float>(size[axis]);
            const float low = ceilf(center - reach - 0.5f - kSlack), high = floorf(center + reach + 0.5f + kSlack);
            first[axis] = static_cast<int>(fminf(fmaxf(low, 0.0f), limit));
            last[axis] = static_cast<int>(fminf(fmaxf(high, 0.0f), limit));
            if (first[axis] >= last[axis]) return;
        }
        const int columns = (size[0] + kTilePixels - 1) / kTilePixels;
        for (int row = first[1] / kTilePixels; row <= (last[1] - 1) / kTilePixels; ++row)
            for (int column = first[0] / kTilePixels; column <= (last[0] - 1) / kTilePixels; ++column)
                if (mask[row * columns + column]) return;
        drawn[i] = 0.0f;
    }
};

}  // namespace cuda
}  // namespace structgstream
