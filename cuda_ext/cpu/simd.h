// Packs of lanes: GCC/Clang vector extensions with operators, so that math/ compiles for them as for a scalar.
#pragma once

#include <type_traits>

#include "../math/common.h"

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

// GCC wants vector types spelled out, outside of templates.
template <class S, int size>
struct Vectors;
#define CATACAUSTICS_VECTORS(S, SIZE)                                              \
    template <>                                                                    \
    struct Vectors<S, SIZE> {                                                      \
        typedef S Raw __attribute__((vector_size(sizeof(S) * SIZE)));              \
        typedef Bits<S>::type Mask __attribute__((vector_size(sizeof(S) * SIZE))); \
    };
CATACAUSTICS_VECTORS(float, 4)
CATACAUSTICS_VECTORS(float, 8)
CATACAUSTICS_VECTORS(float, 16)
CATACAUSTICS_VECTORS(double, 4)
CATACAUSTICS_VECTORS(double, 8)
#undef CATACAUSTICS_VECTORS

template <class S, int lane_count = lanes(sizeof(S))>
struct Pack {
    static constexpr int size = lane_count;
    using Raw = typename Vectors<S, size>::Raw;
    using Mask = typename Vectors<S, size>::Mask;

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

    // Compilers make one instruction of it; with a header of intrinsics every file would take twice as long to compile.
    friend CATACAUSTICS_HD Pack square_root(Pack a) {
        for (int i = 0; i < size; ++i) a.v[i] = square_root(a.v[i]);
        return a;
    }
};

template <class S>
CATACAUSTICS_HD bool any(typename Pack<S>::Mask mask) {
    uint64_t parts[sizeof mask / sizeof(uint64_t)], bits = 0;
    memcpy(parts, &mask, sizeof mask);
    for (uint64_t part : parts) bits |= part;
    return bits != 0;
}

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
    for (int i = 0; i < Pack<double>::size; ++i) x.v[i] = exp2_or_zero(x.v[i], floor);
    return x;
}

#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define CATACAUSTICS_SHUFFLES 1
#endif
#endif

// Sums of the lanes of four packs.
CATACAUSTICS_HD Pack<float, 4> sum_lanes_of_four(const Pack<float>* packs) {
    using Quad = Pack<float, 4>::Raw;
    Quad quads[4];
    for (int i = 0; i < 4; ++i) {
        Quad parts[Pack<float>::size / 4];
        std::memcpy(parts, &packs[i].v, sizeof parts);
        for (int width = Pack<float>::size / 8; width > 0; width /= 2)
            for (int k = 0; k < width; ++k) parts[k] += parts[k + width];
        quads[i] = parts[0];
    }
#if CATACAUSTICS_SHUFFLES
    const auto pair = [](Quad a, Quad b) {  // a0 + a2, b0 + b2, a1 + a3, b1 + b3
        return __builtin_shufflevector(a, b, 0, 4, 1, 5) + __builtin_shufflevector(a, b, 2, 6, 3, 7);
    };
    const Quad a = pair(quads[0], quads[1]), b = pair(quads[2], quads[3]);
    return Pack<float, 4>(
        Quad(__builtin_shufflevector(a, b, 0, 1, 4, 5) + __builtin_shufflevector(a, b, 2, 3, 6, 7)));
#else
    Quad sums;
    for (int i = 0; i < 4; ++i) sums[i] = (quads[i][0] + quads[i][2]) + (quads[i][1] + quads[i][3]);
    return Pack<float, 4>(sums);
#endif
}

// out[i] = sum of the lanes of packs[i], i < count; count is a multiple of four, `out` is aligned to 16 bytes.
template <int count>
CATACAUSTICS_HD void sum_lanes(const Pack<float>* packs, float* out) {
    static_assert(count % 4 == 0, "packs are summed in fours");
    for (int i = 0; i < count; i += 4) sum_lanes_of_four(packs + i).store(out + i);
}

template <int count>
CATACAUSTICS_HD void sum_lanes(const Pack<double>* packs, double* out) {
    for (int i = 0; i < count; ++i) {
        out[i] = 0;
        for (int lane = 0; lane < Pack<double>::size; ++lane) out[i] += packs[i].v[lane];
    }
}

}  // namespace catacaustics
