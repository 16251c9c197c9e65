// SPDX-License-Identifier: Apache-2.0
// Drawing tiles and the gradient back to their splats. A block is a tile, a warp 8 x 4 of its pixels; splats pass through
// shared memory in batches. The formulas are those of csrc/cpu/raster.cpp.
#pragma once

#include <cmath>
#include <cstdint>

#include "block.h"
#include "fit_lists.h"

namespace structgstream {
namespace cuda {
namespace fit {

constexpr int kBatch = 64;  // splats
constexpr int kRasterThreads = 256, kWarps = kRasterThreads / kLanes;
constexpr float kMinTransmittance = 1e-4f, kMinGradientTransmittance = 1.0f / 255.0f;

// Transmittance of a warp's pixels, with a minus sign where a pixel has stopped.
struct Front {
    vf T;
    bool live;
};

// Whether a splat may cover the block around a centre. The rounding error of the quadratic form is in proportion to its
// squares; a share of these is slack.
SGS_LANES_FN bool near_block(const Splat& s, float x, float y) {
    constexpr float kSlack = 1.0f - 1e-5f;
    const float dx = x - s.x, dy = y - s.y;
    return s.reach >= dx * dx * (s.xx * kSlack) + dy * (dy * (s.yy * kSlack) + dx * s.xy);
}

struct Coverage {
    vf dx, dy, alpha;
    mask used;
};

// Whether any pixel above `least` is covered; the front is then behind the splat.
SGS_LANES_FN bool cover(const Splat& s, vf px, vf py, Front& f, float least, Coverage& c) {
    c.dx = px - splat(s.x), c.dy = py - splat(s.y);
    const vf power =
        splat(s.log2_opacity) - (c.dx * (c.dx * splat(s.xx) + c.dy * splat(s.xy)) + c.dy * c.dy * splat(s.yy));
    c.used = both(at_least(power, splat(kLog2MinAlpha)), above(f.T, splat(least)));
    if (!any(c.used)) return false;
    c.alpha = keep(c.used, smallest(power_of_two(power), splat(kMaxAlpha)));
    const vf after = f.T * (splat(1.0f) - c.alpha);
    const mask stopped = both(c.used, at_least(splat(kMinTransmittance), after));
    c.alpha = keep(without(c.used, stopped), c.alpha);
    f.T = choose(stopped, splat(0.0f) - f.T, after);
    return true;
}

// The tiles of a picture and their lists.
struct Tiles {
    const State* state;    // or null
    const uint8_t* drawn;  // or null: all are
    int columns, width, height;
    int64_t rows;                     // dynamic ones, whose splats are the first
    const Splat *splats, *static_splats;
    const int32_t *starts, *static_starts, *merged;  // static_starts null: no static splats
    const float* background;          // or null

    SGS_ELEMENT bool skips(int tile) const {
        return (state != nullptr && state->stopped >= 0) || (drawn != nullptr && !drawn[tile]);
    }
    SGS_ELEMENT int begin(int tile) const {
        return starts[tile] + (static_starts == nullptr ? 0 : static_starts[tile]);
    }
    SGS_ELEMENT const Splat& of(int32_t row) const { return row < rows ? splats[row] : static_splats[row - rows]; }
    SGS_ELEMENT float left(int tile, int warp) const {
        return static_cast<float>(tile % columns * kTilePixels + warp % 2 * kBlockX);
    }
    SGS_ELEMENT float top(int tile, int warp) const {
        return static_cast<float>(tile / columns * kTilePixels + warp / 2 * kBlockY);
    }
    // Calls visit(lane, index of the pixel) for the lanes whose pixel is in the picture.
    template <typename Visit>
    SGS_LANES_FN void each_pixel(int tile, int warp, const Visit& visit) const {
        const int first_x = static_cast<int>(left(tile, warp)), first_y = static_cast<int>(top(tile, warp));
        each_lane([&](int l) {
            const int x = first_x + l % kBlockX, y = first_y + l / kBlockX;
            if (x < width && y < height) visit(l, static_cast<int64_t>(y) * width + x);
        });
    }
    // Splats of entries from ... to, in shared memory.
    SGS_LANES_FN void read(int from, int count, Splat* batch, int t) const {
        for (int i = t; i < count; i += kRasterThreads) batch[i] = of(merged[from + i]);
    }
};

// Calls visit(index in the batch, splat) for the splats that may cover the block at left, top, as long as it is live.
template <typename Visit>
SGS_LANES_FN void each_near(
    const Splat* batch, int count, float left, float top, const Front& f, const Visit& visit) {
    for (int first = 0; first < count && f.live; first += kLanes) {
        uint32_t rest = ballot([&](int i) {
            return first + i < count && near_block(batch[first + i], left + 0.5f * kBlockX, top + 0.5f * kBlockY);
        });
        for (; rest != 0 && f.live; rest &= rest - 1) {
            const int n = first + lowest(rest);
            visit(n, batch[n]);
        }
    }
}

struct Draw {
    static constexpr int kThreads = kRasterThreads;
    struct Shared {
        Splat batch[kBatch];
    };
    struct Warp {
        Front front;
        vf color[3];
    };
    Tiles tiles;
    float *image, *transmittance;

    SGS_LANES_FN void operator()(int tile, Shared& s, const Threads& threads) const {
        if (tiles.skips(tile)) return;
        OfWarp<Warp, kWarps> warps;
        threads.warps([&](int w) {
            warps[w].front = {splat(1.0f), true};
            for (int k = 0; k < 3; ++k) warps[w].color[k] = splat(0.0f);
        });
        const int end = tiles.begin(tile + 1);
        for (int at = tiles.begin(tile); at < end; at += kBatch) {
            if (!threads.any_warp([&](int w) { return warps[w].front.live; })) break;
            const int count = end - at < kBatch ? end - at : kBatch;
            threads.each([&](int t) { tiles.read(at, count, s.batch, t); });
            threads.warps([&](int w) {
                Warp& warp = warps[w];
                const float left = tiles.left(tile, w), top = tiles.top(tile, w);
                const vf px = lanes_x() + splat(left), py = lanes_y() + splat(top);
                each_near(s.batch, count, left, top, warp.front, [&](int, const Splat& splatted) {
                    const vf before = warp.front.T;
                    Coverage c;
                    if (!cover(splatted, px, py, warp.front, 0.0f, c)) return;
                    const vf weight = c.alpha * before;
                    for (int k = 0; k < 3; ++k) warp.color[k] += weight * splat(splatted.color[k]);
                    warp.front.live = any(above(warp.front.T, splat(0.0f)));
                });
            });
        }
        threads.warps([&](int w) {
            tiles.each_pixel(tile, w, [&](int l, int64_t pixel) {
                const float rest = fabsf(value_of(warps[w].front.T, l));
                transmittance[pixel] = rest;
                for (int k = 0; k < 3; ++k)
                    image[3 * pixel + k] = value_of(warps[w].color[k], l) +
                                           (tiles.background == nullptr ? 0.0f : rest * tiles.background[k]);
            });
        });
    }
};

// Sums over the pixels of a pair of a splat and a tile: shared memory of a tile.
template <int kCount>
struct PairShared {
    Splat batch[kBatch];
    int32_t slots[kBatch];  // -1 for a static splat
    float sums[kWarps][kBatch * kCount];
};

// For each splat that covers pixels of a warp above the least transmittance with a gradient, front to back,
// values(warp, splat, coverage, transmittance before it, m) sets m[kCount] of the lanes; store(slot, k, total) gets their sums
// over the tile for each dynamic splat. slots: of each row, the first one.
template <int kCount, typename Warp, typename Values, typename Store>
SGS_LANES_FN void sum_pairs(
    const Tiles& tiles, const int32_t* slots, int tile, PairShared<kCount>& s, const Threads& threads,
    OfWarp<Warp, kWarps>& warps, const Values& values, const Store& store) {
    const int end = tiles.begin(tile + 1);
    for (int at = tiles.begin(tile); at < end; at += kBatch) {
        const bool live = threads.any_warp([&](int w) { return warps[w].front.live; });
        const int count = end - at < kBatch ? end - at : kBatch;
        threads.each([&](int t) {
            tiles.read(at, count, s.batch, t);
            for (int i = t; i < count; i += kRasterThreads) {
                const int32_t row = tiles.merged[at + i];
                s.slots[i] = row < tiles.rows ? slots[row] + slot_in(tiles.splats[row], tile, tiles.columns) : -1;
            }
            for (int i = t; i < kWarps * kBatch * kCount; i += kRasterThreads) (&s.sums[0][0])[i] = 0.0f;
        });
        if (live) threads.warps([&](int w) {
            Warp& warp = warps[w];
            const float left = tiles.left(tile, w), top = tiles.top(tile, w);
            const vf px = lanes_x() + splat(left), py = lanes_y() + splat(top);
            each_near(s.batch, count, left, top, warp.front, [&](int n, const Splat& splatted) {
                const vf before = warp.front.T;
                Coverage c;
                if (!cover(splatted, px, py, warp.front, kMinGradientTransmittance, c)) return;
                warp.front.live = any(above(warp.front.T, splat(kMinGradientTransmittance)));
                vf m[kCount];
                values(warp, splatted, c, before, m);
                if (s.slots[n] >= 0) store_sums<kCount>(m, s.sums[w] + n * kCount);
            });
        });
        threads.each([&](int t) {
            for (int i = t; i < count * kCount; i += kRasterThreads) {
                if (s.slots[i / kCount] < 0) continue;
                float total = 0.0f;
                for (int w = 0; w < kWarps; ++w) total += s.sums[w][i];
                store(static_cast<int64_t>(s.slots[i / kCount]), i % kCount, total);
            }
        });
    }
}

// Moments of each pair of a dynamic splat and a tile, in the splat's slot of the tile.
struct DrawBackward {
    static constexpr int kThreads = kRasterThreads;
    using Shared = PairShared<kMoments>;
    struct Warp {
        Front front;
        vf gradient[3], coverage_gradient, rest;
    };
    Tiles tiles;
    const int32_t* slots;
    const float *image, *transmittance, *gradient, *alpha_gradient;  // the last one or null
    float* moments;

    SGS_LANES_FN void begin(int tile, int w, Warp& warp) const {
        const float* back = tiles.background;
        warp.front = {splat(0.0f), false};
        for (int k = 0; k < 3; ++k) warp.gradient[k] = splat(0.0f);
        warp.coverage_gradient = warp.rest = splat(0.0f);
        tiles.each_pixel(tile, w, [&](int l, int64_t pixel) {
            const float T = transmittance[pixel];
            float coverage = alpha_gradient == nullptr ? 0.0f : alpha_gradient[pixel], rest = 0.0f;
            for (int k = 0; k < 3; ++k) {
                const float g = gradient[3 * pixel + k], behind = back == nullptr ? 0.0f : back[k];
                set(warp.gradient[k], l, g);
                coverage -= behind * g;
                rest += (image[3 * pixel + k] - behind * T) * g;
            }
            set(warp.front.T, l, 1.0f);
            set(warp.coverage_gradient, l, coverage);
            set(warp.rest, l, rest + (1.0f - T) * coverage);
        });
        warp.front.live = any(above(warp.front.T, splat(kMinGradientTransmittance)));
    }

    SGS_LANES_FN void operator()(int tile, Shared& s, const Threads& threads) const {
        if (tiles.skips(tile)) return;
        OfWarp<Warp, kWarps> warps;
        threads.warps([&](int w) { begin(tile, w, warps[w]); });
        const auto values = [](Warp& warp, const Splat& splatted, const Coverage& c, vf before, vf(&m)[kMoments]) {
            const vf weight = c.alpha * before;
            vf q = warp.coverage_gradient;
            for (int k = 0; k < 3; ++k) q += warp.gradient[k] * splat(splatted.color[k]);
            warp.rest = warp.rest - weight * q;
            const vf slope = before * q - warp.rest * reciprocal(splat(1.0f) - c.alpha);
            // A clamped alpha has no gradient.
            const vf d = keep(above(splat(kMaxAlpha), c.alpha), slope * c.alpha);
            const vf dx = d * c.dx, dy = d * c.dy;
            m[0] = d, m[1] = dx, m[2] = dy, m[3] = dx * c.dx, m[4] = dx * c.dy, m[5] = dy * c.dy;
            for (int k = 0; k < 3; ++k) m[6 + k] = weight * warp.gradient[k];
        };
        sum_pairs<kMoments>(tiles, slots, tile, s, threads, warps, values, [&](int64_t slot, int k, float total) {
            moments[slot * kMoments + k] = total;
        });
    }
};

}  // namespace fit
}  // namespace cuda
}  // namespace structgstream
