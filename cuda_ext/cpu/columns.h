// Rows of three values, a pack of rows at a time.
#pragma once

#include <algorithm>

#include "../math/vector.h"
#include "simd.h"

namespace catacaustics {

template <class S>
struct Columns {
    alignas(64) S x[Pack<S>::size], y[Pack<S>::size], z[Pack<S>::size];

    // Rows [first, first + lanes) of (n, 3), the last one again beyond the end.
    CATACAUSTICS_HD Vec3<Pack<S>> load(const S* rows, int64_t first, int here) {
        for (int lane = 0; lane < Pack<S>::size; ++lane) {
            const S* row = rows + 3 * (first + std::min(lane, here - 1));
            x[lane] = row[0];
            y[lane] = row[1];
            z[lane] = row[2];
        }
        return {Pack<S>::load(x), Pack<S>::load(y), Pack<S>::load(z)};
    }
    CATACAUSTICS_HD void store(const Vec3<Pack<S>>& v, S* rows, int64_t first, int here) {
        v.x.store(x);
        v.y.store(y);
        v.z.store(z);
        for (int lane = 0; lane < here; ++lane) {
            S* row = rows + 3 * (first + lane);
            row[0] = x[lane];
            row[1] = y[lane];
            row[2] = z[lane];
        }
    }
};

}  // namespace catacaustics
