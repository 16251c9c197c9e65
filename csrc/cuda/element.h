// SPDX-License-Identifier: Apache-2.0
// Kernels in which every thread computes its own elements and reads none of another thread: `for_each` runs them on a GPU,
// or one after another on a CPU, where tests run the same functions.
#pragma once

#include <cstdint>

#ifdef __CUDACC__
#define SGS_ELEMENT __host__ __device__ inline
#else
#define SGS_ELEMENT inline
#endif

namespace structgstream {
namespace cuda {

constexpr int kTilePixels = 16;  // values.TILE_PIXELS

constexpr int kElementThreads = 256;

#ifdef __CUDACC__

template <int kThreads, typename Element>
__global__ void __launch_bounds__(kThreads) element_kernel(const Element element, int64_t count) {
    const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
    if (i < count) element(i);
}

// Calls `element(i)` for i in 0 ... count - 1; returns CUDA's error number.
template <int kThreads = kElementThreads, typename Element>
int for_each(const Element& element, int64_t count, void* stream) {
    if (count <= 0) return 0;
    const unsigned blocks = static_cast<unsigned>((count + kThreads - 1) / kThreads);
    element_kernel<kThreads><<<blocks, kThreads, 0, static_cast<cudaStream_t>(stream)>>>(element, count);
    return static_cast<int>(cudaGetLastError());
}

#else

// `stream` is not a stream: elements are computed in reverse order if it is not null.
template <int kThreads = kElementThreads, typename Element>
int for_each(const Element& element, int64_t count, void* stream) {
    for (int64_t i = 0; i < count; ++i) element(stream == nullptr ? i : count - 1 - i);
    return 0;
}

#endif

}  // namespace cuda
}  // namespace structgstream
