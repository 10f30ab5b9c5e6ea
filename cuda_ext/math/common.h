// Shared by every native backend. Everything in math/ is templated on a scalar type T: float, double, or a pack of
// lanes that has the same operators (cpu/simd.h). No torch, no CUDA header.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

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
CATACAUSTICS_HD float natural_log(float x) { return logf(x); }
CATACAUSTICS_HD double natural_log(double x) { return log(x); }

// 2^x, or 0 below `floor`.
CATACAUSTICS_HD float exp2_or_zero(float x, float floor) { return x >= floor ? exp2f(x) : 0.0f; }
CATACAUSTICS_HD double exp2_or_zero(double x, double floor) { return x >= floor ? exp2(x) : 0.0; }

// The smallest exponent exp2_or_zero takes.
template <class S>
constexpr S kLowestExponent = sizeof(S) == 4 ? S(-126) : S(-1022);

// Integers as wide as the scalar.
template <class S>
struct Bits;
template <>
struct Bits<float> {
    using type = int32_t;
    using key = uint32_t;
};
template <>
struct Bits<double> {
    using type = int64_t;
    using key = uint64_t;
};

template <class S>
using SortKey = typename Bits<S>::key;

template <class S>
CATACAUSTICS_HD typename Bits<S>::type bits_of(S value) {
    typename Bits<S>::type bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

// Orders as the numbers do: the sign bit is flipped, and negative numbers are reversed.
template <class S>
CATACAUSTICS_HD SortKey<S> sort_key(S value) {
    const auto bits = bits_of(value);
    constexpr int last = sizeof(S) * 8 - 1;
    return SortKey<S>(bits) ^ (SortKey<S>(bits >> last) | (SortKey<S>(1) << last));
}

template <class S>
CATACAUSTICS_HD bool is_finite(S value) {
    constexpr auto exponent =
        sizeof(S) == 4 ? typename Bits<S>::type(0x7f800000) : typename Bits<S>::type(0x7ff0000000000000);
    return (bits_of(value) & exponent) != exponent;
}

}  // namespace catacaustics
