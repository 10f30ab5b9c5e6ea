#include "sort.h"

#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>

namespace catacaustics {

template <class Key>
void sort_pairs(
    const Run& run, const Key* keys, Key* sorted_keys, const int32_t* values, int32_t* sorted_values, int64_t count,
    int bits) {
    std::size_t bytes = 0;
    const auto sort = [&](void* memory) {
        check(cub::DeviceRadixSort::SortPairs(
            memory, bytes, keys, sorted_keys, values, sorted_values, int(count), 0, bits, stream_of(run)));
    };
    sort(nullptr);  // asks for the size
    sort(allocate<char>(run, int64_t(bytes)));
}

template void sort_pairs(const Run&, const uint32_t*, uint32_t*, const int32_t*, int32_t*, int64_t, int);
template void sort_pairs(const Run&, const uint64_t*, uint64_t*, const int32_t*, int32_t*, int64_t, int);

void exclusive_sum(const Run& run, const int64_t* values, int64_t* sums, int64_t count) {
    std::size_t bytes = 0;
    const auto scan = [&](void* memory) {
        check(cub::DeviceScan::ExclusiveSum(memory, bytes, values, sums, int(count), stream_of(run)));
    };
    scan(nullptr);
    scan(allocate<char>(run, int64_t(bytes)));
}

}  // namespace catacaustics
