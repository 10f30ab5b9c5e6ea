// CUB's sort and scan, in a file of their own because they take longest to compile.
#pragma once

#include "launch.h"

namespace catacaustics {

// Sorts pairs by the lowest `bits` bits of their keys; pairs of equal keys keep their order.
template <class Key>
void sort_pairs(
    const Run& run, const Key* keys, Key* sorted_keys, const int32_t* values, int32_t* sorted_values, int64_t count,
    int bits);

// sums[i] = values[0] + ... + values[i - 1].
void exclusive_sum(const Run& run, const int64_t* values, int64_t* sums, int64_t count);

}  // namespace catacaustics
