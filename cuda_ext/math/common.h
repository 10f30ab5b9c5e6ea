// Shared by every native backend. Everything in math/ is templated on a scalar type T: float, double, or a pack of
// lanes that has the same operators (cpu/simd.h). No torch, no CUDA header.
#pragma once

#include <cmath>

#if defined(__CUDACC__)
#define CATACAUSTICS_HD __host__ __device__ __forceinline__
#else
#define CATACAUSTICS_HD inline __attribute__((always_inline))
#endif

namespace catacaustics {

template <class T>
CATACAUSTICS_HD T select(bool condition, T yes, T no) {
    return condition ? yes : no;
}

CATACAUSTICS_HD float square_root(float x) { return sqrtf(x); }
CATACAUSTICS_HD double square_root(double x) { return sqrt(x); }

}  // namespace catacaustics
