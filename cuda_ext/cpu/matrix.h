// Products of small matrices: C = finish(start + bias + A B), in tiles that are summed in registers.
#pragma once

#include "simd.h"

namespace catacaustics {

// Smallest multiple of a pack that holds `count` values: the length of rows of B, C, start and bias.
template <class S>
constexpr int padded(int count) {
    return (count + Pack<S>::size - 1) / Pack<S>::size * Pack<S>::size;
}

// A (rows x depth) has any strides, so it may be a transpose. The others are aligned, their rows contiguous and padded.
template <class S>
struct Product {
    int rows, depth, columns;  // columns are padded
    const S* a;
    int64_t a_row, a_depth;
    const S* b;
    int64_t b_row;
    const S* start;  // null: zero; may be C
    const S* bias;   // a row; null: zero
    S* c;
    int64_t c_row;  // of C, of start and of where_positive
    bool relu = false;
    const S* where_positive = nullptr;  // C is zero where this is not positive: the derivative of ReLU
};

// Sums that are held in registers, beside the operands: of 32 registers, 16, and 16 without fused multiply-add.
constexpr int kSums = kVectorBytes == 64 ? 24 : kVectorBytes == 32 ? 12 : 8;

template <class S, int rows, int packs>
void multiply_tile(const Product<S>& p, int row, int column) {
    using P = Pack<S>;
    P sums[rows][packs];
    const int64_t corner = row * p.c_row + column;
#pragma GCC unroll 12
    for (int i = 0; i < rows; ++i)
#pragma GCC unroll 4
        for (int j = 0; j < packs; ++j) {
            sums[i][j] = p.start ? P::load(p.start + corner + i * p.c_row + j * P::size) : P(S(0));
            if (p.bias) sums[i][j] = sums[i][j] + P::load(p.bias + column + j * P::size);
        }
    const S *a = p.a + row * p.a_row, *b = p.b + column;
    for (int k = 0; k < p.depth; ++k, a += p.a_depth, b += p.b_row) {
        // The shorter side of the tile stays in registers.
        if constexpr (rows < packs) {
            P own[rows];
#pragma GCC unroll 12
            for (int i = 0; i < rows; ++i) own[i] = P(a[i * p.a_row]);
#pragma GCC unroll 4
            for (int j = 0; j < packs; ++j) {
                const P other = P::load(b + j * P::size);
#pragma GCC unroll 12
                for (int i = 0; i < rows; ++i) sums[i][j] = sums[i][j] + own[i] * other;
            }
        } else {
            P own[packs];
#pragma GCC unroll 4
            for (int j = 0; j < packs; ++j) own[j] = P::load(b + j * P::size);
#pragma GCC unroll 12
            for (int i = 0; i < rows; ++i) {
                const P other(a[i * p.a_row]);
#pragma GCC unroll 4
                for (int j = 0; j < packs; ++j) sums[i][j] = sums[i][j] + other * own[j];
            }
        }
    }
    // Written so that NaN stays NaN, as in PyTorch.
    const P zero(S(0));
#pragma GCC unroll 12
    for (int i = 0; i < rows; ++i)
#pragma GCC unroll 4
        for (int j = 0; j < packs; ++j) {
            const int64_t place = corner + i * p.c_row + j * P::size;
            P c = sums[i][j];
            if (p.relu) c = select(zero > c, zero, c);
            if (p.where_positive) c = select(P::load(p.where_positive + place) <= zero, zero, c);
            c.store(p.c + place);
        }
}

// Rows from `row` on in tiles of `rows`, what is left in tiles of half as many.
template <class S, int rows, int packs>
void multiply_rows(const Product<S>& p, int row, int column) {
    for (; row + rows <= p.rows; row += rows) multiply_tile<S, rows, packs>(p, row, column);
    if constexpr (rows > 1)
        if (row < p.rows) multiply_rows<S, (rows + 1) / 2, packs>(p, row, column);
}

template <class S>
void multiply(const Product<S>& p) {
    constexpr int lanes = Pack<S>::size;
    const int packs = p.columns / lanes;
    // Tiles of four packs, or of three where these come out even.
    const int wide = packs % 4 != 0 && packs % 3 == 0 ? 3 : 4;
    for (int pack = 0; pack < packs;) {
        const int here = packs - pack < wide ? packs - pack : wide;
        if (here == 4) multiply_rows<S, kSums / 4, 4>(p, 0, pack * lanes);
        if (here == 3) multiply_rows<S, kSums / 3, 3>(p, 0, pack * lanes);
        if (here == 2) multiply_rows<S, kSums / 2, 2>(p, 0, pack * lanes);
        if (here == 1) multiply_rows<S, (kSums < 12 ? kSums : 12), 1>(p, 0, pack * lanes);
        pack += here;
    }
}

}  // namespace catacaustics
