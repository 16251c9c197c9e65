// SPDX-License-Identifier: Apache-2.0
// Bits of changes and their gradient, in one pass. Lanes are numbers.

#include <cstdint>
#include <cstring>

#include "mask.h"
#include "vec.h"

namespace structgstream {
namespace SGS_ISA {
namespace {

constexpr float kLog2E = 1.44269504f;
constexpr int kVectors = 64;  // number of vectors summed in single precision

double sum_of(vf lanes) {
    double total = 0.0;
    for (int i = 0; i < kLanes; ++i) total += static_cast<double>(lanes[i]);
    return total;
}

// log2(1 + |values - before| / step); `gradient` with respect to the values.
inline vf bits_of(vf values, vf before, float inverse_step, vf& gradient) {
    const vf difference = values - before;
    const vf ratio = 1.0f + absolute(difference) * inverse_step;
    const vf sign = (vf)(((vi)difference & INT32_MIN) | ((vi)splat(1.0f)));
    gradient = keep(differs(difference, splat(0.0f)), sign * (kLog2E * inverse_step) / ratio);
    return log_two(ratio);
}

}  // namespace

double change_bits(const float* values, const float* before, int64_t count, float step, float* gradient) {
    const float inverse_step = 1.0f / step;
    double total = 0.0;
    int64_t i = 0;
    while (i + kLanes <= count) {
        vf sum = splat(0.0f), slope;
        for (int n = 0; n < kVectors && i + kLanes <= count; ++n, i += kLanes) {
            sum += bits_of(load(values + i), load(before + i), inverse_step, slope);
            store(gradient + i, slope);
        }
        total += sum_of(sum);
    }
    if (i < count) {
        float rest[3][kLanes] = {};
        std::memcpy(rest[0], values + i, sizeof(float) * (count - i));
        std::memcpy(rest[1], before + i, sizeof(float) * (count - i));
        vf slope;
        total += sum_of(bits_of(load(rest[0]), load(rest[1]), inverse_step, slope));
        store(rest[2], slope);
        std::memcpy(gradient + i, rest[2], sizeof(float) * (count - i));
    }
    return total;
}

}  // namespace SGS_ISA
}  // namespace structgstream
