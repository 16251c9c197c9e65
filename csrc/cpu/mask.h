// SPDX-License-Identifier: Apache-2.0
// Comparisons with the native result type of the instruction set: a mask register on AVX-512, lanes of ones elsewhere.
#pragma once

#include <cmath>

#include "vec.h"

namespace structgstream {
namespace SGS_ISA {

#if defined(__AVX512F__)

typedef __mmask16 mask;
inline mask at_least(vf a, vf b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GE_OQ); }
inline mask above(vf a, vf b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_GT_OQ); }
inline mask differs(vf a, vf b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, _CMP_NEQ_UQ); }
inline mask both(mask a, mask b) { return a & b; }
inline mask either(mask a, mask b) { return a | b; }
inline mask without(mask a, mask b) { return a & static_cast<mask>(~b); }
inline bool any(mask m) { return m != 0; }
inline uint32_t bits(mask m) { return m; }
inline vf choose(mask m, vf a, vf b) { return (vf)_mm512_mask_blend_ps(m, (__m512)b, (__m512)a); }
inline vf keep(mask m, vf a) { return (vf)_mm512_maskz_mov_ps(m, (__m512)a); }
inline void store_first(float* p, vf v, int lanes) {  // the first lanes only
    _mm512_mask_storeu_ps(p, static_cast<mask>((1u << lanes) - 1), (__m512)v);
}

#else

typedef vi mask;
inline mask at_least(vf a, vf b) { return a >= b; }
inline mask above(vf a, vf b) { return a > b; }
inline mask differs(vf a, vf b) { return a != b; }
inline mask both(mask a, mask b) { return a & b; }
inline mask either(mask a, mask b) { return a | b; }
inline mask without(mask a, mask b) { return a & ~b; }
inline vf choose(mask m, vf a, vf b) { return (vf)(((vi)a & m) | ((vi)b & ~m)); }
inline vf keep(mask m, vf a) { return (vf)((vi)a & m); }
inline void store_first(float* p, vf v, int lanes) {  // the first lanes only
    if (lanes == kLanes) return store(p, v);
    for (int i = 0; i < lanes; ++i) p[i] = v[i];
}

// A bit for each lane.
inline uint32_t bits(mask m) {
#if defined(__AVX__)
    return _mm256_movemask_ps((__m256)m);
#elif defined(__SSE2__)
    return _mm_movemask_ps((__m128)m);
#else
    uint32_t found = 0;
    for (int i = 0; i < kLanes; ++i) found |= uint32_t(m[i] != 0) << i;
    return found;
#endif
}

inline bool any(mask m) { return bits(m) != 0; }

#endif

inline vf square_root(vf x) {
#if defined(__AVX512F__)
    return (vf)_mm512_maskz_sqrt_ps(0xffff, (__m512)x);
#elif defined(__AVX__)
    return (vf)_mm256_sqrt_ps((__m256)x);
#elif defined(__SSE2__)
    return (vf)_mm_sqrt_ps((__m128)x);
#else
    for (int i = 0; i < kLanes; ++i) x[i] = std::sqrt(x[i]);
    return x;
#endif
}

// 1 / x to about one unit in the last place, for x far from underflow and overflow.
inline vf reciprocal(vf x) {
#if defined(__AVX512F__)
    const vf guess = (vf)_mm512_maskz_rcp14_ps(0xffff, (__m512)x);
    return guess * (2.0f - x * guess);
#elif defined(__AVX__)
    const vf guess = (vf)_mm256_rcp_ps((__m256)x);
    return guess * (2.0f - x * guess);
#else
    return splat(1.0f) / x;
#endif
}

}  // namespace SGS_ISA
}  // namespace structgstream
