// SPDX-License-Identifier: Apache-2.0
// Sum of the products of each Gaussian's three scales, and its gradient; one pass over memory each.

#include <cstdint>

#include "structgstream.h"

extern "C" double sgs_volume(const float* scales, const float* opacities, int64_t count, int64_t* drawn) {
    double total = 0.0;
    int64_t found = 0;
    for (int64_t i = 0; i < count; ++i) {
        total += static_cast<double>(scales[3 * i] * scales[3 * i + 1] * scales[3 * i + 2]);
        found += opacities[i] > 0.0f;
    }
    *drawn = found;
    return total;
}

extern "C" void sgs_volume_backward(const float* scales, int64_t count, float scale, float* gradient) {
    for (int64_t i = 0; i < count; ++i) {
        const float x = scales[3 * i], y = scales[3 * i + 1], z = scales[3 * i + 2];
        gradient[3 * i] = scale * y * z;
        gradient[3 * i + 1] = scale * x * z;
        gradient[3 * i + 2] = scale * x * y;
    }
}
