#pragma once

#include "../abi.h"

namespace catacaustics {

// No exception leaves the library.
template <class F>
int64_t guarded(F&& function) {
    try {
        return function();
    } catch (...) {  // std::bad_alloc; nothing else is thrown
        return kOutOfMemory;
    }
}

}  // namespace catacaustics
