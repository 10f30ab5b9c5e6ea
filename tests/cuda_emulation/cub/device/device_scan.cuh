#pragma once

#include "../../cuda_runtime.h"

namespace cub {

struct DeviceScan {
    template <class T>
    static cudaError_t ExclusiveSum(
        void* memory, std::size_t& bytes, const T* values, T* sums, int count, cudaStream_t) {
        if (!memory) return bytes = 1, cudaSuccess;
        T sum = 0;
        for (int i = 0; i < count; ++i) {
            sums[i] = sum;
            sum += values[i];
        }
        return cudaSuccess;
    }
};

}  // namespace cub
