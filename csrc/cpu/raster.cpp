// SPDX-License-Identifier: Apache-2.0
// Blending splats over tiles, forward and backward.
//
// A vector is a small block of pixels (4 x 4, 4 x 2 or 2 x 2). Backward repeats forward front to back. It maintains R, the
// remaining colour of the pixel behind the splat, dotted with the pixel's gradient. Then
// dL/dalpha = T q - R / (1 - alpha) with q = color . gradient, so only the finished image is needed. A splat behind a
// transmittance below kMinGradientTransmittance gets neither gradient nor weight from the pixel. It is drawn
// nevertheless, because otherwise opaque surfaces would be visibly incomplete.

#include <algorithm>
#include <cmath>
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
#pragma GCC unroll 4
    for (int g = 0; g < kGroups; ++g) {
        vf rows[kLanes];
#pragma GCC unroll 16
        for (int i = 0; i < kLanes; ++i) rows[i] = g * kLanes + i < Count ? m[g * kLanes + i] : splat(0.0f);
        store_first(out + g * kLanes, sums_of_lanes(rows), std::min(kLanes, Count - g * kLanes));
    }
}

// 2^x for x in [-8, 0.1]: integer part by rounding, fraction by a polynomial (error 9e-8) whose terms do not wait for
// each other.
inline vf power_of_two(vf x) {
    const vf magic = splat(12582912.0f);
    const vf rounded = x + magic;
    const vf f = x - (rounded - magic), ff = f * f;
    const vf high = splat(9.67151299e-3f) + f * 1.32647273e-3f, middle = splat(0.240222424f) + f * 5.55073359e-2f, low = splat(1.0f) + f * 0.693147004f;
    const vf p = low + ff * (middle + ff * high);
    return (vf)((vi)p + ((vi)rounded << 23));
}

// The centres of a tile's blocks, lane by lane.
struct BlockCentres {
    static constexpr int kVectors = kBlocks / kLanes, kRows = kLanes / kBlocksX;
    vf x, y;
    BlockCentres() {
        for (int i = 0; i < kLanes; ++i)
            x[i] = (i % kBlocksX + 0.5f) * kBlockX, y[i] = (i / kBlocksX + 0.5f) * kBlockY;
    }
};

struct Tile {
    int left, top, right, bottom;
    Tile(const Raster& r, int index)
        : left(index % r.tiles_x * kTile),
          top(index / r.tiles_x * kTile),
          right(std::min(left + kTile, r.camera.width)),
          bottom(std::min(top + kTile, r.camera.height)) {}
};

// A bit for each block of a tile that a splat may cover: by its ellipse if few vectors contain all blocks, else by its
// box. The rounding error of the quadratic form is in proportion to its two squares; a share of these is added as slack.
inline uint64_t near_blocks(const Splat& s, const BlockCentres& centres, const Tile& tile) {
    uint64_t found = 0;
#if SGS_LANES > 4
    const vf dx = centres.x - (s.x - tile.left), first_dy = centres.y - (s.y - tile.top);
    const vf along_x = dx * dx * (s.xx * (1.0f - 1e-5f)), mixed = dx * s.xy;
    const float yy = s.yy * (1.0f - 1e-5f);
#pragma GCC unroll 4
    for (int v = 0; v < BlockCentres::kVectors; ++v) {
        const vf dy = first_dy + static_cast<float>(v * BlockCentres::kRows * kBlockY);
        const mask near = at_least(splat(s.near_block), along_x + dy * (dy * yy + mixed));
        found |= uint64_t{bits(near)} << (v * kLanes);
    }
#else
    const int x0 = std::max(0, s.box[0] - tile.left) / kBlockX;
    const int x1 = (std::min(kTile, s.box[2] - tile.left) + kBlockX - 1) / kBlockX;
    const int y0 = std::max(0, s.box[1] - tile.top) / kBlockY;
    const int y1 = (std::min(kTile, s.box[3] - tile.top) + kBlockY - 1) / kBlockY;
    const uint64_t row = ((uint64_t{1} << (x1 - x0)) - 1) << x0;
    for (int y = y0; y < y1; ++y) found |= row << (y * kBlocksX);
#endif
    return found;
}

// Opacity of a splat at pixels at a distance of dx and dy, 0 below 1/255.
[[gnu::always_inline]] inline vf opacity_at(const Splat& s, vf dx, vf dy) {
    const vf power = (s.log2_opacity - dy * (dy * s.yy)) - dx * (dx * s.xx + dy * s.xy);
    return keep(at_least(power, splat(kLog2MinAlpha)), smallest(power_of_two(power), splat(kMaxAlpha)));
}

// One splat over one block of pixels whose transmittance is T. T above `least`, zero or more, is live; a pixel that has
// stopped stores its transmittance with a minus sign.
struct Coverage {
    vf alpha, after;  // after: the transmittance behind the splat, valid for live pixels
    bool any_stopped;

    [[gnu::always_inline]] Coverage(vf opacity, vf T, float least) {
        const mask live = above(T, splat(least));
        alpha = keep(live, opacity);
        after = T * (1.0f - alpha);
        const mask stopped = both(live, at_least(splat(kMinTransmittance), after));
        any_stopped = any(stopped);
        if (any_stopped) {
            alpha = keep(without(live, stopped), alpha);
            after = choose(stopped, -T, after);
        }
    }
};

// The pixels of a block: their centres within the tile, their transmittance, and `Count` further numbers of each.
template <int Count>
struct alignas(4 * kLanes) Block {
    float x[kLanes], y[kLanes], T[kLanes], values[Count][kLanes];
};

// The pixels of a tile, and a bit for each block that may have a pixel whose transmittance is above kLeast. kTrains: only
// what gets gradients or weights counts, not what is drawn.
template <int Count, bool kTrains>
struct Blocks {
    static constexpr float kLeast = kTrains ? kMinGradientTransmittance : 0.0f;
    Block<Count> at[kBlocks];
    uint64_t live = ~uint64_t{0} >> (64 - kBlocks);
    Blocks() {
        vf x, y;
        for (int i = 0; i < kLanes; ++i) x[i] = i % kBlockX + 0.5f, y[i] = i / kBlockX + 0.5f;
        for (int n = 0; n < kBlocks; ++n) {
            store(at[n].x, x + static_cast<float>(n % kBlocksX * kBlockX));
            store(at[n].y, y + static_cast<float>(n / kBlocksX * kBlockY));
            store(at[n].T, splat(1.0f));
            for (auto& values : at[n].values) store(values, splat(0.0f));
        }
    }
};

// Visits the pixels of a tile: their index in the picture, their block, and their lane. Rows of a block are visited
// together, so that compilers vectorise them.
template <typename Visit>
inline void for_pixels(const Tile& t, int width, Visit visit) {
    const int columns = t.right - t.left;
    for (int y = t.top; y < t.bottom; ++y) {
        const int row = (y - t.top) / kBlockY * kBlocksX, lane = (y - t.top) % kBlockY * kBlockX;
        const size_t first = static_cast<size_t>(y) * width + t.left;
        int x = 0;
        for (; x + kBlockX <= columns; x += kBlockX)
#pragma GCC unroll 4
            for (int i = 0; i < kBlockX; ++i) visit(first + x + i, row + x / kBlockX, lane + i);
        for (; x < columns; ++x) visit(first + x, row + x / kBlockX, lane + x % kBlockX);
    }
}

// `Channels` numbers of each pixel from a picture to its block, from number `First` on. Outside the picture: as they were.
template <int First, int Channels, int Count, bool kTrains>
void gather(const float* picture, int width, const Tile& t, Blocks<Count, kTrains>& blocks) {
    for_pixels(t, width, [&](size_t pixel, int block, int lane) {
#pragma GCC unroll 3
        for (int c = 0; c < Channels; ++c) blocks.at[block].values[First + c][lane] = picture[pixel * Channels + c];
    });
}

// The first three numbers of each pixel, a colour, to a picture.
template <int Count, bool kTrains>
void scatter_color(const Blocks<Count, kTrains>& blocks, int width, const Tile& t, float* picture) {
    for_pixels(t, width, [&](size_t pixel, int block, int lane) {
#pragma GCC unroll 3
        for (int c = 0; c < 3; ++c) picture[3 * pixel + c] = blocks.at[block].values[c][lane];
    });
}

// The splat of pair `n` < `end`. A later one is prefetched, because neighbours in depth are distant in memory.
[[gnu::always_inline]] inline const Splat& splat_of(const Raster& raster, int n, int end) {
    __builtin_prefetch(&raster.splats[raster.pairs[std::min(n + kAhead, end - 1)].splat]);
    return raster.splats[raster.pairs[n].splat];
}

// Visits the pairs n ... end - 1 of a tile until all blocks are hidden: visit(splat, pair, blocks that it may cover). The
// blocks of the next splat are found ahead, so that a processor that did not foresee the end of a visit has them at once.
// Returns the first pair that was not visited.
template <int Count, bool kTrains, typename Visit>
[[gnu::always_inline]] inline int for_splats(
    const Raster& raster, const Tile& tile, int n, int end, const Blocks<Count, kTrains>& blocks, Visit visit) {
    const BlockCentres centres;
    const auto near = [&](int pair) { return near_blocks(splat_of(raster, pair, end), centres, tile); };
    for (uint64_t ahead = n < end ? near(n) : 0; n < end && blocks.live != 0; ++n) {
        const uint64_t here = ahead;
        ahead = near(std::min(n + 1, end - 1));
        visit(raster.splats[raster.pairs[n].splat], n, here);
    }
    return n;
}

// Visits the blocks of pixels of a tile that a splat covers, and updates their transmittance: visit(block, transmittance
// before, coverage). The opacity of the next block is computed ahead: processors then overlap its long chain of dependent
// instructions with that of the visit. Returns whether there are any.
template <int Count, bool kTrains, typename Visit>
[[gnu::always_inline]] inline bool for_covered(
    const Splat& s, uint64_t near, const Tile& tile, Blocks<Count, kTrains>& blocks, Visit visit) {
    constexpr float kLeast = Blocks<Count, kTrains>::kLeast;
    const float x = s.x - tile.left, y = s.y - tile.top;
    const auto opacity_of = [&](const Block<Count>& block) { return opacity_at(s, load(block.x) - x, load(block.y) - y); };
    uint64_t rest = blocks.live & near;
    if (rest == 0) return false;
    int next = __builtin_ctzll(rest);
    vf opacity = opacity_of(blocks.at[next]);
    while (true) {
        const int n = next;
        Block<Count>& block = blocks.at[n];
        const vf before = load(block.T);
        const vf here = opacity;
        rest &= rest - 1;
        next = rest != 0 ? __builtin_ctzll(rest) : n;
        opacity = opacity_of(blocks.at[next]);
        const Coverage c(here, before, kLeast);
        visit(block, before, c);
        store(block.T, c.after);
        if ((c.any_stopped || kTrains) && !any(above(c.after, splat(kLeast)))) blocks.live &= ~(uint64_t{1} << n);
        if (rest == 0) return true;
    }
}

// Adds the background's share to the colour of each pixel, its first three numbers.
template <int Count, bool kTrains>
void add_background(const float* background, Blocks<Count, kTrains>& blocks) {
    for (Block<Count>& block : blocks.at)
        for (int k = 0; k < 3; ++k)
            store(block.values[k], load(block.values[k]) + absolute(load(block.T)) * background[k]);
}

void blend(const Raster& raster, int index, const float* background, float* image, float* alpha_out) {
    const Tile tile(raster, index);
    Blocks<3, false> blocks;  // color
    for_splats(raster, tile, raster.starts[index], raster.starts[index + 1], blocks, [&](const Splat& s, int, uint64_t near) {
        for_covered(s, near, tile, blocks, [&](Block<3>& block, vf before, const Coverage& c) {
            const vf weight = c.alpha * before;
            for (int k = 0; k < 3; ++k) store(block.values[k], load(block.values[k]) + weight * s.color[k]);
        });
    });
    if (background) add_background(background, blocks);
    scatter_color(blocks, raster.camera.width, tile, image);
    for_pixels(tile, raster.camera.width, [&](size_t pixel, int block, int lane) {
        alpha_out[pixel] = 1.0f - std::abs(blocks.at[block].T[lane]);
    });
}

void blend_backward(
    const Raster& raster, int index, const float* background, const float* image, const float* alpha,
    const float* grad_image, const float* grad_alpha, float* moments) {
    const Tile tile(raster, index);
    const int width = raster.camera.width;
    Blocks<8, true> blocks;  // color, then the remaining colour; its gradient; gradient of coverage; coverage
    enum { kColor, kRest = kColor, kGradient = 3, kCoverageGradient = 6, kCoverage };
    gather<kColor, 3>(image, width, tile, blocks);
    gather<kGradient, 3>(grad_image, width, tile, blocks);
    if (grad_alpha) gather<kCoverageGradient, 1>(grad_alpha, width, tile, blocks);
    gather<kCoverage, 1>(alpha, width, tile, blocks);
    for (Block<8>& block : blocks.at) {
        auto& v = block.values;
        for (int i = 0; i < kLanes; ++i) {
            // The background is visible through the remaining transmittance, so it contributes to the coverage's gradient.
            if (background)
                for (int k = 0; k < 3; ++k) v[kCoverageGradient][i] -= background[k] * v[kGradient + k][i];
            float rest = v[kCoverage][i] * v[kCoverageGradient][i];
            for (int k = 0; k < 3; ++k) {
                const float behind = background ? background[k] * (1.0f - v[kCoverage][i]) : 0.0f;
                rest += (v[kColor + k][i] - behind) * v[kGradient + k][i];
            }
            v[kRest][i] = rest;
        }
    }
    int n = raster.starts[index], end = raster.starts[index + 1];
    while (end > n && raster.pairs[end - 1].splat >= raster.trained) --end;  // Their state is not read any more.
    n = for_splats(raster, tile, n, end, blocks, [&](const Splat& s, int n, uint64_t near) {
        const bool trained = raster.pairs[n].splat < raster.trained;
        float* out = moments + static_cast<size_t>(raster.pairs[n].slot) * kMomentCount;
        vf m[kMomentCount];
        for (vf& v : m) v = splat(0.0f);
        const float x = s.x - tile.left, y = s.y - tile.top;
        const bool hit = for_covered(s, near, tile, blocks, [&](Block<8>& block, vf before, const Coverage& c) {
            const auto& v = block.values;
            const vf weight = c.alpha * before;
            const vf g0 = load(v[kGradient]), g1 = load(v[kGradient + 1]), g2 = load(v[kGradient + 2]);
            const vf q = g0 * s.color[0] + g1 * s.color[1] + g2 * s.color[2] + load(v[kCoverageGradient]);
            const vf to_come = load(v[kRest]) - weight * q;
            store(block.values[kRest], to_come);
            if (!trained) return;
            const vf slope = before * q - to_come * reciprocal(1.0f - c.alpha);
            const vf d = keep(above(splat(kMaxAlpha), c.alpha), slope * c.alpha);  // a clamped alpha has no gradient
            const vf to_x = load(block.x) - x, to_y = load(block.y) - y;
            const vf dx = d * to_x, dy = d * to_y;
            m[0] += d, m[1] += dx, m[2] += dy;
            m[3] += dx * to_x, m[4] += dx * to_y, m[5] += dy * to_y;
            m[6] += weight * g0, m[7] += weight * g1, m[8] += weight * g2;
        });
        if (!trained) return;
        if (hit) {
            store_sums(m, out);
        } else {
            std::memset(out, 0, sizeof(float) * kMomentCount);
        }
    });
    for (; n < end; ++n)  // hidden
        if (raster.pairs[n].splat < raster.trained)
            std::memset(moments + static_cast<size_t>(raster.pairs[n].slot) * kMomentCount, 0, sizeof(float) * kMomentCount);
}

// The blocks of a tile in which one of the numbers is not zero.
template <int Count, bool kTrains>
uint64_t blocks_with_values(const Blocks<Count, kTrains>& blocks) {
    uint64_t found = 0;
    for (int n = 0; n < kBlocks; ++n) {
        mask other = above(splat(0.0f), splat(0.0f));
        for (const auto& values : blocks.at[n].values) other = either(other, differs(load(values), splat(0.0f)));
        found |= uint64_t{any(other)} << n;
    }
    return found;
}

// Sums over the pixels of each pair's weight times each of the first Maps maps, of `stride`: sums[stride * slot]. With
// `image` the tile is drawn, too; without it blocks in which all maps are zero are skipped.
template <int Maps, bool kDraws>
void weigh(const Raster& raster, int index, const float* maps, int stride, float* sums, const float* background,
           float* image) {
    constexpr int kFirst = kDraws ? 3 : 0;  // the first map, after the colour
    const Tile tile(raster, index);
    Blocks<kFirst + Maps, !kDraws> blocks;
    for_pixels(tile, raster.camera.width, [&](size_t pixel, int block, int lane) {
#pragma GCC unroll 8
        for (int k = 0; k < Maps; ++k) blocks.at[block].values[kFirst + k][lane] = maps[pixel * stride + k];
    });
    if (!kDraws) blocks.live = blocks_with_values(blocks);
    const int end = raster.starts[index + 1];
    int n = for_splats(raster, tile, raster.starts[index], end, blocks, [&](const Splat& s, int n, uint64_t near) {
        float* out = sums + static_cast<size_t>(raster.pairs[n].slot) * stride;
        vf m[Maps];
        for (vf& v : m) v = splat(0.0f);
        const bool hit = for_covered(s, near, tile, blocks, [&](Block<kFirst + Maps>& block, vf before, const Coverage& c) {
            const vf weight = c.alpha * before;
            const vf lit = kDraws ? keep(above(before, splat(kMinGradientTransmittance)), weight) : weight;
#pragma GCC unroll 8
            for (int k = 0; k < Maps; ++k) m[k] += lit * load(block.values[kFirst + k]);
            for (int k = 0; k < kFirst; ++k) store(block.values[k], load(block.values[k]) + weight * s.color[k]);
        });
        if (hit) {
            store_sums(m, out);
        } else {
            std::fill_n(out, Maps, 0.0f);
        }
    });
    for (; n < end; ++n) std::fill_n(sums + static_cast<size_t>(raster.pairs[n].slot) * stride, Maps, 0.0f);  // hidden
    if (!kDraws) return;
    if (background) add_background(background, blocks);
    scatter_color(blocks, raster.camera.width, tile, image);
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
