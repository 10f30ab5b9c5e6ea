// Calling kernels, and what the threads of a warp do together.
//
// The sources of this folder use CUDA by its C++ interface only, without the compiler's own syntax, so that tests can
// run them on a CPU (tests/cuda_emulation).
#pragma once

#include <cuda_runtime.h>

#include <utility>

#include "../abi.h"

namespace catacaustics {

constexpr unsigned kAllLanes = 0xffffffffu;
constexpr int kBlock = 256;  // threads of a block

struct DeviceError {};

// Of the last call that failed; empty before.
inline const char*& last_error() {
    static const char* text = "";
    return text;
}

inline void check(cudaError_t status) {
    if (status == cudaSuccess) return;
    last_error() = cudaGetErrorString(status);
    throw DeviceError();
}

// No exception leaves the library.
template <class F>
int64_t guarded(const Run& run, F&& function) {
    try {
        check(cudaSetDevice(int(run.device)));
        return function();
    } catch (const DeviceError&) {
        cudaGetLastError();
        return kDeviceError;
    } catch (...) {  // std::bad_alloc; nothing else is thrown
        return kOutOfMemory;
    }
}

inline cudaStream_t stream_of(const Run& run) { return static_cast<cudaStream_t>(run.stream); }

// Runs blocks of kBlock threads on the caller's stream.
template <class... Expected, class... Actual>
void launch(const Run& run, void (*kernel)(Expected...), int64_t blocks, Actual&&... arguments) {
    if (blocks <= 0) return;
    cudaLaunchConfig_t config{};
    config.gridDim = dim3(unsigned(blocks));
    config.blockDim = dim3(kBlock);
    config.stream = stream_of(run);
    check(cudaLaunchKernelEx(&config, kernel, Expected(std::forward<Actual>(arguments))...));
}

constexpr int64_t blocks_for(int64_t threads) { return (threads + kBlock - 1) / kBlock; }

__device__ inline int64_t global_thread() { return int64_t(blockIdx.x) * kBlock + threadIdx.x; }

// Waits for the stream and returns a value of the GPU's memory.
template <class T>
T read_back(const Run& run, const T* from) {
    T value;
    check(cudaMemcpyAsync(&value, from, sizeof value, cudaMemcpyDeviceToHost, stream_of(run)));
    check(cudaStreamSynchronize(stream_of(run)));
    return value;
}

inline void clear(const Run& run, void* memory, int64_t bytes) {
    if (bytes > 0) check(cudaMemsetAsync(memory, 0, std::size_t(bytes), stream_of(run)));
}

// Lanes give half of the 2 `half` values that they hold to a partner, which gives them its share of the other half; and
// so on, down to one value. Recursion instead of a loop: the compiler must know every index.
template <int half, class S>
__device__ __forceinline__ void share_sums(S* values) {
    if constexpr (half > 0) {
        const bool upper = threadIdx.x & half;
#pragma unroll
        for (int i = 0; i < half; ++i) {
            const S give = upper ? values[i] : values[i + half];
            values[i] = (upper ? values[i + half] : values[i]) + __shfl_xor_sync(kAllLanes, give, half);
        }
        share_sums<half / 2>(values);
    }
}

// Sums of N values over the lanes of a warp; lane l gets that of value l % N. N is a power of two up to 32. N - 1
// exchanges and log2(32 / N) more, instead of 5 N. What is in `values` is lost.
template <int N, class S>
__device__ __forceinline__ S warp_sums(S (&values)[N]) {
    share_sums<N / 2>(values);
#pragma unroll
    for (int step = N; step < 32; step *= 2) values[0] += __shfl_xor_sync(kAllLanes, values[0], step);
    return values[0];
}

}  // namespace catacaustics
