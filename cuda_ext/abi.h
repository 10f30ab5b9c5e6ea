// The C ABI, the same for the CPU's libraries and the GPU's: raw pointers and sizes, arrays contiguous.
//
// All results have sizes that the caller knows, but for the list of binned splats and, on the GPU, memory to work in:
// these are asked of the caller's allocator, which owns what it gives.
#pragma once

#include <cstdint>
#include <new>

#define CATACAUSTICS_EXPORT extern "C" __attribute__((visibility("default")))

namespace catacaustics {

// How a call runs. The layout is repeated in catacaustics/kernels.py.
struct Run {
    void* (*allocate)(int64_t bytes);  // null where there is no memory
    int64_t threads;                   // on the CPU
    void* stream;                      // on the GPU
    int64_t device;
    int64_t deterministic;  // on the GPU: gradients are the same bit for bit in every run (on the CPU they always are)
};

// Bumped with every change of the ABI.
constexpr int64_t kAbi = 3;

// Counts are >= 0.
constexpr int64_t kInvalidValues = -1, kOutOfMemory = -2, kTooLarge = -3, kDeviceError = -4;

// Memory of the caller's for `count` items.
template <class T>
T* allocate(const Run& run, int64_t count) {
    void* memory = run.allocate(count > 0 ? count * int64_t(sizeof(T)) : 1);
    if (!memory) throw std::bad_alloc();
    return static_cast<T*>(memory);
}

}  // namespace catacaustics
