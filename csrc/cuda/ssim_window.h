// SPDX-License-Identifier: Apache-2.0
// Host side of a launch: the pictures and the window's weights as one value.
#pragma once

#include <cmath>

#include "ssim_phases.h"

namespace structgstream {
namespace cuda {

inline Pictures pictures_of(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles) {
    Pictures p = {image, target, target_u8, gains, biases, tiles, height, width, {}};
    constexpr double kSigma = 1.5;
    double weights[kTaps], total = 0.0;
    for (int i = 0; i < kTaps; ++i) {
        const double distance = (i - kHalf) / kSigma;
        total += weights[i] = std::exp(-0.5 * distance * distance);
    }
    for (int i = 0; i < kTaps; ++i) p.weights[i] = static_cast<float>(weights[i] / total);
    return p;
}

}  // namespace cuda
}  // namespace structgstream
