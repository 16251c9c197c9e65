// SPDX-License-Identifier: Apache-2.0
// L1 and SSIM (Wang et al., 2004; 11 x 11 Gaussian window, sigma 1.5, zero padding) with the gradient of SSIM.
//
// The picture is divided into parts (csrc/cpu/parts.cpp), and each part into strips of columns that fit the cache. A strip
// is processed from top to bottom. Products of the two pictures are blurred horizontally into a ring of rows, then
// vertically, four rows at a time, into the moments. These give SSIM and its three adjoint maps, which pass the same two
// blurs back to the picture. SSIM needs only the sum of the two second moments, so four blurs are sufficient instead of
// five. A pixel's value does not depend on the parts, and sums are computed row by row in a fixed order.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "ssim.h"
#include "vec.h"

namespace structgstream {
namespace SGS_ISA {
namespace {

constexpr int kHalf = 5;
constexpr int kTaps = 2 * kHalf + 1;
constexpr int kChannels = 3;
constexpr int kBatch = 4;                           // rows that share the loads of one vertical pass
constexpr int kReach = kBatch + 2 * kHalf;          // rows that one vertical pass reads
constexpr int kRing = 16;                           // rows in the ring; a power of two, at least kReach
constexpr int kLead = 12;                           // whole batches between a row's first and last blur
constexpr int kPad = kChannels * kHalf;             // zeros on both sides of a row
constexpr int kStripPixels = 256;
constexpr int kMoments = 4;                         // x, y, xx + yy, xy
constexpr int kAdjoints = 3;                        // of mean x, of xx, of xy
constexpr double kSigma = 1.5;
constexpr float kC1 = 0.01f * 0.01f;
constexpr float kC2 = 0.03f * 0.03f;

struct Picture : Pictures {
    float* gradient;            // or null
    double* row_l1;
    double* row_ssim;
    float weights[kTaps];
};

// The buffers of one strip. Rows are `stride` floats, of which the first `kPad` and those after `used` stay zero.
struct Strip {
    int first;    // first column in the buffers, pixels
    int used;     // number of floats in use
    int count;    // the same rounded up to whole vectors
    int stride;
    int skip;     // floats before the first column of the strip itself
    int own;      // floats of the strip itself
    float* gains;      // [count], and biases [count] behind
    float* sources;    // [kMoments][stride]
    float* moments;    // [kRing][kMoments][count]
    float* sources2;   // [kAdjoints][stride]
    float* adjoints;   // [kRing][kAdjoints][count]
    float* ssim;       // [kBatch][count]
};

inline int slot(int row) { return row & (kRing - 1); }

// out[i] = sum of weights[k] * in[i + 3 (k - 5)] for rows with zeros around them.
inline void blur_across(const float* weights, const float* in, float* out, int count) {
    for (int i = 0; i < count; i += kLanes) {
        vf sum = splat(weights[0]) * load(in + i);
        for (int k = 1; k < kTaps; ++k) sum += splat(weights[k]) * load(in + i + kChannels * k);
        store(out + i, sum);
    }
}

// Four rows of one map at one column: rows[j] is row (first - 5 + j).
inline void blur_down(const float* weights, const float* const* rows, int at, vf (&sums)[kBatch]) {
    for (int r = 0; r < kBatch; ++r) sums[r] = splat(0.0f);
#pragma GCC unroll 14
    for (int j = 0; j < kReach; ++j) {
        const vf value = load(rows[j] + at);
#pragma GCC unroll 4
        for (int r = 0; r < kBatch; ++r)
            if (j >= r && j - r < kTaps) sums[r] += splat(weights[j - r]) * value;
    }
}

// Reads picture row `row`, computes its products and blurs them horizontally into the ring. Rows outside are zero.
void take_row(const Picture& p, const Strip& s, int row, bool count_l1) {
    float* out = s.moments + static_cast<size_t>(slot(row)) * kMoments * s.count;
    if (row < 0 || row >= p.height) {
        std::memset(out, 0, sizeof(float) * kMoments * s.count);
        return;
    }
    const size_t at = (static_cast<size_t>(row) * p.width + s.first) * kChannels;
    float* x = s.sources + kPad;
    float* y = x + s.stride;
    float* squares = y + s.stride;
    float* product = squares + s.stride;
    std::memcpy(x, p.image + at, sizeof(float) * s.used);
    if (p.gains != nullptr)
        for (int i = 0; i < s.used; ++i) x[i] = x[i] * s.gains[i] + s.gains[s.count + i];
    if (p.target != nullptr) {
        std::memcpy(y, p.target + at, sizeof(float) * s.used);
    } else {
        const uint8_t* bytes = p.target_u8 + at;
        for (int i = 0; i < s.used; ++i) y[i] = static_cast<float>(bytes[i]) / 255.0f;
    }
    for (int i = 0; i < s.count; i += kLanes) {  // x and y are zero from `used` on
        const vf a = load(x + i), b = load(y + i);
        store(squares + i, a * a + b * b);
        store(product + i, a * b);
    }
    if (count_l1) {
        float partial[kLanes] = {};
        int i = s.skip;
        const int end = s.skip + s.own;
        vf sum = splat(0.0f);
        for (; i + kLanes <= end; i += kLanes) sum += absolute(load(x + i) - load(y + i));
        store(partial, sum);
        double total = 0.0;
        for (int lane = 0; lane < kLanes; ++lane) total += partial[lane];
        for (; i < end; ++i) total += x[i] < y[i] ? y[i] - x[i] : x[i] - y[i];
        p.row_l1[row] += total;
    }
    for (int m = 0; m < kMoments; ++m)
        blur_across(p.weights, s.sources + m * s.stride, out + m * s.count, s.count);
}

double sum_of(const float* values, int count) {
    float partial[kLanes];
    vf sum = splat(0.0f);
    int i = 0;
    for (; i + kLanes <= count; i += kLanes) sum += load(values + i);
    store(partial, sum);
    double total = 0.0;
    for (int lane = 0; lane < kLanes; ++lane) total += partial[lane];
    for (; i < count; ++i) total += values[i];
    return total;
}

// SSIM from the moments of rows first ... first + 3; with Adjoint also its derivatives, blurred horizontally into their
// ring.
template <bool Adjoint>
void take_batch(const Picture& p, const Strip& s, int first, int own_first, int own_end) {
    const float* rows[kMoments][kReach];
    for (int m = 0; m < kMoments; ++m)
        for (int j = 0; j < kReach; ++j)
            rows[m][j] = s.moments + (static_cast<size_t>(slot(first - kHalf + j)) * kMoments + m) * s.count;
    float* maps = s.sources2 + kPad;  // [kBatch][kAdjoints][stride]
    for (int i = 0; i < s.count; i += kLanes) {
        vf a[kBatch], b[kBatch], squares[kBatch], product[kBatch];
        blur_down(p.weights, rows[0], i, a);
        blur_down(p.weights, rows[1], i, b);
        blur_down(p.weights, rows[2], i, squares);
        blur_down(p.weights, rows[3], i, product);
        for (int r = 0; r < kBatch; ++r) {
            const vf ab = a[r] * b[r], aabb = a[r] * a[r] + b[r] * b[r];
            const vf a1 = 2.0f * ab + kC1, a2 = 2.0f * (product[r] - ab) + kC2;
            const vf b1 = aabb + kC1, b2 = squares[r] - aabb + kC2;
            const vf inverse = splat(1.0f) / (b1 * b2);
            const vf value = a1 * a2 * inverse;
            store(s.ssim + r * s.count + i, value);
            if (Adjoint) {
                float* out = maps + static_cast<size_t>(r) * kAdjoints * s.stride + i;
                store(out, 2.0f * inverse * (b[r] * (a2 - a1) - a[r] * value * (b2 - b1)));
                store(out + s.stride, -2.0f * value * b1 * inverse);
                store(out + 2 * s.stride, 2.0f * a1 * inverse);
            }
        }
    }
    for (int r = 0; r < kBatch; ++r) {
        const int row = first + r;
        if (row >= own_first && row < own_end) p.row_ssim[row] += sum_of(s.ssim + r * s.count + s.skip, s.own);
        if (!Adjoint) continue;
        float* out = s.adjoints + static_cast<size_t>(slot(row)) * kAdjoints * s.count;
        if (row < 0 || row >= p.height) {
            std::memset(out, 0, sizeof(float) * kAdjoints * s.count);
            continue;
        }
        for (int m = 0; m < kAdjoints; ++m) {
            float* map = maps + (static_cast<size_t>(r) * kAdjoints + m) * s.stride;
            std::memset(map + s.used, 0, sizeof(float) * (s.count - s.used));
            blur_across(p.weights, map - kPad, out + m * s.count, s.count);
        }
    }
}

// The picture's gradient in rows first ... first + 3, of the sum of SSIM times `scale`.
void give_batch(const Picture& p, const Strip& s, int first, int end, float scale, float* scratch) {
    const float* rows[kAdjoints][kReach];
    for (int m = 0; m < kAdjoints; ++m)
        for (int j = 0; j < kReach; ++j)
            rows[m][j] = s.adjoints + (static_cast<size_t>(slot(first - kHalf + j)) * kAdjoints + m) * s.count;
    for (int i = 0; i < s.count; i += kLanes) {
        for (int m = 0; m < kAdjoints; ++m) {
            vf sums[kBatch];
            blur_down(p.weights, rows[m], i, sums);
            for (int r = 0; r < kBatch; ++r) store(scratch + (r * kAdjoints + m) * s.count + i, sums[r]);
        }
    }
    for (int r = 0; r < kBatch && first + r < end; ++r) {
        const size_t at = (static_cast<size_t>(first + r) * p.width + s.first) * kChannels + s.skip;
        const float* mean = scratch + r * kAdjoints * s.count + s.skip;
        const float* square = mean + s.count;
        const float* product = square + s.count;
        const float* x = p.image + at;
        float* out = p.gradient + at;
        const float* gain = s.gains + s.skip;
        const float* bias = gain + s.count;
        if (p.target != nullptr) {
            const float* y = p.target + at;
            for (int i = 0; i < s.own; ++i)
                out[i] = scale * gain[i] * (mean[i] + (x[i] * gain[i] + bias[i]) * square[i] + y[i] * product[i]);
        } else {
            const uint8_t* y = p.target_u8 + at;
            for (int i = 0; i < s.own; ++i)
                out[i] = scale * gain[i] * (mean[i] + (x[i] * gain[i] + bias[i]) * square[i] +
                                            static_cast<float>(y[i]) / 255.0f * product[i]);
        }
    }
}

void band(const Picture& p, const Part& own) {
    const int top = own.top, bottom = own.bottom, width = own.right - own.left;
    const int strips = std::max(1, (width + kStripPixels - 1) / kStripPixels);
    const int most = std::min(p.width, (width + strips - 1) / strips + 4 * kHalf) * kChannels;
    const int most_count = (most + kLanes - 1) / kLanes * kLanes;
    const int most_stride = most_count + 2 * kPad + kLanes;
    const size_t sizes[] = {
        static_cast<size_t>(2) * most_count,
        static_cast<size_t>(kMoments) * most_stride,        static_cast<size_t>(kRing) * kMoments * most_count,
        static_cast<size_t>(kBatch) * kAdjoints * most_stride, static_cast<size_t>(kRing) * kAdjoints * most_count,
        static_cast<size_t>(kBatch) * most_count,           static_cast<size_t>(kBatch) * kAdjoints * most_count,
    };
    size_t total = 0;
    for (const size_t size : sizes) total += size;
    const Buffer memory(total);
    const float scale = 1.0f / (static_cast<float>(p.height) * p.width * kChannels);
    for (int n = 0; n < strips; ++n) {
        const int begin = own.left + static_cast<int>(static_cast<int64_t>(width) * n / strips);
        const int end = own.left + static_cast<int>(static_cast<int64_t>(width) * (n + 1) / strips);
        Strip s;
        s.first = std::max(0, begin - 2 * kHalf);
        s.used = (std::min(p.width, end + 2 * kHalf) - s.first) * kChannels;
        s.count = (s.used + kLanes - 1) / kLanes * kLanes;
        s.stride = s.count + 2 * kPad + kLanes;
        s.skip = (begin - s.first) * kChannels;
        s.own = (end - begin) * kChannels;
        float* next = memory.get();
        s.gains = next, next += sizes[0];
        s.sources = next, next += sizes[1];
        s.moments = next, next += sizes[2];
        s.sources2 = next, next += sizes[3];
        s.adjoints = next, next += sizes[4];
        s.ssim = next, next += sizes[5];
        float* scratch = next;
        std::memset(s.sources, 0, sizeof(float) * sizes[1]);
        std::memset(s.sources2, 0, sizeof(float) * sizes[3]);
        for (int i = 0; i < s.count; ++i) {
            s.gains[i] = p.gains != nullptr ? p.gains[i % kChannels] : 1.0f;
            s.gains[s.count + i] = p.gains != nullptr ? p.biases[i % kChannels] : 0.0f;
        }

        const bool adjoint = p.gradient != nullptr;
        const int start = adjoint ? top - (kLead - kHalf) : top;  // the first batch of moments
        const int stop = adjoint ? bottom + kHalf : bottom;
        int read = start - kHalf;
        for (int first = start; first < stop; first += kBatch) {
            for (; read < first + kBatch + kHalf; ++read) take_row(p, s, read, read >= top && read < bottom);
            if (adjoint) {
                take_batch<true>(p, s, first, top, bottom);
                if (first - kHalf >= top) give_batch(p, s, first - kHalf, bottom, scale, scratch);
            } else {
                take_batch<false>(p, s, first, top, bottom);
            }
        }
    }
}

}  // namespace

// Sums of every row of every part, and the gradient of SSIM in the parts (or none).
void l1_ssim(const Pictures& pictures, const Part* parts, int count, float* gradient, int threads) {
    Picture p{pictures, gradient, nullptr, nullptr, {}};
    double weights[kTaps], total = 0.0;
    for (int k = 0; k < kTaps; ++k) {
        weights[k] = std::exp(-(k - kHalf) * (k - kHalf) / (2.0 * kSigma * kSigma));
        total += weights[k];
    }
    for (int k = 0; k < kTaps; ++k) p.weights[k] = static_cast<float>(weights[k] / total);
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1) if (threads > 1 && count > 1)
    for (int n = 0; n < count; ++n) {
        Picture mine = p;
        mine.row_l1 = parts[n].row_l1 - parts[n].top;
        mine.row_ssim = parts[n].row_ssim - parts[n].top;
        band(mine, parts[n]);
    }
}

// gradient = gain * l1_scale * sign(gain * image + bias - target) + ssim_scale * ssim_gradient, in the parts.
void l1_ssim_backward(
    const Pictures& p, const Part* parts, int count, const float* ssim_gradient, float l1_scale, float ssim_scale,
    float* gradient, int threads) {
    std::vector<float> gains(p.width * kChannels, 1.0f), biases(p.width * kChannels, 0.0f);  // of the numbers of a row
    if (p.gains != nullptr)
        for (int i = 0; i < p.width * kChannels; ++i) gains[i] = p.gains[i % kChannels], biases[i] = p.biases[i % kChannels];
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1) if (threads > 1 && count > 1)
    for (int n = 0; n < count; ++n) {
        const Part& part = parts[n];
        for (int row = part.top; row < part.bottom; ++row) {
            const size_t first = static_cast<size_t>(row) * p.width * kChannels;
            const auto give = [&](auto target) {
                for (int i = part.left * kChannels; i < part.right * kChannels; ++i) {
                    const float y = target(first + i), x = p.image[first + i] * gains[i] + biases[i];
                    const float sign = static_cast<float>(x > y) - static_cast<float>(x < y);
                    gradient[first + i] = gains[i] * l1_scale * sign + ssim_scale * ssim_gradient[first + i];
                }
            };
            if (p.target != nullptr)
                give([&](size_t i) { return p.target[i]; });
            else
                give([&](size_t i) { return static_cast<float>(p.target_u8[i]) / 255.0f; });
        }
    }
}

}  // namespace SGS_ISA
}  // namespace structgstream
