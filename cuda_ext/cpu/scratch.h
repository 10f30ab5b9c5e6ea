// Memory that lives as long as a call. Large blocks ask for huge pages: touching 4 KiB pages one by one costs as much
// as the work done in them. And they are kept for the calls to come: the system clears what it hands out, which takes a
// tenth of a step of a million splats.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <mutex>
#include <new>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace catacaustics {

constexpr std::size_t kHugePage = std::size_t(1) << 21;
constexpr std::size_t kMostKept = std::size_t(1) << 28;

struct Block {
    void* data = nullptr;
    std::size_t bytes = 0;
};

// Large blocks that are free. Where another thread is at it, or was as the process forked, blocks come from the system.
class KeptBlocks {
   public:
    // The smallest that holds `bytes` and is not much larger; empty where there is none.
    Block take(std::size_t bytes) {
        std::unique_lock<std::mutex> lock(mutex_, std::try_to_lock);
        if (!lock.owns_lock()) return {};
        std::size_t best = blocks_.size();
        for (std::size_t i = 0; i < blocks_.size(); ++i)
            if (blocks_[i].bytes >= bytes && blocks_[i].bytes / 2 <= bytes &&
                (best == blocks_.size() || blocks_[i].bytes < blocks_[best].bytes))
                best = i;
        if (best == blocks_.size()) return {};
        const Block block = blocks_[best];
        blocks_.erase(blocks_.begin() + std::ptrdiff_t(best));
        kept_ -= block.bytes;
        return block;
    }
    // Keeps a block, and lets go of those that have lain here longest where they are too many.
    void give(Block block) noexcept {
        std::unique_lock<std::mutex> lock(mutex_, std::try_to_lock);
        if (!lock.owns_lock() || block.bytes > kMostKept || !room_for_one()) return std::free(block.data);
        blocks_.push_back(block);
        kept_ += block.bytes;
        shrink(kMostKept);
    }
    void release() {
        std::unique_lock<std::mutex> lock(mutex_, std::try_to_lock);
        if (lock.owns_lock()) shrink(0);
    }

   private:
    bool room_for_one() {
        try {
            blocks_.reserve(blocks_.size() + 1);
        } catch (const std::bad_alloc&) {
            return false;
        }
        return true;
    }
    void shrink(std::size_t most) {
        std::size_t gone = 0;
        for (; kept_ > most; ++gone) {
            kept_ -= blocks_[gone].bytes;
            std::free(blocks_[gone].data);
        }
        blocks_.erase(blocks_.begin(), blocks_.begin() + std::ptrdiff_t(gone));
    }

    std::mutex mutex_;
    std::vector<Block> blocks_;
    std::size_t kept_ = 0;
};

// Never destroyed: a thread may still be at work as the process ends.
inline KeptBlocks& kept_blocks() {
    static KeptBlocks* const kept = new KeptBlocks;
    return *kept;
}

template <class T>
class Scratch {
   public:
    Scratch() = default;
    explicit Scratch(int64_t count) { allocate(count); }
    Scratch(const Scratch&) = delete;
    Scratch& operator=(const Scratch&) = delete;
    ~Scratch() { free(); }

    // Not initialised; what was there is lost.
    void allocate(int64_t count) {
        free();
        const std::size_t bytes = count > 0 ? std::size_t(count) * sizeof(T) : 1;
        const std::size_t alignment = bytes >= kHugePage ? kHugePage : 64;
        const std::size_t rounded = (bytes + alignment - 1) / alignment * alignment;
        if (bytes >= kHugePage) block_ = kept_blocks().take(rounded);
        if (block_.data) return;
        block_ = {std::aligned_alloc(alignment, rounded), rounded};
        if (!block_.data) throw std::bad_alloc();
#if defined(__linux__)
        if (bytes >= kHugePage) madvise(block_.data, rounded, MADV_HUGEPAGE);
#endif
    }

    T* data() { return static_cast<T*>(block_.data); }
    const T* data() const { return static_cast<const T*>(block_.data); }
    T& operator[](int64_t i) { return data()[i]; }
    const T& operator[](int64_t i) const { return data()[i]; }

   private:
    void free() {
        if (block_.bytes >= kHugePage)
            kept_blocks().give(block_);
        else
            std::free(block_.data);
        block_ = {};
    }

    Block block_;
};

}  // namespace catacaustics
