// SPDX-License-Identifier: Apache-2.0
// Vectors of floats with the width of the instruction set for which this file is compiled, and functions on them that the
// loss and the anchors need. They are compiler vectors without mask types, so one source suits every width.
#pragma once

#include <cstddef>
#include <cstdint>
#include <new>
#include <utility>

#if defined(__AVX512F__) || defined(__AVX__) || defined(__SSE2__)
#include <immintrin.h>
#endif

#ifndef SGS_ISA
#define SGS_ISA native
#endif

#if defined(__AVX512F__)
#define SGS_LANES 16
#elif defined(__AVX__)
#define SGS_LANES 8
#else
#define SGS_LANES 4
#endif

namespace structgstream {
namespace SGS_ISA {

constexpr int kLanes = SGS_LANES;
constexpr std::size_t kAlignment = 64;

typedef float vf __attribute__((vector_size(4 * SGS_LANES)));
typedef int32_t vi __attribute__((vector_size(4 * SGS_LANES)));
typedef float unaligned_vf __attribute__((vector_size(4 * SGS_LANES), aligned(4), may_alias));
typedef int32_t unaligned_vi __attribute__((vector_size(4 * SGS_LANES), aligned(4), may_alias));

inline vf load(const float* p) { return *reinterpret_cast<const unaligned_vf*>(p); }
inline vi load(const int32_t* p) { return *reinterpret_cast<const unaligned_vi*>(p); }
inline void store(float* p, vf v) { *reinterpret_cast<unaligned_vf*>(p) = v; }
inline void store(int32_t* p, vi v) { *reinterpret_cast<unaligned_vi*>(p) = v; }
inline vf splat(float x) { return x - vf{}; }
inline vf absolute(vf x) { return (vf)((vi)x & 0x7fffffff); }

// The second argument if they are equal or unordered, on every instruction set.
#if defined(__AVX512F__)
inline vf largest(vf a, vf b) { return (vf)_mm512_maskz_max_ps(0xffff, (__m512)a, (__m512)b); }
inline vf smallest(vf a, vf b) { return (vf)_mm512_maskz_min_ps(0xffff, (__m512)a, (__m512)b); }
#elif defined(__AVX__)
inline vf largest(vf a, vf b) { return (vf)_mm256_max_ps((__m256)a, (__m256)b); }
inline vf smallest(vf a, vf b) { return (vf)_mm256_min_ps((__m256)a, (__m256)b); }
#elif defined(__SSE2__)
inline vf largest(vf a, vf b) { return (vf)_mm_max_ps((__m128)a, (__m128)b); }
inline vf smallest(vf a, vf b) { return (vf)_mm_min_ps((__m128)a, (__m128)b); }
#else
inline vf largest(vf a, vf b) { return a > b ? a : b; }
inline vf smallest(vf a, vf b) { return a < b ? a : b; }
#endif

// e^x to about one unit in the last place; saturates instead of overflowing or returning denormal numbers.
inline vf exponential(vf x) {
    const vf clamped = smallest(largest(x, splat(-87.0f)), splat(88.0f));
    const vf magic = splat(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer in the low bits
    const vf rounded = clamped * 1.44269504f + magic;
    const vf n = rounded - magic;
    const vf r = (clamped - n * 0.693359375f) + n * 2.12194440e-4f;  // ln 2 in two parts
    vf p = splat(1.0f / 5040.0f);
    p = p * r + 1.0f / 720.0f;
    p = p * r + 1.0f / 120.0f;
    p = p * r + 1.0f / 24.0f;
    p = p * r + 1.0f / 6.0f;
    p = p * r + 0.5f;
    p = p * r + 1.0f;
    p = p * r + 1.0f;
    return (vf)((vi)p + ((vi)rounded << 23));  // the low bits of `rounded` hold n; its own exponent is shifted out
}

// log2 of a normal positive x = m 2^e with m in [sqrt(1/2), sqrt(2)), and log m = 2 atanh((m - 1) / (m + 1)).
inline vf log_two(vf x) {
    const vi shifted = (vi)x - 0x3f3504f3;
    const vi exponent = shifted >> 23;
    const vf m = (vf)((shifted & 0x007fffff) + 0x3f3504f3);
    const vf t = (m - 1.0f) / (m + 1.0f), tt = t * t;
    vf p = splat(1.0f / 9.0f);
    p = p * tt + 1.0f / 7.0f;
    p = p * tt + 1.0f / 5.0f;
    p = p * tt + 1.0f / 3.0f;
    p = p * tt + 1.0f;
    return __builtin_convertvector(exponent, vf) + 2.88539008f * t * p;
}

inline vf sigmoid(vf x) { return splat(1.0f) / (1.0f + exponential(-x)); }

// tanh with full relative precision near zero, because the sign of an opacity decides whether a Gaussian is drawn.
inline vf hyperbolic_tangent(vf x) {
    const vf size = absolute(x), z = x * x;
    vf p = splat(-5.704986e-3f);
    p = p * z + 2.0639087e-2f;
    p = p * z + -5.3739715e-2f;
    p = p * z + 1.3331442e-1f;
    p = p * z + -3.3333282e-1f;
    const vf small = x + x * z * p;
    const vf large = 1.0f - 2.0f / (exponential(2.0f * size) + 1.0f);
    const vf with_sign = (vf)((vi)large | ((vi)x & INT32_MIN));
    return size < 0.625f ? small : with_sign;
}

#if defined(__clang__)
#define SGS_SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define SGS_SHUFFLE(a, b, ...) __builtin_shuffle(a, b, vi{__VA_ARGS__})
#endif

// Interleaves `a` and `b` by groups of Step lanes: `low` has the even groups of both, `high` the odd ones.
template <int Step, int... Lane>
inline void interleave(vf a, vf b, vf& low, vf& high, std::integer_sequence<int, Lane...>) {
    low = SGS_SHUFFLE(a, b, (Lane & Step ? kLanes + Lane - Step : Lane)...);
    high = SGS_SHUFFLE(a, b, (Lane & Step ? kLanes + Lane : Lane + Step)...);
}

template <int Step>
inline void interleave(vf a, vf b, vf& low, vf& high) {
    interleave<Step>(a, b, low, high, std::make_integer_sequence<int, kLanes>{});
}

template <int Step = 1>
inline void transpose(vf (&rows)[kLanes]) {
    if constexpr (Step < kLanes) {
#pragma GCC unroll 16
        for (int i = 0; i < kLanes; ++i)
            if ((i & Step) == 0) interleave<Step>(rows[i], rows[i + Step], rows[i], rows[i + Step]);
        transpose<2 * Step>(rows);
    }
}

// Lane n of the result is the sum over the lanes of rows[n].
template <int Step = 1>
inline vf sums_of_lanes(vf (&rows)[kLanes]) {
    if constexpr (Step < kLanes) {
#pragma GCC unroll 8
        for (int n = 0; n < kLanes / 2 / Step; ++n) {
            vf low, high;
            interleave<Step>(rows[2 * n], rows[2 * n + 1], low, high);
            rows[n] = low + high;
        }
        return sums_of_lanes<2 * Step>(rows);
    }
    return rows[0];
}

// Memory on a cache line's border.
class Buffer {
  public:
    explicit Buffer(std::size_t floats)
        : data_(static_cast<float*>(::operator new(floats * sizeof(float) + 1, std::align_val_t{kAlignment}))) {}
    ~Buffer() { ::operator delete(data_, std::align_val_t{kAlignment}); }
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    float* get() const { return data_; }

  private:
    float* data_;
};

}  // namespace SGS_ISA
}  // namespace structgstream
