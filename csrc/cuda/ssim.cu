// SPDX-License-Identifier: Apache-2.0
// The phases of ssim_phases.h, separated by barriers.

#include "ssim.h"
#include "ssim_phases.h"
#include "ssim_window.h"

namespace structgstream {
namespace cuda {
namespace {

__device__ Tile tile_of_block() {
    return {static_cast<int>(blockIdx.y), static_cast<int>(blockIdx.x), static_cast<int>(gridDim.y),
            static_cast<int>(gridDim.x)};
}

// The tests for tiles that do not count are equal for all threads of a block, so all threads or none reach a barrier.
__global__ void __launch_bounds__(kThreads) forward_kernel(const Forward f) {
    __shared__ ForwardShared shared;
    const Tile tile = tile_of_block();
    const int t = static_cast<int>(threadIdx.x);
    if (!(f.adjoints == nullptr ? counts(f.pictures, tile) : counts_nearby(f.pictures, tile))) {
        forward_skip(f, tile, t);
        return;
    }
    forward_read(f, tile, shared, t);
    __syncthreads();
    forward_across(f, shared, t);
    __syncthreads();
    forward_down(f, tile, shared, t);
    __syncthreads();
    forward_gather(shared, t);
    __syncthreads();
    forward_give(f, tile, shared, t);
}

__global__ void __launch_bounds__(kSumThreads) sum_kernel(const float* sums, int count, double numbers, float* means) {
    __shared__ SumShared shared;
    const int t = static_cast<int>(threadIdx.x);
    sum_read(sums, count, shared, t);
    for (int half = kSumThreads / 2; half > 0; half /= 2) {
        __syncthreads();
        sum_fold(shared, half, t);
    }
    __syncthreads();
    sum_give(shared, numbers, means, t);
}

__global__ void __launch_bounds__(kThreads) backward_kernel(const Backward f) {
    __shared__ BackwardShared shared;
    const Tile tile = tile_of_block();
    const int t = static_cast<int>(threadIdx.x);
    if (!counts(f.pictures, tile)) {
        backward_skip(f, tile, t);
        return;
    }
    backward_read(f, tile, shared, t);
    __syncthreads();
    backward_across(f, shared, t);
    __syncthreads();
    backward_give(f, tile, shared, t);
}

dim3 grid_of(const Pictures& p) {
    return dim3(static_cast<unsigned>(tiles_along(p.width)), static_cast<unsigned>(tiles_along(p.height)));
}

}  // namespace
}  // namespace cuda
}  // namespace structgstream

using namespace structgstream::cuda;

int sgs_cuda_l1_ssim(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, float* adjoints, float* sums, float* means, void* stream) {
    const Forward f = {pictures_of(image, target, target_u8, height, width, gains, biases, tiles), adjoints, sums};
    const dim3 grid = grid_of(f.pictures);
    const cudaStream_t queue = static_cast<cudaStream_t>(stream);
    forward_kernel<<<grid, kThreads, 0, queue>>>(f);
    sum_kernel<<<1, kSumThreads, 0, queue>>>(
        sums, static_cast<int>(grid.x * grid.y), static_cast<double>(height) * width * kChannels, means);
    return static_cast<int>(cudaGetLastError());
}

int sgs_cuda_l1_ssim_backward(
    const float* image, const float* target, const uint8_t* target_u8, int height, int width, const float* gains,
    const float* biases, const uint8_t* tiles, const float* adjoints, const float* to_l1, const float* to_ssim,
    float* gradient, void* stream) {
    const Backward f = {
        pictures_of(image, target, target_u8, height, width, gains, biases, tiles), adjoints, to_l1, to_ssim, gradient};
    backward_kernel<<<grid_of(f.pictures), kThreads, 0, static_cast<cudaStream_t>(stream)>>>(f);
    return static_cast<int>(cudaGetLastError());
}

const char* sgs_cuda_error(int error) { return cudaGetErrorString(static_cast<cudaError_t>(error)); }
