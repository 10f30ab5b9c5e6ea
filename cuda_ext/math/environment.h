// Bilinear lookup in a latitude-longitude table of features (see catacaustics/environment.py).
#pragma once

#include "common.h"

namespace catacaustics {

// The four texels around a fractional place: rows (two, the lower one inside of the table), columns (two, wrapped
// around) and the place's distance from the upper row and the left column.
template <class S>
struct Texels {
    int64_t row[2], column[2];
    S lower_share, right_share;

    CATACAUSTICS_HD Texels(S fractional_row, S fractional_column, int64_t height, int64_t width) {
        // Written so that values that are not numbers give the first texel.
        const S top = fractional_row > S(0) ? floor(fractional_row) : S(0);
        row[0] = top < S(height - 1) ? int64_t(top) : height - 1;
        row[1] = row[0] + 1 < height ? row[0] + 1 : row[0];
        const S left = fractional_column >= S(-1) && fractional_column < S(width) ? floor(fractional_column) : S(0);
        column[0] = left < S(0) ? width - 1 : int64_t(left);
        column[1] = column[0] + 1 < width ? column[0] + 1 : 0;
        lower_share = fractional_row - S(row[0]);
        right_share = fractional_column - left;
    }

    // Of the texel in row i and column j, 0 or 1.
    CATACAUSTICS_HD S share(int i, int j) const {
        return (i ? lower_share : S(1) - lower_share) * (j ? right_share : S(1) - right_share);
    }
};

}  // namespace catacaustics
