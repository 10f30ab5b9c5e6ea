// Packs of lanes: GCC/Clang vector extensions with operators, so that math/ compiles for them as for a scalar.
#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>

#include "../math/common.h"

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace catacaustics {

#if defined(__AVX512F__) && defined(__AVX512VL__) && defined(__AVX512DQ__)
constexpr int kVectorBytes = 64;
#elif defined(__AVX2__)
constexpr int kVectorBytes = 32;
#else
constexpr int kVectorBytes = 16;
#endif

// At least four lanes: a block of pixels is four wide.
constexpr int lanes(int scalar_bytes) { return kVectorBytes / scalar_bytes < 4 ? 4 : kVectorBytes / scalar_bytes; }

// Bits: integers as wide as the scalar. GCC wants vector types spelled out for each scalar, outside of templates.
template <class S>
struct Bits;
template <>
struct Bits<float> {
    using type = int32_t;
    typedef float Raw __attribute__((vector_size(4 * lanes(4))));
    typedef int32_t Mask __attribute__((vector_size(4 * lanes(4))));
};
template <>
struct Bits<double> {
    using type = int64_t;
    typedef double Raw __attribute__((vector_size(8 * lanes(8))));
    typedef int64_t Mask __attribute__((vector_size(8 * lanes(8))));
};

template <class S>
struct Pack {
    static constexpr int size = lanes(sizeof(S));
    using Raw = typename Bits<S>::Raw;
    using Mask = typename Bits<S>::Mask;

    Raw v;

    Pack() = default;
    CATACAUSTICS_HD explicit Pack(Raw raw) : v(raw) {}
    // Any scalar; math/ writes its literals T(1), T(-0.5).
    template <class N, class = typename std::enable_if<std::is_arithmetic<N>::value>::type>
    CATACAUSTICS_HD explicit Pack(N scalar) : v(S(scalar) - Raw{}) {}

    static CATACAUSTICS_HD Pack load(const S* from) {
        Pack r;
        r.v = *reinterpret_cast<const Raw*>(from);  // aligned
        return r;
    }
    static CATACAUSTICS_HD Pack load_unaligned(const S* from) {
        Pack r;
        std::memcpy(&r.v, from, sizeof(Raw));
        return r;
    }
    CATACAUSTICS_HD void store(S* to) const { *reinterpret_cast<Raw*>(to) = v; }

    friend CATACAUSTICS_HD Pack operator+(Pack a, Pack b) { return Pack(a.v + b.v); }
    friend CATACAUSTICS_HD Pack operator-(Pack a, Pack b) { return Pack(a.v - b.v); }
    friend CATACAUSTICS_HD Pack operator*(Pack a, Pack b) { return Pack(a.v * b.v); }
    friend CATACAUSTICS_HD Pack operator/(Pack a, Pack b) { return Pack(a.v / b.v); }
    friend CATACAUSTICS_HD Pack operator-(Pack a) { return Pack(-a.v); }
    friend CATACAUSTICS_HD Mask operator<(Pack a, Pack b) { return a.v < b.v; }
    friend CATACAUSTICS_HD Mask operator>(Pack a, Pack b) { return a.v > b.v; }
    friend CATACAUSTICS_HD Mask operator>=(Pack a, Pack b) { return a.v >= b.v; }
    friend CATACAUSTICS_HD Mask operator<=(Pack a, Pack b) { return a.v <= b.v; }
    friend CATACAUSTICS_HD Pack select(Mask mask, Pack a, Pack b) { return Pack(mask ? a.v : b.v); }

    friend CATACAUSTICS_HD Pack square_root(Pack a) {
#if defined(__AVX512F__)
        if constexpr (sizeof(Raw) == 64 && sizeof(S) == 4) return Pack(Raw(_mm512_sqrt_ps(__m512(a.v))));
        if constexpr (sizeof(Raw) == 64 && sizeof(S) == 8) return Pack(Raw(_mm512_sqrt_pd(__m512d(a.v))));
#endif
#if defined(__AVX__)
        if constexpr (sizeof(Raw) == 32 && sizeof(S) == 4) return Pack(Raw(_mm256_sqrt_ps(__m256(a.v))));
        if constexpr (sizeof(Raw) == 32 && sizeof(S) == 8) return Pack(Raw(_mm256_sqrt_pd(__m256d(a.v))));
#elif defined(__SSE2__)
        if constexpr (sizeof(Raw) == 16 && sizeof(S) == 4) return Pack(Raw(_mm_sqrt_ps(__m128(a.v))));
#endif
        for (int i = 0; i < size; ++i) a.v[i] = square_root(a.v[i]);
        return a;
    }
};

// 2^x for x in [-126, 0] (a relative error below 2 units in the last place); lanes below `floor` give 0.
CATACAUSTICS_HD Pack<float> exp2_or_zero(Pack<float> x, float floor) {
    using P = Pack<float>;
    const P magic(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer, kept in the low bits
    const P shifted = x + magic;
    const P f = x - (shifted - magic);
    P p(0.0001535335878318815f);
    p = p * f + P(0.0013398874876934016f);
    p = p * f + P(0.00961843737397739f);
    p = p * f + P(0.05550332469954978f);
    p = p * f + P(0.24022647913440667f);
    p = p * f + P(0.6931472028555796f);
    p = p * f + P(1.0f);
    const P result(P::Raw(P::Mask(p.v) + (P::Mask(shifted.v) << 23)));
    return select(x >= P(floor), result, P(0.0f));
}

CATACAUSTICS_HD Pack<double> exp2_or_zero(Pack<double> x, double floor) {
    for (int i = 0; i < Pack<double>::size; ++i) x.v[i] = x.v[i] >= floor ? exp2(x.v[i]) : 0;
    return x;
}

// The smallest exponent exp2_or_zero takes.
template <class S>
constexpr S kLowestExponent = sizeof(S) == 4 ? S(-126) : S(-1022);

// out[i] = sum of the lanes of packs[i], i < count.
template <class S, int count>
CATACAUSTICS_HD void sum_lanes(const Pack<S>* packs, S* out) {
    for (int i = 0; i < count; ++i) {
        S sum = 0;
        for (int lane = 0; lane < Pack<S>::size; ++lane) sum += packs[i].v[lane];
        out[i] = sum;
    }
}

}  // namespace catacaustics
