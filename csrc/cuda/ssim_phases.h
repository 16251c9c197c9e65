// SPDX-License-Identifier: Apache-2.0
// L1 and SSIM (Wang et al., 2004; 11 x 11 Gaussian window, sigma 1.5, zero padding) with their gradient, for a GPU.
//
// A block is one tile of 16 x 16 pixels with its three channels, so selected tiles are blocks. A row of the picture is a
// row of 3 W numbers, and a horizontal blur reads every third of them. The work of a block is divided at its barriers into
// phases: functions of one thread that read what earlier phases wrote. ssim_calls.h has their order, for a GPU and, thread
// by thread, for a CPU.
//
// SSIM needs only the sum of the two second moments, so four blurs are sufficient instead of five. Sums are computed in a
// fixed order without atomics, so results repeat bit for bit.
#pragma once

#include <cstdint>

#ifdef __CUDACC__
#define SGS_PHASE __host__ __device__ inline
#else
#define SGS_PHASE inline
#endif
#ifdef __CUDA_ARCH__
#define SGS_UNROLL _Pragma("unroll")
#else
#define SGS_UNROLL
#endif

namespace structgstream {
namespace cuda {

constexpr int kHalf = 5;
constexpr int kTaps = 2 * kHalf + 1;
constexpr int kChannels = 3;
constexpr int kTile = 16;                              // pixels, as structgstream.kernels.values.TILE_PIXELS
constexpr int kTileNumbers = kTile * kChannels;        // numbers in a row of a tile
constexpr int kPadded = kTileNumbers + 4;              // in memory, so that a warp reads 32 different banks
constexpr int kRows = kTile + 2 * kHalf;               // rows that a tile's blurs read
constexpr int kRowNumbers = kRows * kChannels;         // numbers in a row that they read
constexpr int kMoments = 4;                            // x, y, xx + yy, xy
constexpr int kAdjoints = 3;                           // of mean x, of xx + yy, of xy
constexpr int kAcross = 8;                             // pixels that a thread blurs across in one go
constexpr int kDown = 4;                               // pixels that a thread blurs down in one go
constexpr int kThreads = kTileNumbers * (kTile / kDown);
constexpr int kSumThreads = 256;                       // of the block that adds the blocks' sums
constexpr float kC1 = 0.01f * 0.01f;
constexpr float kC2 = 0.03f * 0.03f;

// The pictures [H, W, 3]. One of target and target_u8 is null; gains and biases [3], applied to the image, or both null;
// tiles: a byte for each tile, zero where the picture counts as equal, or null.
struct Pictures {
    const float* image;
    const float* target;
    const uint8_t* target_u8;
    const float* gains;
    const float* biases;
    const uint8_t* tiles;
    int height;
    int width;
    float weights[kTaps];  // of the window, which sums to 1
};

struct Tile {
    int row;     // of tiles
    int column;
    int rows;    // of tiles in the picture
    int columns;
};

SGS_PHASE int tiles_along(int pixels) { return (pixels + kTile - 1) / kTile; }

SGS_PHASE bool counts(const Pictures& p, const Tile& tile) {
    return p.tiles == nullptr || p.tiles[tile.row * tile.columns + tile.column] != 0;
}

// Whether a pixel of this or of an adjacent tile counts, whose gradient then needs the derivatives here.
SGS_PHASE bool counts_nearby(const Pictures& p, const Tile& tile) {
    if (p.tiles == nullptr) return true;
    bool found = false;
    for (int i = tile.row - 1; i <= tile.row + 1; ++i)
        for (int j = tile.column - 1; j <= tile.column + 1; ++j)
            if (i >= 0 && i < tile.rows && j >= 0 && j < tile.columns) found |= p.tiles[i * tile.columns + j] != 0;
    return found;
}

SGS_PHASE float corrected(const Pictures& p, int64_t at, int channel) {
    const float x = p.image[at];
    return p.gains == nullptr ? x : x * p.gains[channel] + p.biases[channel];
}

SGS_PHASE float wanted(const Pictures& p, int64_t at) {
    return p.target != nullptr ? p.target[at] : static_cast<float>(p.target_u8[at]) / 255.0f;
}

// Where thread `t` blurs down: one column of numbers, kDown rows.
SGS_PHASE int column_of(int t) { return t % kTileNumbers; }
SGS_PHASE int row_of(int t) { return t / kTileNumbers * kDown; }

// kAcross pixels of one channel of one row, in and out pointing at the first number that is read and written.
SGS_PHASE void blur_across(const float* weights, const float* in, float* out) {
    float sums[kAcross] = {};
    SGS_UNROLL
    for (int j = 0; j < kAcross + kTaps - 1; ++j) {
        const float value = in[j * kChannels];
        SGS_UNROLL
        for (int i = 0; i < kAcross; ++i)
            if (j >= i && j - i < kTaps) sums[i] += weights[j - i] * value;
    }
    SGS_UNROLL
    for (int i = 0; i < kAcross; ++i) out[i * kChannels] = sums[i];
}

// kDown pixels of one column of numbers.
SGS_PHASE void blur_down(const float* weights, const float* in, float (&sums)[kDown]) {
    SGS_UNROLL
    for (int i = 0; i < kDown; ++i) sums[i] = 0.0f;
    SGS_UNROLL
    for (int j = 0; j < kDown + kTaps - 1; ++j) {
        const float value = in[j * kPadded];
        SGS_UNROLL
        for (int i = 0; i < kDown; ++i)
            if (j >= i && j - i < kTaps) sums[i] += weights[j - i] * value;
    }
}

// ---- Forward: L1, SSIM and the derivatives of SSIM by its moments ----

struct ForwardShared {
    float x[kRows][kRowNumbers];
    float y[kRows][kRowNumbers];
    float moments[kMoments][kRows][kPadded];  // blurred across
    float l1[kThreads];
    float ssim[kThreads];
};

struct Forward {
    Pictures pictures;
    float* adjoints;  // [kAdjoints, H, W, 3], written where a tile nearby counts; or null
    float* sums;      // [2, tiles]: L1 and SSIM
};

SGS_PHASE void forward_read(const Forward& f, const Tile& tile, ForwardShared& s, int t) {
    const Pictures& p = f.pictures;
    const int64_t stride = static_cast<int64_t>(p.width) * kChannels;
    const int top = tile.row * kTile - kHalf, left = (tile.column * kTile - kHalf) * kChannels;
    for (int i = t; i < kRows * kRowNumbers; i += kThreads) {
        const int row = top + i / kRowNumbers, number = left + i % kRowNumbers;
        const bool inside = row >= 0 && row < p.height && number >= 0 && number < stride;
        const int64_t at = row * stride + number;
        s.x[i / kRowNumbers][i % kRowNumbers] = inside ? corrected(p, at, number % kChannels) : 0.0f;
        s.y[i / kRowNumbers][i % kRowNumbers] = inside ? wanted(p, at) : 0.0f;
    }
}

SGS_PHASE void forward_across(const Forward& f, ForwardShared& s, int t) {
    constexpr int kParts = kTile / kAcross;
    const float* weights = f.pictures.weights;
    for (int i = t; i < kRows * kParts * kChannels; i += kThreads) {
        const int row = i / (kParts * kChannels);
        const int first = i / kChannels % kParts * kAcross * kChannels + i % kChannels;
        const float* x = s.x[row] + first;
        const float* y = s.y[row] + first;
        blur_across(weights, x, s.moments[0][row] + first);
        blur_across(weights, y, s.moments[1][row] + first);
        float squares[kAcross] = {}, products[kAcross] = {};
        SGS_UNROLL
        for (int j = 0; j < kAcross + kTaps - 1; ++j) {
            const float a = x[j * kChannels], b = y[j * kChannels];
            const float square = a * a + b * b, product = a * b;
            SGS_UNROLL
            for (int k = 0; k < kAcross; ++k)
                if (j >= k && j - k < kTaps) {
                    squares[k] += weights[j - k] * square;
                    products[k] += weights[j - k] * product;
                }
        }
        SGS_UNROLL
        for (int k = 0; k < kAcross; ++k) {
            s.moments[2][row][first + k * kChannels] = squares[k];
            s.moments[3][row][first + k * kChannels] = products[k];
        }
    }
}

SGS_PHASE void forward_down(const Forward& f, const Tile& tile, ForwardShared& s, int t) {
    const Pictures& p = f.pictures;
    const int column = column_of(t), row = row_of(t);
    float a[kDown], b[kDown], squares[kDown], products[kDown];
    blur_down(p.weights, s.moments[0][row] + column, a);
    blur_down(p.weights, s.moments[1][row] + column, b);
    blur_down(p.weights, s.moments[2][row] + column, squares);
    blur_down(p.weights, s.moments[3][row] + column, products);
    const bool counted = counts(p, tile);
    const int64_t stride = static_cast<int64_t>(p.width) * kChannels, size = p.height * stride;
    const int number = tile.column * kTileNumbers + column;
    float l1 = 0.0f, ssim = 0.0f;
    SGS_UNROLL
    for (int i = 0; i < kDown; ++i) {
        const int y = tile.row * kTile + row + i;
        if (y >= p.height || number >= stride) continue;
        const float ab = a[i] * b[i], aabb = a[i] * a[i] + b[i] * b[i];
        const float a1 = 2.0f * ab + kC1, a2 = 2.0f * (products[i] - ab) + kC2;
        const float b1 = aabb + kC1, b2 = squares[i] - aabb + kC2;
        const float inverse = 1.0f / (b1 * b2);
        const float value = a1 * a2 * inverse;
        const float difference = s.x[row + i + kHalf][column + kHalf * kChannels] -
                                 s.y[row + i + kHalf][column + kHalf * kChannels];
        l1 += !counted ? 0.0f : difference < 0.0f ? -difference : difference;
        ssim += counted ? value : 1.0f;
        if (f.adjoints == nullptr) continue;
        float* out = f.adjoints + y * stride + number;
        out[0] = 2.0f * inverse * (b[i] * (a2 - a1) - a[i] * value * (b2 - b1));
        out[size] = -2.0f * value * b1 * inverse;
        out[2 * size] = 2.0f * a1 * inverse;
    }
    s.l1[t] = l1;
    s.ssim[t] = ssim;
}

// Twelve sums of sixteen numbers, then one of twelve.
SGS_PHASE void forward_gather(ForwardShared& s, int t) {
    if (t >= kThreads / 16) return;
    float l1 = 0.0f, ssim = 0.0f;
    for (int i = t; i < kThreads; i += kThreads / 16) l1 += s.l1[i], ssim += s.ssim[i];
    s.l1[t] = l1;  // No other thread reads this element: i = t modulo 12.
    s.ssim[t] = ssim;
}

SGS_PHASE void forward_give(const Forward& f, const Tile& tile, const ForwardShared& s, int t) {
    if (t != 0) return;
    float l1 = 0.0f, ssim = 0.0f;
    for (int i = 0; i < kThreads / 16; ++i) l1 += s.l1[i], ssim += s.ssim[i];
    const int at = tile.row * tile.columns + tile.column;
    f.sums[at] = l1;
    f.sums[tile.rows * tile.columns + at] = ssim;
}

// A tile where neither it nor an adjacent tile counts: equal by definition, and not read.
SGS_PHASE void forward_skip(const Forward& f, const Tile& tile, int t) {
    if (t != 0) return;
    const int bottom = (tile.row + 1) * kTile, right = (tile.column + 1) * kTile;
    const int rows = (bottom < f.pictures.height ? bottom : f.pictures.height) - tile.row * kTile;
    const int columns = (right < f.pictures.width ? right : f.pictures.width) - tile.column * kTile;
    const int at = tile.row * tile.columns + tile.column;
    f.sums[at] = 0.0f;
    f.sums[tile.rows * tile.columns + at] = static_cast<float>(rows * columns * kChannels);
}

// ---- The means: one block ----

struct SumShared {
    double l1[kSumThreads];
    double ssim[kSumThreads];
};

SGS_PHASE void sum_read(const float* sums, int count, SumShared& s, int t) {
    double l1 = 0.0, ssim = 0.0;
    for (int i = t; i < count; i += kSumThreads) l1 += sums[i], ssim += sums[count + i];
    s.l1[t] = l1;
    s.ssim[t] = ssim;
}

SGS_PHASE void sum_fold(SumShared& s, int half, int t) {
    if (t < half) s.l1[t] += s.l1[t + half], s.ssim[t] += s.ssim[t + half];
}

SGS_PHASE void sum_give(const SumShared& s, double numbers, float* means, int t) {
    if (t != 0) return;
    means[0] = static_cast<float>(s.l1[0] / numbers);
    means[1] = static_cast<float>(s.ssim[0] / numbers);
}

// ---- Backward: the picture's gradient ----

struct BackwardShared {
    float adjoints[kAdjoints][kRows][kRowNumbers];
    float across[kAdjoints][kRows][kPadded];
};

struct Backward {
    Pictures pictures;
    const float* adjoints;
    const float* to_l1;    // one number each, in the GPU's memory, so that the host does not wait for it
    const float* to_ssim;
    float* gradient;       // [H, W, 3]
};

SGS_PHASE void backward_read(const Backward& f, const Tile& tile, BackwardShared& s, int t) {
    const Pictures& p = f.pictures;
    const int64_t stride = static_cast<int64_t>(p.width) * kChannels, size = p.height * stride;
    const int top = tile.row * kTile - kHalf, left = (tile.column * kTile - kHalf) * kChannels;
    for (int i = t; i < kRows * kRowNumbers; i += kThreads) {
        const int row = top + i / kRowNumbers, number = left + i % kRowNumbers;
        const bool inside = row >= 0 && row < p.height && number >= 0 && number < stride;
        const int64_t at = row * stride + number;
        SGS_UNROLL
        for (int m = 0; m < kAdjoints; ++m)
            s.adjoints[m][i / kRowNumbers][i % kRowNumbers] = inside ? f.adjoints[m * size + at] : 0.0f;
    }
}

SGS_PHASE void backward_across(const Backward& f, BackwardShared& s, int t) {
    constexpr int kParts = kTile / kAcross;
    for (int i = t; i < kAdjoints * kRows * kParts * kChannels; i += kThreads) {
        const int map = i / (kRows * kParts * kChannels), row = i / (kParts * kChannels) % kRows;
        const int first = i / kChannels % kParts * kAcross * kChannels + i % kChannels;
        blur_across(f.pictures.weights, s.adjoints[map][row] + first, s.across[map][row] + first);
    }
}

SGS_PHASE void backward_give(const Backward& f, const Tile& tile, const BackwardShared& s, int t) {
    const Pictures& p = f.pictures;
    const int column = column_of(t), row = row_of(t);
    float mean[kDown], squares[kDown], products[kDown];
    blur_down(p.weights, s.across[0][row] + column, mean);
    blur_down(p.weights, s.across[1][row] + column, squares);
    blur_down(p.weights, s.across[2][row] + column, products);
    const int64_t stride = static_cast<int64_t>(p.width) * kChannels;
    const int number = tile.column * kTileNumbers + column;
    const float gain = p.gains == nullptr ? 1.0f : p.gains[number % kChannels];
    const float scale = gain / (static_cast<float>(p.height) * static_cast<float>(stride));
    const float l1 = *f.to_l1 * scale, ssim = *f.to_ssim * scale;
    SGS_UNROLL
    for (int i = 0; i < kDown; ++i) {
        const int line = tile.row * kTile + row + i;
        if (line >= p.height || number >= stride) continue;
        const int64_t at = line * stride + number;
        const float x = corrected(p, at, number % kChannels), y = wanted(p, at);
        const float sign = x > y ? 1.0f : x < y ? -1.0f : 0.0f;
        f.gradient[at] = l1 * sign + ssim * (mean[i] + x * squares[i] + y * products[i]);
    }
}

SGS_PHASE void backward_skip(const Backward& f, const Tile& tile, int t) {
    const Pictures& p = f.pictures;
    const int64_t stride = static_cast<int64_t>(p.width) * kChannels;
    const int number = tile.column * kTileNumbers + column_of(t);
    for (int i = 0; i < kDown; ++i) {
        const int line = tile.row * kTile + row_of(t) + i;
        if (line < p.height && number < stride) f.gradient[line * stride + number] = 0.0f;
    }
}

}  // namespace cuda
}  // namespace structgstream
