// Splats listed by (tile, depth), and packed into records for blending.
//
// A record holds all the blending of a splat needs, next to each other: kHeader values and the features of one slice of
// channels. Tiles are kTile x kTile pixels; a tile is made of blocks of four pixels by lanes / 4, one pack each.
#pragma once

#include "../math/binning.h"
#include "scratch.h"
#include "simd.h"
#include "threads.h"

namespace catacaustics {

// In larger tiles splats are listed fewer times; of smaller ones, blocks of pairs stay in the cache. Where vectors are
// long there are half as many blocks.
constexpr int kTile = kVectorBytes == 64 ? 32 : 16;

// The splats of a window, near to far, as listed by catacaustics_bin. Features are those of all points, looked up
// through `visible`; the list of a tile is entries[starts[tile]], ..., entries[starts[tile + 1] - 1].
template <class S>
struct Splats {
    int64_t count, channels;
    const S* features;
    const int64_t* visible;
    const Record<S>* headers;
    const int64_t* starts;
    const int32_t* entries;
};

inline int64_t record_stride(int channels) { return (kHeader + channels + 7) / 8 * 8; }

template <class S>
class Bins {
   public:
    Bins(const Splats<S>& splats, const Window& window) : window(window), splats_(splats) {}

    // Puts the features [first, first + channels) behind every header.
    void pack(int first, int channels, int threads);
    const S* record(int64_t splat) const { return records_.data() + splat * stride_; }
    const Record<S>& header(int64_t splat) const { return *reinterpret_cast<const Record<S>*>(record(splat)); }

    const int32_t* begin(int64_t tile) const { return splats_.entries + splats_.starts[tile]; }
    const int32_t* end(int64_t tile) const { return splats_.entries + splats_.starts[tile + 1]; }
    int64_t entries_between(int64_t first_tile, int64_t last_tile) const {
        return splats_.starts[last_tile] - splats_.starts[first_tile];
    }
    // Consecutive tiles [first, last) whose lists hold at most `limit` entries together (one tile may hold more).
    int64_t batch_end(int64_t first, int64_t limit) const;

    const Window window;

   private:
    Splats<S> splats_;
    int64_t stride_ = 0;
    Scratch<S> records_;
};

}  // namespace catacaustics
