// SPDX-License-Identifier: Apache-2.0
// The interface of ssim.h: the phases of ssim_phases.h in their order. ssim.cu compiles it for a GPU, emulate_fit.cpp for a
// CPU.
#pragma once

#include <cmath>

#include "block.h"
#include "ssim.h"
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

inline int tiles_in(const Pictures& p) { return tiles_along(p.height) * tiles_along(p.width); }

SGS_PHASE Tile tile_of(const Pictures& p, int block) {
    const int columns = tiles_along(p.width);
    return {block / columns, block % columns, tiles_along(p.height), columns};
}

struct ForwardBlock {
    static constexpr int kThreads = cuda::kThreads;
    using Shared = ForwardShared;
    Forward f;

    SGS_LANES_FN void operator()(int block, Shared& s, const fit::Threads& threads) const {
        const Tile tile = tile_of(f.pictures, block);
        if (!(f.adjoints == nullptr ? counts(f.pictures, tile) : counts_nearby(f.pictures, tile))) {
            threads.each([&](int t) { forward_skip(f, tile, t); });
            return;
        }
        threads.each([&](int t) { forward_read(f, tile, s, t); });
        threads.each([&](int t) { forward_across(f, s, t); });
        threads.each([&](int t) { forward_down(f, tile, s, t); });
        threads.each([&](int t) { forward_gather(s, t); });
        threads.each([&](int t) { forward_give(f, tile, s, t); });
    }
};

struct SumBlock {
    static constexpr int kThreads = kSumThreads;
    using Shared = SumShared;
    const float* sums;
    int count;
    double numbers;
    float* means;

    SGS_LANES_FN void operator()(int, Shared& s, const fit::Threads& threads) const {
        threads.each([&](int t) { sum_read(sums, count, s, t); });
        for (int half = kSumThreads / 2; half > 0; half /= 2) threads.each([&](int t) { sum_fold(s, half, t); });
        threads.each([&](int t) { sum_give(s, numbers, means, t); });
    }
};

struct BackwardBlock {
    static constexpr int kThreads = cuda::kThreads;
    using Shared = BackwardShared;
    Backward f;

    SGS_LANES_FN void operator()(int block, Shared& s, const fit::Threads& threads) const {
        const Tile tile = tile_of(f.pictures, block);
        if (!counts(f.pictures, tile)) {
            threads.each([&](int t) { backward_skip(f, tile, t); });
            return;
        }
        threads.each([&](int t) { backward_read(f, tile, s, t); });
        threads.each([&](int t) { backward_across(f, s, t); });
        threads.each([&](int t) { backward_give(f, tile, s, t); });
    }
};

}  // namespace cuda
}  // namespace structgstream

extern "C" {

int sgs_cuda_l1_ssim(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, float* adjoints, float* sums, float* means, void* stream) {
    using namespace structgstream::cuda;
    const Forward f = {pictures_of(image, target, target_u8, height, width, gains, biases, tiles), adjoints, sums};
    const int count = tiles_in(f.pictures);
    if (const int error = fit::for_blocks(ForwardBlock{f}, count, stream)) return error;
    const double numbers = static_cast<double>(height) * width * kChannels;
    return fit::for_blocks(SumBlock{sums, count, numbers, means}, 1, stream);
}

int sgs_cuda_l1_ssim_backward(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, const float* adjoints, const float* to_l1, const float* to_ssim,
    float* gradient, void* stream) {
    using namespace structgstream::cuda;
    const Backward f = {
        pictures_of(image, target, target_u8, height, width, gains, biases, tiles), adjoints, to_l1, to_ssim, gradient};
    return fit::for_blocks(BackwardBlock{f}, tiles_in(f.pictures), stream);
}

#ifdef __CUDACC__
const char* sgs_cuda_error(int error) { return cudaGetErrorString(static_cast<cudaError_t>(error)); }
int sgs_cuda_driver_fits(void) {
    int driver = 0, runtime = 0;
    if (cudaDriverGetVersion(&driver) != cudaSuccess || cudaRuntimeGetVersion(&runtime) != cudaSuccess) return 0;
    return driver / 1000 >= runtime / 1000;  // A driver runs all minor versions of its major version.
}
#else
int sgs_cuda_driver_fits(void) { return 1; }
const char* sgs_cuda_error(int) { return "the emulation does not fail"; }
#endif

}  // extern "C"
