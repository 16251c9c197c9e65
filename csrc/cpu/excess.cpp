// SPDX-License-Identifier: Apache-2.0
// Sum of the excess of scaled offsets over a limit, and its gradients; one pass over memory each.

#include <cmath>
#include <cstdint>

#include "structgstream.h"

extern "C" double sgs_excess(const float* offsets, const float* scales, int64_t anchors, int64_t each, float limit) {
    double total = 0.0;
    for (int64_t m = 0; m < anchors; ++m) {
        const float* scale = scales + 3 * m;
        float sum = 0.0f;
        for (int64_t i = 3 * each * m; i < 3 * each * (m + 1); i += 3)
            for (int axis = 0; axis < 3; ++axis) {
                const float beyond = std::fabs(offsets[i + axis] * scale[axis]) - limit;
                sum += beyond > 0.0f ? beyond : 0.0f;
            }
        total += static_cast<double>(sum);
    }
    return total;
}

extern "C" void sgs_excess_backward(
    const float* offsets, const float* scales, int64_t anchors, int64_t each, float limit, float factor,
    float* offset_gradient, float* log_scale_gradient) {
    for (int64_t m = 0; m < anchors; ++m) {
        const float* scale = scales + 3 * m;
        float sums[3] = {0.0f, 0.0f, 0.0f};
        for (int64_t i = 3 * each * m; i < 3 * each * (m + 1); i += 3)
            for (int axis = 0; axis < 3; ++axis) {
                const float reach = offsets[i + axis] * scale[axis];
                const float sign = reach > limit ? factor : reach < -limit ? -factor : 0.0f;
                offset_gradient[i + axis] = sign * scale[axis];
                sums[axis] += sign * reach;
            }
        for (int axis = 0; axis < 3; ++axis) log_scale_gradient[3 * m + axis] = sums[axis];
    }
}
