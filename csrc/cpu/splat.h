// SPDX-License-Identifier: Apache-2.0
// Types of the rasteriser's stages: projected splats, tiles, and the state that forward stores for backward.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

namespace structgstream {

constexpr int kTile = 16;                          // pixels
constexpr float kLowPass = 0.3f;                   // square pixels: reference_raster.LOW_PASS_PIXELS
constexpr float kScreenLowPass = 0.15f;            // reference_raster.SCREEN_LOW_PASS_PIXELS
constexpr float kMinAlpha = 1.0f / 255.0f;
constexpr float kMaxAlpha = 0.999f;
constexpr float kMinTransmittance = 1e-4f;
constexpr float kMinGradientTransmittance = 1.0f / 255.0f;
constexpr float kLog2MinAlpha = -7.99435344f;      // log2(1 / 255)

struct Pinhole {
    float view[12];            // world to camera, three rows of four
    float fx, fy, cx, cy;
    float left, right, up, down;  // clamp of x / z and y / z where the projection is linearised
    float near;
    int width, height;
};

// alpha = 2^(log2_opacity - (xx dx^2 + xy dx dy + yy dy^2)), the conic scaled by log2(e) / 2 (xy by log2(e)).
struct alignas(64) Splat {
    Splat() {}                 // not set to zero: of one that is not drawn only the box is written, and only that counts
    float x, y;
    float xx, xy, yy;
    float log2_opacity;
    float color[3];
    float depth;
    float near_block;          // the quadratic form at the centre of a block of pixels that reach alpha = 1/255 is at most this
    int32_t box[4];            // pixels x0, y0, x1, y1 (half open) that can reach alpha = 1/255
};

// A splat and a tile that it may cover. A slot depends only on the two, so gradients are summed in the same order for any
// number of threads.
struct Pair {
    int32_t splat;
    int32_t slot;
    Pair() {}  // as Splat
    Pair(int32_t splat, int32_t slot) : splat(splat), slot(slot) {}
};

struct Raster {
    Pinhole camera;
    int tiles_x, tiles_y;
    std::vector<uint8_t> drawn_tiles; // [tiles_y * tiles_x], 1 where something is drawn, else 0; empty: all are
    int64_t trained;                  // splats from here on get no gradient
    std::vector<Splat> splats;        // [N]; box empty where not drawn
    std::vector<int32_t> starts;      // [tiles + 1] into pairs
    std::vector<Pair> pairs;          // by tile, front to back
    std::vector<int32_t> slots;       // [N + 1] first pair slot of each splat, for the fixed order of sums

    // Always inlined: a copy shared between instruction sets could contain instructions that a processor lacks.
    [[gnu::always_inline]] bool draws(int tile) const { return drawn_tiles.empty() || drawn_tiles[tile] != 0; }
};

struct GaussianInputs {
    const float* means;
    const float* quats;
    const float* scales;
    const float* opacities;
    const float* colors;
    const float* screen_offsets;  // or null
    const float* intervals;       // size of a training pixel at each, or null: the low-pass is that of the picture
    int64_t count;
};

struct GaussianGradients {
    float* means;
    float* quats;
    float* scales;
    float* opacities;
    float* colors;
    float* screen_offsets;  // or null
};

// Moments of dL/dpower over the pixels of a pair (1, dx, dy, dx^2, dx dy, dy^2) and dL/dcolor.
constexpr int kMomentCount = 9;

}  // namespace structgstream
