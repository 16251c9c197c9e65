// SPDX-License-Identifier: Apache-2.0
// Difference of rows from their neighbours, and its gradient, in one pass over the pairs.

#include <cmath>
#include <cstdint>

#include "structgstream.h"

extern "C" double sgs_neighbour_difference(
    const float* values, const int64_t* neighbours, const float* shares, int64_t count, int64_t each, float slack,
    float* gradient) {
    double total = 0.0;
    for (int64_t i = 0; i < count; ++i) {
        const float* own = values + 3 * i;
        float sum = 0.0f, from[3] = {0.0f, 0.0f, 0.0f};
        for (int64_t n = each * i; n < each * (i + 1); ++n) {
            const float* other = values + 3 * neighbours[n];
            const float apart[3] = {other[0] - own[0], other[1] - own[1], other[2] - own[2]};
            const float length =
                std::sqrt(apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2] + slack * slack);
            sum += shares[n] * (length - slack);
            const float slope = shares[n] / length;
            float* onto = gradient + 3 * neighbours[n];
            for (int axis = 0; axis < 3; ++axis) {
                onto[axis] += slope * apart[axis];
                from[axis] += slope * apart[axis];
            }
        }
        for (int axis = 0; axis < 3; ++axis) gradient[3 * i + axis] -= from[axis];
        total += static_cast<double>(sum);
    }
    return total;
}
