// Enough of CUDA to run the kernels of cuda_ext/cuda on one CPU core, block by block (x86-64, GCC or Clang).
//
// The threads of a block are fibers: each runs until it waits for its warp or its block, and goes on when all have
// come. What a GPU leaves undefined ends the process with a message: threads that wait for others which never come,
// lanes of a warp that wait at different places. Shared memory is not-a-numbers when a block starts.
// EMULATED_ORDER=reversed runs the last thread and the last block first: results that depend on it show a missing
// barrier.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <vector>

#define __global__
#define __device__
#define __host__
#define __forceinline__ inline
#define __shared__ static
#define __launch_bounds__(...)

struct dim3 {
    unsigned x, y, z;
    dim3(unsigned x = 1, unsigned y = 1, unsigned z = 1) : x(x), y(y), z(z) {}
};
inline dim3 threadIdx, blockIdx, blockDim, gridDim;

// All shared memory of the library, see shared_memory.ld.
extern "C" __attribute__((visibility("hidden"))) char shared_memory_start[], shared_memory_end[];

namespace emulation {

enum class Wait { nothing, warp, block, done };

struct Fiber {
    void* stack_pointer;
    Wait wait;
    unsigned exchanges;  // with its warp, so far
};

struct Warp {
    uint64_t values[2][32];  // a lane may be one exchange ahead of the others
    const char* place[32];
};

struct Machine {
    static constexpr std::size_t kStack = 64 * 1024;
    std::vector<char> stacks;
    std::vector<Fiber> fibers;
    std::vector<Warp> warps;
    std::function<void()> kernel;
    void* scheduler = nullptr;  // its stack pointer
    unsigned current = 0;
    int any = 0, any_before = 0;  // of __syncthreads_or
};
inline Machine machine;

[[noreturn]] inline void fail(const char* message) {
    std::fprintf(stderr, "emulated GPU: %s (block %u, thread %u)\n", message, blockIdx.x, threadIdx.x);
    std::abort();
}

// Saves the registers a function must keep, and goes on with another stack.
__attribute__((naked, noinline)) static void switch_stacks(void**, void*) {
    asm("push %rbp\n push %rbx\n push %r12\n push %r13\n push %r14\n push %r15\n"
        "mov %rsp, (%rdi)\n mov %rsi, %rsp\n"
        "pop %r15\n pop %r14\n pop %r13\n pop %r12\n pop %rbx\n pop %rbp\n ret");
}

inline void wait_for(Wait what) {
    Fiber& fiber = machine.fibers[machine.current];
    fiber.wait = what;
    switch_stacks(&fiber.stack_pointer, machine.scheduler);
}

inline void run_thread() {
    machine.kernel();
    wait_for(Wait::done);
}

inline void start(unsigned thread) {
    char* top = machine.stacks.data() + (thread + 1) * Machine::kStack;
    top -= reinterpret_cast<uintptr_t>(top) % 16 + 8;  // as after a call
    void** stack = reinterpret_cast<void**>(top);
    *--stack = reinterpret_cast<void*>(run_thread);
    for (int i = 0; i < 6; ++i) *--stack = nullptr;
    machine.fibers[thread] = {stack, Wait::nothing, 0};
}

// Lets those go on who wait for what has come about; whether there was anyone.
inline bool release() {
    const unsigned count = blockDim.x;
    bool released = false;
    unsigned at_barrier = 0;
    for (unsigned first = 0; first < count; first += 32) {
        unsigned waiting = 0, done = 0;
        for (unsigned i = first; i < first + 32; ++i) {
            waiting += machine.fibers[i].wait == Wait::warp;
            done += machine.fibers[i].wait == Wait::done;
            at_barrier += machine.fibers[i].wait == Wait::block;
        }
        if (waiting && done) fail("a warp waits for lanes that have ended");
        if (waiting < 32) continue;
        const char* const* place = machine.warps[first / 32].place;
        for (unsigned lane = 1; lane < 32; ++lane)
            if (place[lane] != place[0]) fail("the lanes of a warp wait at different places");
        for (unsigned i = first; i < first + 32; ++i) machine.fibers[i].wait = Wait::nothing;
        released = true;
    }
    if (at_barrier == count) {
        for (unsigned i = 0; i < count; ++i) machine.fibers[i].wait = Wait::nothing;
        machine.any_before = machine.any;
        machine.any = 0;
        released = true;
    }
    return released;
}

inline bool reversed() {
    const char* order = std::getenv("EMULATED_ORDER");
    return order && std::strcmp(order, "reversed") == 0;
}

inline void run_block() {
    const unsigned count = blockDim.x;
    const bool backwards = reversed();
    if (shared_memory_start == shared_memory_end) fail("shared memory is not where it is looked for");
    std::memset(shared_memory_start, 0xff, shared_memory_end - shared_memory_start);
    for (unsigned i = 0; i < count; ++i) start(i);
    for (;;) {
        bool ended = true;
        for (unsigned k = 0; k < count; ++k) {
            const unsigned i = backwards ? count - 1 - k : k;
            if (machine.fibers[i].wait == Wait::nothing) {
                machine.current = i;
                threadIdx.x = i;
                switch_stacks(&machine.scheduler, machine.fibers[i].stack_pointer);
            }
            ended = ended && machine.fibers[i].wait == Wait::done;
        }
        if (ended) return;
        if (!release()) fail("threads wait for others that never come");
    }
}

inline void run(dim3 grid, dim3 block, std::function<void()> kernel) {
    if (block.x % 32) fail("blocks are whole warps");
    gridDim = grid;
    blockDim = block;
    machine.kernel = std::move(kernel);
    machine.stacks.resize(block.x * Machine::kStack);
    machine.fibers.resize(block.x);
    machine.warps.resize(block.x / 32);
    for (unsigned i = 0; i < grid.x; ++i) {
        blockIdx.x = reversed() ? grid.x - 1 - i : i;
        run_block();
    }
}

// All lanes of a warp show each other a value.
template <class T>
const uint64_t* exchange(T value, const char* place) {
    static_assert(sizeof(T) <= 8, "a register or two");
    const unsigned lane = threadIdx.x % 32;
    Warp& warp = machine.warps[threadIdx.x / 32];
    uint64_t(&values)[32] = warp.values[machine.fibers[threadIdx.x].exchanges++ % 2];
    values[lane] = 0;
    std::memcpy(&values[lane], &value, sizeof value);
    warp.place[lane] = place;
    wait_for(Wait::warp);
    return values;
}

}  // namespace emulation

inline void __syncthreads() { emulation::wait_for(emulation::Wait::block); }
inline int __syncthreads_or(int value) {
    emulation::machine.any |= value;
    emulation::wait_for(emulation::Wait::block);
    return emulation::machine.any_before;
}
inline unsigned __ballot_sync(unsigned mask, int value) {
    if (mask != 0xffffffffu) emulation::fail("only whole warps");
    const uint64_t* values = emulation::exchange(value, "ballot");
    unsigned lanes = 0;
    for (unsigned lane = 0; lane < 32; ++lane) lanes |= unsigned(values[lane] != 0) << lane;
    return lanes;
}
template <class T>
T __shfl_xor_sync(unsigned mask, T value, int step) {
    if (mask != 0xffffffffu) emulation::fail("only whole warps");
    const uint64_t* values = emulation::exchange(value, "shuffle");
    std::memcpy(&value, &values[threadIdx.x % 32 ^ unsigned(step)], sizeof value);
    return value;
}
inline int __ffs(int x) { return __builtin_ffs(x); }
inline int __clz(int x) { return x ? __builtin_clz(unsigned(x)) : 32; }
inline int __popc(unsigned x) { return __builtin_popcount(x); }
template <class T>
T atomicAdd(T* to, T value) {
    const T before = *to;
    *to += value;
    return before;
}

enum cudaError_t { cudaSuccess, cudaErrorNoDevice };
enum cudaMemcpyKind { cudaMemcpyDeviceToHost };
using cudaStream_t = void*;
struct cudaFuncAttributes {};
struct cudaLaunchConfig_t {
    dim3 gridDim, blockDim;
    cudaStream_t stream;
};
#define __CUDACC_VER_MAJOR__ 0
#define __CUDACC_VER_MINOR__ 0

inline const char* cudaGetErrorString(cudaError_t) { return "an error of the emulated GPU"; }
inline cudaError_t cudaGetLastError() { return cudaSuccess; }
inline cudaError_t cudaSetDevice(int) { return cudaSuccess; }
inline cudaError_t cudaStreamSynchronize(cudaStream_t) { return cudaSuccess; }
inline cudaError_t cudaGetDeviceCount(int* count) { return *count = 1, cudaSuccess; }
template <class Kernel>
cudaError_t cudaFuncGetAttributes(cudaFuncAttributes*, Kernel*) {
    return cudaSuccess;
}
inline cudaError_t cudaMemsetAsync(void* memory, int value, std::size_t bytes, cudaStream_t) {
    return std::memset(memory, value, bytes), cudaSuccess;
}
inline cudaError_t cudaMemcpyAsync(void* to, const void* from, std::size_t bytes, cudaMemcpyKind, cudaStream_t) {
    return std::memcpy(to, from, bytes), cudaSuccess;
}
template <class... Expected, class... Actual>
cudaError_t cudaLaunchKernelEx(const cudaLaunchConfig_t* config, void (*kernel)(Expected...), Actual&&... arguments) {
    emulation::run(config->gridDim, config->blockDim, [&] { kernel(arguments...); });
    return cudaSuccess;
}
