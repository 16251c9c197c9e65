// SPDX-License-Identifier: Apache-2.0
// The interface of ssim.h on a CPU, for tests: the phases of ssim_phases.h, block by block and thread by thread, over
// memory that is NaN until a phase writes it. `stream` is not a stream: the threads of a phase run in reverse order if it
// is not null, which changes the result of a phase in which one thread reads what another writes.

#include <cstring>
#include <limits>
#include <memory>

#include "ssim.h"
#include "ssim_phases.h"
#include "ssim_window.h"

namespace {

using namespace structgstream::cuda;

template <typename Phase>
void each_thread(int threads, const void* reversed, const Phase& phase) {
    for (int i = 0; i < threads; ++i) phase(reversed == nullptr ? i : threads - 1 - i);
}

template <typename Block>
void each_block(const Pictures& p, const Block& block) {
    Tile tile = {0, 0, tiles_along(p.height), tiles_along(p.width)};
    for (tile.row = 0; tile.row < tile.rows; ++tile.row)
        for (tile.column = 0; tile.column < tile.columns; ++tile.column) block(tile);
}

template <typename Shared>
void forget(Shared& shared) {
    std::memset(static_cast<void*>(&shared), 0xff, sizeof(Shared));  // every float and every double is NaN
}

}  // namespace

extern "C" {

int sgs_cuda_l1_ssim(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, float* adjoints, float* sums, float* means, void* stream) {
    const Forward f = {pictures_of(image, target, target_u8, height, width, gains, biases, tiles), adjoints, sums};
    const auto shared = std::make_unique<ForwardShared>();
    each_block(f.pictures, [&](const Tile& tile) {
        forget(*shared);
        if (!(adjoints == nullptr ? counts(f.pictures, tile) : counts_nearby(f.pictures, tile))) {
            each_thread(kThreads, stream, [&](int t) { forward_skip(f, tile, t); });
            return;
        }
        each_thread(kThreads, stream, [&](int t) { forward_read(f, tile, *shared, t); });
        each_thread(kThreads, stream, [&](int t) { forward_across(f, *shared, t); });
        each_thread(kThreads, stream, [&](int t) { forward_down(f, tile, *shared, t); });
        each_thread(kThreads, stream, [&](int t) { forward_gather(*shared, t); });
        each_thread(kThreads, stream, [&](int t) { forward_give(f, tile, *shared, t); });
    });
    SumShared total;
    forget(total);
    const int count = tiles_along(height) * tiles_along(width);
    each_thread(kSumThreads, stream, [&](int t) { sum_read(sums, count, total, t); });
    for (int half = kSumThreads / 2; half > 0; half /= 2)
        each_thread(kSumThreads, stream, [&](int t) { sum_fold(total, half, t); });
    const double numbers = static_cast<double>(height) * width * kChannels;
    each_thread(kSumThreads, stream, [&](int t) { sum_give(total, numbers, means, t); });
    return 0;
}

int sgs_cuda_l1_ssim_backward(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, const float* adjoints, const float* to_l1, const float* to_ssim,
    float* gradient, void* stream) {
    const Backward f = {
        pictures_of(image, target, target_u8, height, width, gains, biases, tiles), adjoints, to_l1, to_ssim, gradient};
    const auto shared = std::make_unique<BackwardShared>();
    each_block(f.pictures, [&](const Tile& tile) {
        forget(*shared);
        if (!counts(f.pictures, tile)) {
            each_thread(kThreads, stream, [&](int t) { backward_skip(f, tile, t); });
            return;
        }
        each_thread(kThreads, stream, [&](int t) { backward_read(f, tile, *shared, t); });
        each_thread(kThreads, stream, [&](int t) { backward_across(f, *shared, t); });
        each_thread(kThreads, stream, [&](int t) { backward_give(f, tile, *shared, t); });
    });
    return 0;
}

const char* sgs_cuda_error(int) { return "the emulation does not fail"; }
}
