// SPDX-License-Identifier: Apache-2.0
// A warp of 32 lanes, written once: on a GPU a value is the register of one lane, on a CPU a vector of all 32.
#pragma once

#include <cmath>
#include <cstdint>

#include "element.h"

#ifdef __CUDACC__
#define SGS_LANES_FN __device__ __forceinline__
#else
#define SGS_LANES_FN inline
#endif

namespace structgstream {
namespace cuda {
namespace fit {

constexpr int kLanes = 32;
constexpr int kBlockX = 8, kBlockY = 4;  // pixels of a warp

#ifdef __CUDACC__

using vf = float;
using mask = bool;

SGS_LANES_FN int lane() { return static_cast<int>(threadIdx.x) & (kLanes - 1); }
SGS_LANES_FN vf splat(float x) { return x; }
SGS_LANES_FN vf lanes_x() { return static_cast<float>(lane() % kBlockX) + 0.5f; }
SGS_LANES_FN vf lanes_y() { return static_cast<float>(lane() / kBlockX) + 0.5f; }
SGS_LANES_FN mask at_least(vf a, vf b) { return a >= b; }
SGS_LANES_FN mask above(vf a, vf b) { return a > b; }
SGS_LANES_FN mask both(mask a, mask b) { return a && b; }
SGS_LANES_FN mask without(mask a, mask b) { return a && !b; }
SGS_LANES_FN bool any(mask m) { return __any_sync(0xffffffffu, m); }
SGS_LANES_FN vf keep(mask m, vf a) { return m ? a : 0.0f; }
SGS_LANES_FN vf choose(mask m, vf a, vf b) { return m ? a : b; }
SGS_LANES_FN vf smallest(vf a, vf b) { return fminf(a, b); }
SGS_LANES_FN vf reciprocal(vf a) { return 1.0f / a; }
SGS_LANES_FN vf power_of_two(vf a) { return exp2f(a); }
SGS_LANES_FN int lowest(uint32_t bits) { return __ffs(static_cast<int>(bits)) - 1; }

// A bit for each lane whose test is true.
template <typename Test>
SGS_LANES_FN uint32_t ballot(const Test& test) {
    return __ballot_sync(0xffffffffu, test(lane()));
}

// Calls visit(lane) for every lane; value_of and set read and write the value of that lane.
template <typename Visit>
SGS_LANES_FN void each_lane(const Visit& visit) {
    visit(lane());
}
SGS_LANES_FN float value_of(const vf& v, int) { return v; }
SGS_LANES_FN void set(vf& v, int, float value) { v = value; }

// out[k] = sum of m[k] over the lanes. Every exchange halves the number of values that a lane holds.
template <int Count>
SGS_LANES_FN void store_sums(const vf (&m)[Count], float* out) {
    static_assert(Count <= 16, "sixteen values for 32 lanes");
    float v[16];
#pragma unroll
    for (int k = 0; k < 16; ++k) v[k] = k < Count ? m[k] : 0.0f;
    int mine = 0;
#pragma unroll
    for (int half = 8, distance = 16; half >= 1; half >>= 1, distance >>= 1) {
        const bool upper = (lane() & distance) != 0;
#pragma unroll
        for (int k = 0; k < half; ++k) {
            const float sent = upper ? v[k] : v[k + half], kept = upper ? v[k + half] : v[k];
            v[k] = kept + __shfl_xor_sync(0xffffffffu, sent, distance);
        }
        mine += upper ? half : 0;
    }
    v[0] += __shfl_xor_sync(0xffffffffu, v[0], 1);
    if (mine < Count && (lane() & 1) == 0) out[mine] = v[0];
}

#else

using vf = float __attribute__((vector_size(4 * kLanes)));
using mask = int32_t __attribute__((vector_size(4 * kLanes)));

inline vf splat(float x) { return x - vf{}; }
inline vf lanes_x() {
    vf v;
    for (int i = 0; i < kLanes; ++i) v[i] = static_cast<float>(i % kBlockX) + 0.5f;
    return v;
}
inline vf lanes_y() {
    vf v;
    for (int i = 0; i < kLanes; ++i) v[i] = static_cast<float>(i / kBlockX) + 0.5f;
    return v;
}
inline mask at_least(vf a, vf b) { return a >= b; }
inline mask above(vf a, vf b) { return a > b; }
inline mask both(mask a, mask b) { return a & b; }
inline mask without(mask a, mask b) { return a & ~b; }
inline bool any(mask m) {
    int32_t found = 0;
    for (int i = 0; i < kLanes; ++i) found |= m[i];
    return found != 0;
}
inline vf keep(mask m, vf a) { return (vf)((mask)a & m); }
inline vf choose(mask m, vf a, vf b) { return (vf)(((mask)a & m) | ((mask)b & ~m)); }
inline vf smallest(vf a, vf b) { return choose(a < b, a, b); }
inline vf reciprocal(vf a) { return 1.0f / a; }
inline vf power_of_two(vf a) {
    for (int i = 0; i < kLanes; ++i) a[i] = std::exp2(a[i]);
    return a;
}
inline int lowest(uint32_t bits) { return __builtin_ctz(bits); }

template <typename Test>
uint32_t ballot(const Test& test) {
    uint32_t found = 0;
    for (int i = 0; i < kLanes; ++i) found |= static_cast<uint32_t>(test(i) ? 1 : 0) << i;
    return found;
}

template <typename Visit>
void each_lane(const Visit& visit) {
    for (int i = 0; i < kLanes; ++i) visit(i);
}
inline float value_of(const vf& v, int lane) { return v[lane]; }
inline void set(vf& v, int lane, float value) { v[lane] = value; }

template <int Count>
void store_sums(const vf (&m)[Count], float* out) {
    for (int k = 0; k < Count; ++k) {
        vf v = m[k];
        for (int distance = kLanes / 2; distance > 0; distance >>= 1)
            for (int i = 0; i < distance; ++i) v[i] += v[i + distance];
        out[k] = v[0];
    }
}

#endif

}  // namespace fit
}  // namespace cuda
}  // namespace structgstream
