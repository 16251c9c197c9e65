// SPDX-License-Identifier: Apache-2.0
// Kernels whose threads share memory, written once. A kernel is a value with kThreads, a type Shared, and
// operator()(block, shared, threads). It calls threads.each(work) for work of every thread, threads.warps(work) for work
// of every warp (lanes.h), and threads.any_warp(test); after each of them all threads have arrived. On a GPU these are
// followed by a barrier. On a CPU they run thread after thread, over shared memory that is NaN before a block begins.
#pragma once

#include <cstring>
#include <memory>

#include "element.h"
#include "lanes.h"

namespace structgstream {
namespace cuda {
namespace fit {

#ifdef __CUDACC__

struct Threads {
    template <typename Work>
    __device__ __forceinline__ void each(const Work& work) const {
        work(static_cast<int>(threadIdx.x));
        __syncthreads();
    }
    template <typename Work>
    __device__ __forceinline__ void warps(const Work& work) const {
        work(static_cast<int>(threadIdx.x) / kLanes);
        __syncthreads();
    }
    template <typename Test>
    __device__ __forceinline__ bool any_warp(const Test& test) const {
        return __syncthreads_or(test(static_cast<int>(threadIdx.x) / kLanes)) != 0;
    }
};

// A value of each warp, in registers.
template <typename Value, int kWarps>
struct OfWarp {
    Value value;
    __device__ __forceinline__ Value& operator[](int) { return value; }
};

template <typename Kernel>
__global__ void __launch_bounds__(Kernel::kThreads) block_kernel(const Kernel kernel) {
    __shared__ typename Kernel::Shared shared;
    kernel(static_cast<int>(blockIdx.x), shared, Threads{});
}

// Runs blocks 0 ... count - 1; returns CUDA's error number.
template <typename Kernel>
int for_blocks(const Kernel& kernel, int64_t count, void* stream) {
    if (count <= 0) return 0;
    block_kernel<<<static_cast<unsigned>(count), Kernel::kThreads, 0, static_cast<cudaStream_t>(stream)>>>(kernel);
    return static_cast<int>(cudaGetLastError());
}

SGS_LANES_FN int add_to(int32_t* to, int32_t value) { return atomicAdd(to, value); }
SGS_LANES_FN void add_to(int64_t* to, int64_t value) {
    atomicAdd(reinterpret_cast<unsigned long long*>(to), static_cast<unsigned long long>(value));
}

#else

struct Threads {
    int count;
    bool reversed;
    template <typename Work>
    void each(const Work& work) const {
        for (int i = 0; i < count; ++i) work(reversed ? count - 1 - i : i);
    }
    template <typename Work>
    void warps(const Work& work) const {
        const int warps = count / kLanes;
        for (int i = 0; i < warps; ++i) work(reversed ? warps - 1 - i : i);
    }
    template <typename Test>
    bool any_warp(const Test& test) const {
        bool found = false;
        for (int i = 0; i < count / kLanes; ++i) found |= test(i);
        return found;
    }
};

template <typename Value, int kWarps>
struct OfWarp {
    Value values[kWarps];
    Value& operator[](int warp) { return values[warp]; }
};

// `stream` is not a stream: blocks and threads run in reverse order if it is not null.
template <typename Kernel>
int for_blocks(const Kernel& kernel, int64_t count, void* stream) {
    const auto shared = std::make_unique<typename Kernel::Shared>();
    for (int64_t i = 0; i < count; ++i) {
        std::memset(static_cast<void*>(shared.get()), 0xff, sizeof(typename Kernel::Shared));
        const int64_t block = stream == nullptr ? i : count - 1 - i;
        kernel(static_cast<int>(block), *shared, Threads{Kernel::kThreads, stream != nullptr});
    }
    return 0;
}

inline int add_to(int32_t* to, int32_t value) {
    const int32_t before = *to;
    *to += value;
    return before;
}
inline void add_to(int64_t* to, int64_t value) { *to += value; }

#endif

}  // namespace fit
}  // namespace cuda
}  // namespace structgstream
