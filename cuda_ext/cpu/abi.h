// The C ABI: raw pointers and sizes, arrays contiguous, nothing allocated for the caller. Status codes below.
#pragma once

#include <cstdint>

#define CATACAUSTICS_EXPORT extern "C" __attribute__((visibility("default")))

namespace catacaustics {

// Counts are >= 0.
constexpr int64_t kInvalidValues = -1, kOutOfMemory = -2, kTooLarge = -3;

template <class F>
int64_t guarded(F&& function) {
    try {
        return function();
    } catch (...) {  // std::bad_alloc; nothing else is thrown
        return kOutOfMemory;
    }
}

}  // namespace catacaustics
