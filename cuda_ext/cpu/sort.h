// Stable radix sort of (key, place), least significant digits first, with threads.
#pragma once

#include <algorithm>
#include <vector>

#include "../math/common.h"
#include "threads.h"

namespace catacaustics {

template <class S>
struct SortItem {
    SortKey<S> key;
    int32_t place;
};

// Sorts `items` with the help of `other`; returns the one that holds the result.
template <class S>
SortItem<S>* sort_by_key(SortItem<S>* items, SortItem<S>* other, int64_t count, int threads) {
    constexpr int bits = 11, size = 1 << bits;
    const int64_t parts = std::max<int64_t>(1, std::min<int64_t>(threads, count / 8192));
    std::vector<int64_t> counts(parts * size);
    for (int shift = 0; shift < int(sizeof(S) * 8); shift += bits) {
        std::fill(counts.begin(), counts.end(), 0);
        const auto digit = [&](const SortItem<S>& item) { return int((item.key >> shift) & (size - 1)); };
        parallel_for(threads, parts, [&](int64_t part) {
            int64_t* own = counts.data() + part * size;
            for (int64_t i = count * part / parts; i < count * (part + 1) / parts; ++i) ++own[digit(items[i])];
        });
        int64_t total = 0;
        bool single = false;  // all keys share this digit
        for (int d = 0; d < size; ++d) {
            const int64_t before = total;
            for (int64_t part = 0; part < parts; ++part) {
                const int64_t own = counts[part * size + d];
                counts[part * size + d] = total;
                total += own;
            }
            single |= count > 0 && total - before == count;
        }
        if (single) continue;
        parallel_for(threads, parts, [&](int64_t part) {
            int64_t* next = counts.data() + part * size;
            for (int64_t i = count * part / parts; i < count * (part + 1) / parts; ++i)
                other[next[digit(items[i])]++] = items[i];
        });
        std::swap(items, other);
    }
    return items;
}

}  // namespace catacaustics
