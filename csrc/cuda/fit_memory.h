// SPDX-License-Identifier: Apache-2.0
// Memory of the fit on a GPU; on a CPU, for tests, memory that is NaN until it is written. All functions return 0, or
// CUDA's error number.
#pragma once

#include <climits>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>

namespace structgstream {
namespace cuda {
namespace fit {

constexpr int kNoMemory = 2;  // cudaErrorMemoryAllocation
constexpr int64_t kMostPairs = INT32_MAX;  // lists and slots have 32-bit indices

#ifdef __CUDACC__

// Freed memory that the device's pool keeps, bytes: by default every wait returns all of it to the driver.
constexpr uint64_t kKeptBytes = uint64_t{1} << 30;
inline int keep_freed_memory() {
    int device = 0;
    cudaMemPool_t pool;
    uint64_t bytes = kKeptBytes;
    if (const cudaError_t error = cudaGetDevice(&device)) return static_cast<int>(error);
    if (const cudaError_t error = cudaDeviceGetDefaultMemPool(&pool, device)) return static_cast<int>(error);
    return static_cast<int>(cudaMemPoolSetAttribute(pool, cudaMemPoolAttrReleaseThreshold, &bytes));
}

inline int allocate(void** memory, size_t bytes, void* stream) {
    static const int error = keep_freed_memory();
    if (error) return error;
    return static_cast<int>(cudaMallocAsync(memory, bytes ? bytes : 1, static_cast<cudaStream_t>(stream)));
}
inline int release(void* memory, void* stream) {
    return memory == nullptr ? 0 : static_cast<int>(cudaFreeAsync(memory, static_cast<cudaStream_t>(stream)));
}
inline int fill(void* memory, int byte, size_t bytes, void* stream) {
    return static_cast<int>(cudaMemsetAsync(memory, byte, bytes, static_cast<cudaStream_t>(stream)));
}
inline int to_device(void* to, const void* from, size_t bytes, void* stream) {
    return static_cast<int>(cudaMemcpyAsync(to, from, bytes, cudaMemcpyHostToDevice, static_cast<cudaStream_t>(stream)));
}
// Copies begin when the GPU has done all that was queued before; the host waits for the last one with `wait`.
inline int to_host(void* to, const void* from, size_t bytes, void* stream) {
    return static_cast<int>(cudaMemcpyAsync(to, from, bytes, cudaMemcpyDeviceToHost, static_cast<cudaStream_t>(stream)));
}
inline int wait(void* stream) { return static_cast<int>(cudaStreamSynchronize(static_cast<cudaStream_t>(stream))); }

#else

inline int allocate(void** memory, size_t bytes, void*) {
    *memory = std::malloc(bytes ? bytes : 1);
    if (*memory != nullptr) std::memset(*memory, 0xff, bytes);
    return *memory == nullptr ? kNoMemory : 0;
}
inline int release(void* memory, void*) {
    std::free(memory);
    return 0;
}
inline int fill(void* memory, int byte, size_t bytes, void*) {
    std::memset(memory, byte, bytes);
    return 0;
}
inline int to_device(void* to, const void* from, size_t bytes, void*) {
    std::memcpy(to, from, bytes);
    return 0;
}
inline int to_host(void* to, const void* from, size_t bytes, void*) {
    std::memcpy(to, from, bytes);
    return 0;
}
inline int wait(void*) { return 0; }

#endif

// Arrays in one allocation: with `base` null only their sizes are added.
class Arena {
  public:
    explicit Arena(void* base) : base_(static_cast<char*>(base)) {}
    template <typename Number>
    Number* take(int64_t count) {
        constexpr size_t kAligned = 256;
        size_ = (size_ + kAligned - 1) / kAligned * kAligned;
        const size_t at = size_;
        size_ += sizeof(Number) * static_cast<size_t>(count);
        return base_ == nullptr ? nullptr : reinterpret_cast<Number*>(base_ + at);
    }
    size_t size() const { return size_; }

  private:
    char* base_;
    size_t size_ = 0;
};

}  // namespace fit
}  // namespace cuda
}  // namespace structgstream
