// Splats packed into records and listed by (tile, depth).
//
// A record holds all the blending of a splat needs, next to each other: kHeader values and the features of one slice of
// channels. Tiles are kTile x kTile pixels; a tile is made of blocks of four pixels by lanes / 4, one pack each.
#pragma once

#include <vector>

#include "../math/blending.h"
#include "scratch.h"
#include "simd.h"
#include "threads.h"

namespace catacaustics {

constexpr int kTile = 32;
constexpr int kHeader = 8;

struct Window {
    int64_t x0, y0, width, height;
    int64_t tiles_x() const { return (width + kTile - 1) / kTile; }
    int64_t tiles_y() const { return (height + kTile - 1) / kTile; }
    int64_t tiles() const { return tiles_x() * tiles_y(); }
};

// Screen-space splats, near to far. Opacities and features are those of all points, looked up through `visible`.
template <class S>
struct Splats {
    int64_t count, channels;
    const S *means, *forms, *opacities, *features;
    const int64_t* visible;
};

struct Cutoffs {
    double support, alpha_min;

    // Squared Mahalanobis radius in which a splat is drawn; 0 drops it.
    template <class S>
    S reach2(S opacity) const {
        const S support2 = S(support * support);
        if (!(alpha_min > 0)) return support2;
        const S visible = S(2) * std::log((opacity > S(1e-30) ? opacity : S(1e-30)) / S(alpha_min));
        return visible < S(0) ? S(0) : visible < support2 ? visible : support2;
    }
};

template <class S>
struct Record {
    S mean_x, mean_y;
    S m, opacity;
    S scaled_w, scaled_v;  // times kExponentScale
    S reach2, turn;        // turn: dy of the ellipse's rightmost point

    S w() const { return scaled_w * S(1 / kExponentScale); }
    S v() const { return scaled_v * S(1 / kExponentScale); }
};

inline int64_t record_stride(int channels) { return (kHeader + channels + 7) / 8 * 8; }

// Tiles touched: columns [x0, x1], rows [y0, y1]; none where x1 < x0.
struct TileRange {
    uint16_t x0, x1, y0, y1;
};

template <class S>
class Bins {
   public:
    Bins(const Splats<S>& splats, const Window& window, const Cutoffs& cutoffs, int threads);

    // Packs the features [first, first + channels) behind every header.
    void pack(int first, int channels);
    const S* record(int64_t splat) const { return records_.data() + splat * stride_; }

    // Consecutive tiles [first, last) whose lists hold at most `limit` entries together (one tile may hold more).
    int64_t batch_end(int64_t first, int64_t limit) const;
    // Lists the splats of the tiles of a batch; begin() and end() are valid for these.
    void list(int64_t first_tile, int64_t last_tile);
    const int32_t* begin(int64_t tile) const { return entries_.data() + starts_[tile] - base_; }
    const int32_t* end(int64_t tile) const { return entries_.data() + starts_[tile + 1] - base_; }
    // Number of a tile's first entry within the batch.
    int64_t offset(int64_t tile) const { return starts_[tile] - base_; }
    int64_t entries_between(int64_t first_tile, int64_t last_tile) const {
        return starts_[last_tile] - starts_[first_tile];
    }

    const Window window;

   private:
    template <class F>
    void each_tile(int64_t splat, F&& function) const;
    int64_t part_begin(int64_t part) const { return splats_.count * part / parts_; }
    void make_headers(int64_t begin, int64_t end);

    Splats<S> splats_;
    Cutoffs cutoffs_;
    int threads_;
    int64_t parts_, stride_ = 0, base_ = 0;
    Scratch<Record<S>> headers_;
    Scratch<S> records_;
    Scratch<TileRange> ranges_;
    Scratch<int32_t> entries_;
    std::vector<int64_t> starts_;
    std::vector<int32_t> counts_;  // (part, tile): entries, then entries of the parts before
};

}  // namespace catacaustics
