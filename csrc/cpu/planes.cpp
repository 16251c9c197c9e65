// SPDX-License-Identifier: Apache-2.0
// Correlation of a picture with its neighbours, warped through planes. Lanes are pixels of a row.

#include <algorithm>
#include <vector>

#include "mask.h"
#include "planes.h"
#include "vec.h"

namespace structgstream {
namespace SGS_ISA {
namespace {

constexpr float kLeastDepth = 1e-6f;
constexpr float kUnseen = -1.0f;

inline vf gather(const float* from, vi at) {
#if defined(__AVX512F__)
    return (vf)_mm512_mask_i32gather_ps((__m512)splat(0.0f), 0xffff, (__m512i)at, from, 4);
#elif defined(__AVX2__)
    return (vf)_mm256_i32gather_ps(from, (__m256i)at, 4);
#else
    vf found;
    for (int i = 0; i < kLanes; ++i) found[i] = from[at[i]];
    return found;
#endif
}

// Pictures with room for whole vectors at the end of their rows.
struct Size {
    int height, width, stride;
    Size(int height, int width) : height(height), width(width), stride((width + kLanes - 1) / kLanes * kLanes) {}
    size_t count() const { return static_cast<size_t>(height) * stride; }
};

// The terms of a window's sums.
enum Sum { kValue, kSquare, kProduct, kSeen, kSums };

struct Scratch {
    Buffer warped, seen, line, sums, scores;  // the first two have one row, `sums` has as many as a window
    Scratch(const Size& size, int window, int neighbours)
        : warped(size.stride),
          seen(size.stride),
          line(size.stride + window + kLanes),
          sums(static_cast<size_t>(kSums) * window * size.stride),
          scores(neighbours * size.count()) {}
};

// The row or column inside the picture that one outside repeats; the edge itself is repeated, too.
int reflected(int place, int length) {
    while (place < 0 || place >= length) place = place < 0 ? -1 - place : 2 * length - 1 - place;
    return place;
}

// Bilinear samples of a neighbour for one row, and 1 if all four pixels exist and the point is in front of the camera; else 0
// for both.
void warp(const sgs_neighbour& from, const double* h, const Size& size, int row, float* warped, float* seen) {
    vf lane;
    for (int i = 0; i < kLanes; ++i) lane[i] = static_cast<float>(i);
    const vf last_x = splat(static_cast<float>(from.width - 1)), last_y = splat(static_cast<float>(from.height - 1));
    const vi right = vi{} + (from.width > 1 ? 1 : 0), down = vi{} + (from.height > 1 ? from.width : 0);
    const vi most_x = vi{} + std::max(0, from.width - 2), most_y = vi{} + std::max(0, from.height - 2);
    for (int column = 0; column < size.width; column += kLanes) {
        // The position of the first lane is computed in double, so that those of all lanes are exact to 0.001.
        const double x0 = h[0] * column + h[1] * row + h[2], y0 = h[3] * column + h[4] * row + h[5];
        const double z0 = h[6] * column + h[7] * row + h[8];
        const vf z = static_cast<float>(z0) + lane * static_cast<float>(h[6]);
        const vf inverse = 1.0f / z;
        const vf x = (static_cast<float>(x0) + lane * static_cast<float>(h[0])) * inverse;
        const vf y = (static_cast<float>(y0) + lane * static_cast<float>(h[3])) * inverse;
        mask inside = above(z, splat(kLeastDepth));
        inside = both(inside, both(at_least(x, splat(0.0f)), at_least(last_x, x)));
        inside = both(inside, both(at_least(y, splat(0.0f)), at_least(last_y, y)));
        float* const to = warped + column;
        float* const to_seen = seen + column;
        if (!any(inside)) {
            store(to, splat(0.0f)), store(to_seen, splat(0.0f));
            continue;
        }
        const vf px = keep(inside, x), py = keep(inside, y);
        vi left = __builtin_convertvector(px, vi), top = __builtin_convertvector(py, vi);
        left = left < most_x ? left : most_x, top = top < most_y ? top : most_y;
        const vf fx = px - __builtin_convertvector(left, vf), fy = py - __builtin_convertvector(top, vf);
        const vi at = top * from.width + left;
        const vf a = gather(from.picture, at), b = gather(from.picture, at + right);
        const vf c = gather(from.picture, at + down), d = gather(from.picture, at + down + right);
        const vf above_it = a + fx * (b - a), below_it = c + fx * (d - c);
        store(to, keep(inside, above_it + fy * (below_it - above_it)));
        store(to_seen, keep(inside, splat(1.0f)));
    }
}

// Sums of `window` neighbours in a row: out[x] = the sum of in[x - reach ... x + reach], reflected at the ends.
template <typename Value>
void sum_across(const Size& size, int window, float* line, float* out, Value value) {
    const int reach = window / 2;
    for (int column = 0; column < size.width; column += kLanes) store(line + reach + column, value(column));
    for (int i = 1; i <= reach; ++i) {
        line[reach - i] = line[reach + reflected(-i, size.width)];
        line[reach + size.width - 1 + i] = line[reach + reflected(size.width - 1 + i, size.width)];
    }
    for (int column = 0; column < size.width; column += kLanes) {
        vf sum = load(line + column);
        for (int i = 1; i < window; ++i) sum += load(line + column + i);
        store(out + column, sum);
    }
}

// Sums over windows, of which `sums` keeps as many rows as one needs. `across(row, value)` is called for every row with a
// function that gives the place for the sums along that row of each value; `use(row, rows)` as soon as all rows of a window
// are there, with those of the first value from top to bottom, then of the second.
template <typename Across, typename Use>
void over_windows(const Size& size, int window, int values, float* sums, Across across, Use use) {
    const int reach = window / 2;
    std::vector<const float*> rows(static_cast<size_t>(values) * window);
    const auto place = [&](int value, int row) {
        return sums + (static_cast<size_t>(value) * window + row % window) * size.stride;
    };
    for (int row = 0; row < size.height + reach; ++row) {
        if (row < size.height) across(row, [&](int value) { return place(value, row); });
        if (row < reach) continue;
        for (int i = 0; i < window; ++i)
            for (int value = 0; value < values; ++value)
                rows[value * window + i] = place(value, reflected(row - 2 * reach + i, size.height));
        use(row - reach, rows.data());
    }
}

// Mean over a window at one column of its rows of sums.
inline vf mean_down(const float* const* rows, int window, int column) {
    vf sum = splat(0.0f);
    for (int i = 0; i < window; ++i) sum += load(rows[i] + column);
    return sum * (1.0f / static_cast<float>(window * window));
}

// Means over windows of the picture, and variances plus noise.
struct Statistics {
    Buffer grey, mean, variance;
    Statistics(const PlaneSweep& sweep, const Size& size, Scratch& scratch)
        : grey(size.count()), mean(size.count()), variance(size.count()) {
        const int window = sweep.window;
        std::fill_n(grey.get(), size.count(), 0.0f);
        const auto across = [&](int row, auto place) {
            float* const g = grey.get() + static_cast<size_t>(row) * size.stride;
            std::copy_n(sweep.picture + static_cast<size_t>(row) * size.width, size.width, g);
            sum_across(size, window, scratch.line.get(), place(kValue), [&](int x) { return load(g + x); });
            sum_across(size, window, scratch.line.get(), place(kSquare), [&](int x) { return load(g + x) * load(g + x); });
        };
        over_windows(size, window, 2, scratch.sums.get(), across, [&](int row, const float* const* rows) {
            for (int column = 0; column < size.width; column += kLanes) {
                const size_t at = static_cast<size_t>(row) * size.stride + column;
                const vf m = mean_down(rows + kValue * window, window, column);
                store(mean.get() + at, m);
                store(variance.get() + at, mean_down(rows + kSquare * window, window, column) - m * m + sweep.noise);
            }
        });
    }
};

// Zero-mean normalised cross-correlation with one neighbour through the homography `h`; kUnseen if it does not see the whole
// window.
void correlate(
    const PlaneSweep& sweep, const Size& size, const Statistics& of, const sgs_neighbour& neighbour, const double* h,
    Scratch& scratch, float* scores) {
    const int window = sweep.window;
    const auto across = [&](int row, auto place) {
        float *const w = scratch.warped.get(), *const s = scratch.seen.get(), *const line = scratch.line.get();
        const float* const g = of.grey.get() + static_cast<size_t>(row) * size.stride;
        warp(neighbour, h, size, row, w, s);
        sum_across(size, window, line, place(kValue), [&](int x) { return load(w + x); });
        sum_across(size, window, line, place(kSquare), [&](int x) { return load(w + x) * load(w + x); });
        sum_across(size, window, line, place(kProduct), [&](int x) { return load(w + x) * load(g + x); });
        sum_across(size, window, line, place(kSeen), [&](int x) { return load(s + x); });
    };
    const vf noise = splat(sweep.noise), least = splat(sweep.noise * sweep.noise);
    const vf all = splat(1.0f - 0.5f / static_cast<float>(window * window));
    over_windows(size, window, kSums, scratch.sums.get(), across, [&](int row, const float* const* rows) {
        for (int column = 0; column < size.width; column += kLanes) {
            const size_t at = static_cast<size_t>(row) * size.stride + column;
            const vf mean = mean_down(rows + kValue * window, window, column);
            const vf covariance = mean_down(rows + kProduct * window, window, column) - load(of.mean.get() + at) * mean;
            const vf variance = mean_down(rows + kSquare * window, window, column) - mean * mean + noise;
            const vf both_variances = largest(load(of.variance.get() + at) * variance, least);
            const mask whole = at_least(mean_down(rows + kSeen * window, window, column), all);
            store(scores + at, choose(whole, covariance / square_root(both_variances), splat(kUnseen)));
        }
    });
}

// The mean of the better half of the neighbours. One that does not see the plane counts half of the best.
void combine(const PlaneSweep& sweep, const Size& size, const float* scores, float* out) {
    const int count = std::max(1, (sweep.neighbour_count + 1) / 2);
    std::vector<float> result(size.stride);
    Buffer best(static_cast<size_t>(count) * kLanes);
    for (int row = 0; row < size.height; ++row) {
        for (int column = 0; column < size.width; column += kLanes) {
            const size_t at = static_cast<size_t>(row) * size.stride + column;
            for (int k = 0; k < count; ++k) store(best.get() + k * kLanes, splat(-2.0f));
            for (int n = 0; n < sweep.neighbour_count; ++n) {
                vf value = load(scores + n * size.count() + at);
                for (int k = 0; k < count; ++k) {
                    const vf held = load(best.get() + k * kLanes);
                    store(best.get() + k * kLanes, largest(held, value));
                    value = smallest(held, value);
                }
            }
            const vf first = load(best.get());
            vf sum = splat(0.0f);
            for (int k = 0; k < count; ++k) {
                const vf value = load(best.get() + k * kLanes);
                sum += choose(at_least(splat(kUnseen), value), 0.5f * first, value);
            }
            store(result.data() + column, sum * (1.0f / static_cast<float>(count)));
        }
        std::copy_n(result.data(), size.width, out + static_cast<size_t>(row) * size.width);
    }
}

}  // namespace

void plane_scores(const PlaneSweep& sweep) {
    const Size size(sweep.height, sweep.width);
    Scratch scratch(size, sweep.window, sweep.neighbour_count);
    const Statistics statistics(sweep, size, scratch);
    for (int64_t plane = 0; plane < sweep.planes; ++plane) {
        for (int n = 0; n < sweep.neighbour_count; ++n) {
            const double* h = sweep.homographies + 9 * (plane * sweep.neighbour_count + n);
            correlate(sweep, size, statistics, sweep.neighbours[n], h, scratch, scratch.scores.get() + n * size.count());
        }
        combine(sweep, size, scratch.scores.get(), sweep.scores + plane * size.height * size.width);
    }
}

}  // namespace SGS_ISA
}  // namespace structgstream
