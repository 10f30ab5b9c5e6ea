// Memory that lives as long as a call. Large blocks ask for huge pages: touching 4 KiB pages one by one costs as much
// as the work done in them.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <new>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace catacaustics {

template <class T>
class Scratch {
   public:
    Scratch() = default;
    explicit Scratch(int64_t count) { allocate(count); }
    Scratch(const Scratch&) = delete;
    Scratch& operator=(const Scratch&) = delete;
    ~Scratch() { std::free(data_); }

    // Not initialised; what was there is lost.
    void allocate(int64_t count) {
        std::free(data_);
        const std::size_t huge = std::size_t(1) << 21;
        const std::size_t bytes = count > 0 ? std::size_t(count) * sizeof(T) : 1;
        const std::size_t alignment = bytes >= huge ? huge : 64;
        data_ = static_cast<T*>(std::aligned_alloc(alignment, (bytes + alignment - 1) / alignment * alignment));
        if (!data_) throw std::bad_alloc();
#if defined(__linux__)
        if (bytes >= huge) madvise(data_, (bytes + huge - 1) / huge * huge, MADV_HUGEPAGE);
#endif
    }

    T* data() { return data_; }
    const T* data() const { return data_; }
    T& operator[](int64_t i) { return data_[i]; }
    const T& operator[](int64_t i) const { return data_[i]; }

   private:
    T* data_ = nullptr;
};

}  // namespace catacaustics
