// SPDX-License-Identifier: Apache-2.0
// Work of a thread for one displayed pixel; see kernels/reference_raster.py.
#pragma once

#include <cmath>

#include "element.h"
#include "picture.h"

namespace structgstream {
namespace cuda {

constexpr float kInvisible = 1.0f / 512.0f;  // environment.INVISIBLE
constexpr int kMostTerms = 9;

// Real spherical harmonics of a unit direction, `terms` of them (harmonics.py).
SGS_ELEMENT void harmonics(float x, float y, float z, int terms, float* found) {
    found[0] = 0.28209479177387814f;
    if (terms > 1) {
        constexpr float a = 0.48860251190291992f;
        found[1] = -a * y, found[2] = a * z, found[3] = -a * x;
    }
    if (terms > 4) {
        constexpr float a = 1.0925484305920792f, b = 0.31539156525252005f;
        found[4] = a * x * y, found[5] = -a * y * z, found[6] = b * (3.0f * z * z - 1.0f);
        found[7] = -a * x * z, found[8] = 0.5f * a * (x * x - y * y);
    }
}

struct Display {
    sgs_cuda_display_call call;

    SGS_ELEMENT void operator()(int64_t pixel) const {
        float color[3];
        for (int c = 0; c < 3; ++c) color[c] = call.image[3 * pixel + c];
        const float rest = call.environment == nullptr ? 0.0f : 1.0f - call.alpha[pixel];
        if (rest > kInvisible) {
            float behind[3];
            environment(pixel, behind);
            for (int c = 0; c < 3; ++c) color[c] += rest * behind[c];
        }
        for (int c = 0; c < 3; ++c)
            call.picture[3 * pixel + c] = static_cast<uint8_t>(rintf(255.0f * within(color[c])));
    }

    static SGS_ELEMENT float within(float value) { return fminf(fmaxf(value, 0.0f), 1.0f); }

    // The colour behind a pixel, in the direction of its centre.
    SGS_ELEMENT void environment(int64_t pixel, float* color) const {
        const int64_t row = pixel / call.width;
        const float x = static_cast<float>(pixel - row * call.width) + 0.5f, y = static_cast<float>(row) + 0.5f;
        const float* m = call.pixel_to_world;
        float ray[3], basis[kMostTerms];
        for (int i = 0; i < 3; ++i) ray[i] = x * m[i] + y * m[3 + i] + m[6 + i];
        const float scale = 1.0f / sqrtf(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]);
        harmonics(ray[0] * scale, ray[1] * scale, ray[2] * scale, call.terms, basis);
        for (int c = 0; c < 3; ++c) {
            float sum = 0.0f;
            for (int i = 0; i < call.terms; ++i) sum += basis[i] * call.environment[3 * i + c];
            color[c] = within(0.5f + sum);
        }
    }
};

}  // namespace cuda
}  // namespace structgstream
