// SPDX-License-Identifier: Apache-2.0
// Blending splats over tiles, forward and backward.
//
// A vector is a small block of pixels (4 x 4, 4 x 2 or 2 x 2). Backward repeats forward front to back. It maintains R, the
// remaining colour of the pixel behind the splat, dotted with the pixel's gradient. Then
// dL/dalpha = T q - R / (1 - alpha) with q = color . gradient, so only the finished image is needed. A splat behind a
// transmittance below kMinGradientTransmittance gets neither gradient nor weight from the pixel. It is drawn
// nevertheless, because otherwise opaque surfaces would be visibly incomplete.

#include <algorithm>
#include <cstring>

#include "block.h"
#include "mask.h"
#include "splat.h"
#include "vec.h"

namespace structgstream {
namespace SGS_ISA {
namespace {

constexpr int kAhead = 4;  // splats
constexpr int kMapsAtOnce = 8;

// The sums over the lanes of each of `Count` vectors, computed together if there are as many lanes.
template <int Count>
inline void store_sums(const vf (&m)[Count], float* out) {
    constexpr int kGroups = (Count + kLanes - 1) / kLanes;
    float sums[kGroups * kLanes];
#pragma GCC unroll 4
    for (int g = 0; g < kGroups; ++g) {
        vf rows[kLanes];
#pragma GCC unroll 16
        for (int i = 0; i < kLanes; ++i) rows[i] = g * kLanes + i < Count ? m[g * kLanes + i] : splat(0.0f);
        store(sums + g * kLanes, sums_of_lanes(rows));
    }
    std::memcpy(out, sums, sizeof(float) * Count);
}

// 2^x for x in [-8, 0.1]: integer part by rounding, fraction by a polynomial fitted around zero.
inline vf power_of_two(vf x) {
    const vf magic = splat(12582912.0f);
    const vf rounded = x + magic;
    const vf f = x - (rounded - magic);
    vf p = splat(1.54035304e-4f);
    p = p * f + 1.33335581e-3f;
    p = p * f + 9.61812911e-3f;
    p = p * f + 5.55041087e-2f;
    p = p * f + 2.40226507e-1f;
    p = p * f + 6.93147181e-1f;
    p = p * f + 1.0f;
    return (vf)((vi)p + ((vi)rounded << 23));
}

struct Lanes {
    vf x, y;  // pixel centres within a block
    Lanes() {
        for (int i = 0; i < kLanes; ++i) x[i] = i % kBlockX + 0.5f, y[i] = i / kBlockX + 0.5f;
    }
};

// The centres of a tile's blocks, lane by lane.
struct BlockCentres {
    static constexpr int kVectors = kBlocks / kLanes, kRows = kLanes / kBlocksX;
    vf x, y;
    BlockCentres() {
        for (int i = 0; i < kLanes; ++i)
            x[i] = (i % kBlocksX + 0.5f) * kBlockX, y[i] = (i / kBlocksX + 0.5f) * kBlockY;
    }
};

// A bit for each block of a tile that a splat may cover: by its ellipse if few vectors contain all blocks, else by its
// box. The rounding error of the quadratic form is in proportion to its two squares; a share of these is added as slack.
inline uint64_t near_blocks(const Splat& s, const BlockCentres& centres, int left, int top) {
    uint64_t found = 0;
#if SGS_LANES > 4
    const vf dx = centres.x + (left - s.x), first_dy = centres.y + (top - s.y);
    const vf along_x = dx * dx * (s.xx * (1.0f - 1e-5f)), mixed = dx * s.xy;
    const float yy = s.yy * (1.0f - 1e-5f);
#pragma GCC unroll 4
    for (int v = 0; v < BlockCentres::kVectors; ++v) {
        const vf dy = first_dy + static_cast<float>(v * BlockCentres::kRows * kBlockY);
        const mask near = at_least(splat(s.near_block), along_x + dy * (dy * yy + mixed));
        found |= uint64_t{bits(near)} << (v * kLanes);
    }
#else
    const int x0 = std::max(0, s.box[0] - left) / kBlockX;
    const int x1 = (std::min(kTile, s.box[2] - left) + kBlockX - 1) / kBlockX;
    const int y0 = std::max(0, s.box[1] - top) / kBlockY;
    const int y1 = (std::min(kTile, s.box[3] - top) + kBlockY - 1) / kBlockY;
    const uint64_t row = ((uint64_t{1} << (x1 - x0)) - 1) << x0;
    for (int y = y0; y < y1; ++y) found |= row << (y * kBlocksX);
#endif
    return found;
}

// One splat over one block of pixels whose transmittance is T. T above `least`, zero or more, is live; a pixel that has
// stopped stores its transmittance with a minus sign.
struct Coverage {
    vf dx, dy, alpha, after;  // after: the transmittance behind the splat, valid for live pixels
    mask used, stopped;
    bool any_stopped;

    [[gnu::always_inline]] bool of(const Splat& s, const Lanes& lanes, float left, float top, vf T, float least) {
        dx = lanes.x + (left - s.x), dy = lanes.y + (top - s.y);
        const vf power = s.log2_opacity - (dx * (dx * s.xx + dy * s.xy) + dy * dy * s.yy);
        used = both(at_least(power, splat(kLog2MinAlpha)), above(T, splat(least)));
        if (!any(used)) return false;
        alpha = keep(used, smallest(power_of_two(power), splat(kMaxAlpha)));
        after = T * (1.0f - alpha);
        stopped = both(used, at_least(splat(kMinTransmittance), after));
        any_stopped = any(stopped);
        if (any_stopped) {
            alpha = keep(without(used, stopped), alpha);
            after = choose(stopped, -T, after);
        }
        return true;
    }
};

// Transmittance of each pixel of a tile. The bit of a block without a live pixel in `live` is cleared.
struct Front {
    alignas(kAlignment) float T[kTilePixels];
    uint64_t live = ~uint64_t{0} >> (64 - kBlocks);
    const float least;
    explicit Front(float least = 0.0f) : least(least) {
        for (float& t : T) t = 1.0f;
    }
    [[gnu::always_inline]] void pass(int block, const Coverage& c) {
        store(T + block * kLanes, c.after);
        if ((c.any_stopped || least > 0.0f) && !any(above(c.after, splat(least)))) live &= ~(uint64_t{1} << block);
    }
};

struct Tile {
    int left, top, right, bottom;
    float lefts[kBlocks], tops[kBlocks];  // of its blocks
    Tile(const Raster& r, int index)
        : left(index % r.tiles_x * kTile),
          top(index / r.tiles_x * kTile),
          right(std::min(left + kTile, r.camera.width)),
          bottom(std::min(top + kTile, r.camera.height)) {
        for (int b = 0; b < kBlocks; ++b) lefts[b] = left + b % kBlocksX * kBlockX, tops[b] = top + b / kBlocksX * kBlockY;
    }
};

// Visits the pixels of a tile: their index in the picture and in the tile's order of blocks. Rows of a block are visited
// together, so that compilers vectorise them.
template <typename Visit>
inline void for_pixels(const Tile& t, int width, Visit visit) {
    const int columns = t.right - t.left;
    for (int y = t.top; y < t.bottom; ++y) {
        const int row = (y - t.top) / kBlockY * kBlocksX * kLanes + (y - t.top) % kBlockY * kBlockX;
        const size_t first = static_cast<size_t>(y) * width + t.left;
        int x = 0;
        for (; x + kBlockX <= columns; x += kBlockX)
#pragma GCC unroll 4
            for (int i = 0; i < kBlockX; ++i) visit(first + x + i, row + x / kBlockX * kLanes + i);
        for (; x < columns; ++x) visit(first + x, row + x / kBlockX * kLanes + x % kBlockX);
    }
}

// Pixels of a tile between their picture order and their block order. Outside the picture: zero.
template <int Channels>
void gather(const float* picture, int width, const Tile& t, float (*planes)[kTilePixels]) {
    if (t.right - t.left < kTile || t.bottom - t.top < kTile)
        std::memset(planes, 0, sizeof(float) * Channels * kTilePixels);
    for_pixels(t, width, [&](size_t pixel, int at) {
#pragma GCC unroll 3
        for (int c = 0; c < Channels; ++c) planes[c][at] = picture[pixel * Channels + c];
    });
}

template <int Channels>
void scatter(const float (*planes)[kTilePixels], int width, const Tile& t, float* picture) {
    for_pixels(t, width, [&](size_t pixel, int at) {
#pragma GCC unroll 3
        for (int c = 0; c < Channels; ++c) picture[pixel * Channels + c] = planes[c][at];
    });
}

// The splat of pair `n` < `end`. A later one is prefetched, because neighbours in depth are distant in memory.
[[gnu::always_inline]] inline const Splat& splat_of(const Raster& raster, int n, int end) {
    __builtin_prefetch(&raster.splats[raster.pairs[std::min(n + kAhead, end - 1)]]);
    return raster.splats[raster.pairs[n]];
}

// Visits the blocks of pixels of a tile that a splat covers, and updates their transmittance: visit(index of the block in
// the tile, transmittance before, coverage).
template <typename Visit>
[[gnu::always_inline]] inline void for_covered(
    const Splat& s, const Tile& tile, const Lanes& lanes, const BlockCentres& centres, Front& front, Visit visit) {
    for (uint64_t rest = front.live & near_blocks(s, centres, tile.left, tile.top); rest != 0; rest &= rest - 1) {
        const int block = __builtin_ctzll(rest), at = block * kLanes;
        const vf before = load(front.T + at);
        Coverage c;
        if (!c.of(s, lanes, tile.lefts[block], tile.tops[block], before, front.least)) continue;
        visit(at, before, c);
        front.pass(block, c);
    }
}

void blend(const Raster& raster, int index, const float* background, float* image, float* alpha_out) {
    const Tile tile(raster, index);
    const Lanes lanes;
    const BlockCentres centres;
    alignas(kAlignment) float color[3][kTilePixels] = {};
    Front front;
    const int end = raster.starts[index + 1];
    for (int n = raster.starts[index]; n < end && front.live != 0; ++n) {
        const Splat& s = splat_of(raster, n, end);
        for_covered(s, tile, lanes, centres, front, [&](int at, vf before, const Coverage& c) {
            const vf weight = c.alpha * before;
            for (int k = 0; k < 3; ++k) store(color[k] + at, load(color[k] + at) + weight * s.color[k]);
        });
    }
    alignas(kAlignment) float coverage[1][kTilePixels];
    for (int i = 0; i < kTilePixels; i += kLanes) {
        const vf rest = absolute(load(front.T + i));
        store(coverage[0] + i, 1.0f - rest);
        for (int k = 0; k < 3 && background; ++k) store(color[k] + i, load(color[k] + i) + rest * background[k]);
    }
    scatter<3>(color, raster.camera.width, tile, image);
    scatter<1>(coverage, raster.camera.width, tile, alpha_out);
}

void blend_backward(
    const Raster& raster, int index, const float* background, const float* image, const float* alpha,
    const float* grad_image, const float* grad_alpha, float* moments) {
    const Tile tile(raster, index);
    const Lanes lanes;
    const BlockCentres centres;
    const int width = raster.camera.width;
    alignas(kAlignment) float rest[kTilePixels];
    Front front(kMinGradientTransmittance);
    alignas(kAlignment) float gradient[3][kTilePixels], color[3][kTilePixels];
    alignas(kAlignment) float grad_coverage[1][kTilePixels] = {}, coverage[1][kTilePixels];
    gather<3>(grad_image, width, tile, gradient);
    gather<3>(image, width, tile, color);
    gather<1>(alpha, width, tile, coverage);
    if (grad_alpha) gather<1>(grad_alpha, width, tile, grad_coverage);
    for (int i = 0; i < kTilePixels; ++i) {
        // The background is visible through the remaining transmittance, so it contributes to the coverage's gradient.
        if (background)
            for (int k = 0; k < 3; ++k) grad_coverage[0][i] -= background[k] * gradient[k][i];
        rest[i] = coverage[0][i] * grad_coverage[0][i];
        for (int k = 0; k < 3; ++k) {
            const float behind = background ? background[k] * (1.0f - coverage[0][i]) : 0.0f;
            rest[i] += (color[k][i] - behind) * gradient[k][i];
        }
    }
    int n = raster.starts[index], end = raster.starts[index + 1];
    while (end > n && raster.pairs[end - 1] >= raster.trained) --end;  // Their state is not read any more.
    for (; n < end && front.live != 0; ++n) {
        const Splat& s = splat_of(raster, n, end);
        const bool trained = raster.pairs[n] < raster.trained;
        float* out = moments + static_cast<size_t>(raster.pair_slots[n]) * kMomentCount;
        vf m[kMomentCount];
        for (vf& v : m) v = splat(0.0f);
        bool hit = false;
        for_covered(s, tile, lanes, centres, front, [&](int at, vf before, const Coverage& c) {
            hit = true;
            const vf weight = c.alpha * before;
            const vf g0 = load(gradient[0] + at), g1 = load(gradient[1] + at), g2 = load(gradient[2] + at);
            const vf q = g0 * s.color[0] + g1 * s.color[1] + g2 * s.color[2] + load(grad_coverage[0] + at);
            const vf to_come = load(rest + at) - weight * q;
            store(rest + at, to_come);
            if (!trained) return;
            const vf slope = before * q - to_come * reciprocal(1.0f - c.alpha);
            const vf d = keep(above(splat(kMaxAlpha), c.alpha), slope * c.alpha);  // a clamped alpha has no gradient
            const vf dx = d * c.dx, dy = d * c.dy;
            m[0] += d, m[1] += dx, m[2] += dy;
            m[3] += dx * c.dx, m[4] += dx * c.dy, m[5] += dy * c.dy;
            m[6] += weight * g0, m[7] += weight * g1, m[8] += weight * g2;
        });
        if (!trained) continue;
        if (hit) {
            store_sums(m, out);
        } else {
            std::memset(out, 0, sizeof(float) * kMomentCount);
        }
    }
    for (; n < end; ++n)  // hidden
        if (raster.pairs[n] < raster.trained)
            std::memset(moments + static_cast<size_t>(raster.pair_slots[n]) * kMomentCount, 0, sizeof(float) * kMomentCount);
}

// The blocks of a tile in which some map is not zero.
template <int Maps>
uint64_t blocks_with_values(const float (&values)[Maps][kTilePixels]) {
    uint64_t found = 0;
    for (int block = 0; block < kBlocks; ++block) {
        mask other = above(splat(0.0f), splat(0.0f));
        for (int k = 0; k < Maps; ++k) {
            const vf value = load(values[k] + block * kLanes);
            other = either(other, differs(value, splat(0.0f)));
        }
        found |= uint64_t{any(other)} << block;
    }
    return found;
}

// Sums over the pixels of each pair's weight times each of the first Maps maps, of `stride`: sums[stride * slot]. With
// `image` the tile is drawn, too; without it blocks in which all maps are zero are skipped.
template <int Maps, bool kDraws>
void weigh(const Raster& raster, int index, const float* maps, int stride, float* sums, const float* background,
           float* image) {
    const Tile tile(raster, index);
    const Lanes lanes;
    const BlockCentres centres;
    alignas(kAlignment) float values[Maps][kTilePixels] = {};
    alignas(kAlignment) float color[3][kTilePixels];
    if (kDraws) std::memset(color, 0, sizeof color);
    Front front(kDraws ? 0.0f : kMinGradientTransmittance);
    for_pixels(tile, raster.camera.width, [&](size_t pixel, int at) {
#pragma GCC unroll 8
        for (int k = 0; k < Maps; ++k) values[k][at] = maps[pixel * stride + k];
    });
    if (!kDraws) front.live = blocks_with_values<Maps>(values);
    const int end = raster.starts[index + 1];
    int n = raster.starts[index];
    for (; n < end && front.live != 0; ++n) {
        const Splat& s = splat_of(raster, n, end);
        float* out = sums + static_cast<size_t>(raster.pair_slots[n]) * stride;
        vf m[Maps];
        for (vf& v : m) v = splat(0.0f);
        bool hit = false;
        for_covered(s, tile, lanes, centres, front, [&](int at, vf before, const Coverage& c) {
            hit = true;
            const vf weight = c.alpha * before;
            const vf lit = kDraws ? keep(above(before, splat(kMinGradientTransmittance)), weight) : weight;
#pragma GCC unroll 8
            for (int k = 0; k < Maps; ++k) m[k] += lit * load(values[k] + at);
            for (int k = 0; k < 3 && kDraws; ++k) store(color[k] + at, load(color[k] + at) + weight * s.color[k]);
        });
        if (hit) {
            store_sums(m, out);
        } else {
            std::fill_n(out, Maps, 0.0f);
        }
    }
    for (; n < end; ++n) std::fill_n(sums + static_cast<size_t>(raster.pair_slots[n]) * stride, Maps, 0.0f);  // hidden
    if (!kDraws) return;
    for (int i = 0; i < kTilePixels && background; i += kLanes)
        for (int k = 0; k < 3; ++k)
            store(color[k] + i, load(color[k] + i) + absolute(load(front.T + i)) * background[k]);
    scatter<3>(color, raster.camera.width, tile, image);
}

// By the number of maps, from one on.
using Weigh = void(const Raster&, int, const float*, int, float*, const float*, float*);
template <bool kDraws>
constexpr Weigh* kWeigh[kMapsAtOnce] = {weigh<1, kDraws>, weigh<2, kDraws>, weigh<3, kDraws>, weigh<4, kDraws>,
                                        weigh<5, kDraws>, weigh<6, kDraws>, weigh<7, kDraws>, weigh<8, kDraws>};

}  // namespace

// maps: `count` numbers for each pixel; sums: `count` numbers for each pair, all written. image: output, or null.
void weigh(const Raster& raster, const float* maps, int count, float* sums, const float* background, float* image,
           int threads) {
    const int tiles = raster.tiles_x * raster.tiles_y;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4) if (threads > 1)
    for (int t = 0; t < tiles; ++t)
        for (int first = 0; first < count; first += kMapsAtOnce) {
            const int place = std::min(count - first, kMapsAtOnce) - 1;
            Weigh* const weigh_tile = image && first == 0 ? kWeigh<true>[place] : kWeigh<false>[place];
            weigh_tile(raster, t, maps + first, count, sums + first, background, image);
        }
}

void rasterize(const Raster& raster, const float* background, float* image, float* alpha, int threads) {
    const int tiles = raster.tiles_x * raster.tiles_y;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4) if (threads > 1)
    for (int t = 0; t < tiles; ++t)
        if (raster.draws(t)) blend(raster, t, background, image, alpha);
}

// moments: kMomentCount numbers for each pair of a trained splat, all written.
void rasterize_backward(
    const Raster& raster, const float* background, const float* image, const float* alpha, const float* grad_image,
    const float* grad_alpha, float* moments, int threads) {
    const int tiles = raster.tiles_x * raster.tiles_y;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 4) if (threads > 1)
    for (int t = 0; t < tiles; ++t)
        if (raster.draws(t)) blend_backward(raster, t, background, image, alpha, grad_image, grad_alpha, moments);
}

}  // namespace SGS_ISA
}  // namespace structgstream
