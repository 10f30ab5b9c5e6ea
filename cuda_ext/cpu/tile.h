// What the forward and the backward pass over a tile share.
#pragma once

#include <algorithm>
#include <cmath>

#include "bins.h"

namespace catacaustics {

template <class S>
struct TileShape {
    static constexpr int lanes = Pack<S>::size;
    static constexpr int block_width = 4, block_height = lanes / block_width;
    static constexpr int block_columns = kTile / block_width, block_rows = kTile / block_height;
    static constexpr int blocks = block_columns * block_rows;
    static_assert(block_columns == 8 && blocks <= 256, "block numbers fit a byte");

    // Where pixel (x, y) of a tile is kept: its block, and its lane in the block.
    static int block(int x, int y) { return y / block_height * block_columns + x / block_width; }
    static int lane(int x, int y) { return y % block_height * block_width + x % block_width; }
};

// Pixel coordinates within the tile, pack by pack.
template <class S>
struct LaneCoordinates {
    using Shape = TileShape<S>;
    alignas(64) S x[Shape::block_columns][Shape::lanes];
    alignas(64) S y[Shape::block_rows][Shape::lanes];
    alignas(64) S row[Shape::lanes];  // first pixel row of block row i

    LaneCoordinates() {
        for (int i = 0; i < Shape::lanes; ++i) row[i] = S(i * Shape::block_height);
        for (int py = 0; py < kTile; ++py)
            for (int px = 0; px < kTile; ++px) {
                x[px / Shape::block_width][Shape::lane(px, py)] = S(px);
                y[py / Shape::block_height][Shape::lane(px, py)] = S(py);
            }
    }
};

constexpr int log2_of(int power) { return power > 1 ? 1 + log2_of(power / 2) : 0; }

// A splat seen from a tile: constants of the pair loop.
template <class S>
struct TileSplat {
    S x, y;  // first pixel centre of the tile minus the mean
    S m, opacity, scaled_w, scaled_v;
    S floor;  // least exponent drawn

    TileSplat(const Record<S>& r, S tile_x, S tile_y)
        : x(tile_x - r.mean_x),
          y(tile_y - r.mean_y),
          m(r.m),
          opacity(r.opacity),
          scaled_w(r.scaled_w),
          scaled_v(r.scaled_v),
          floor(r.floor()) {}

    struct Offset {
        Pack<S> skew, dy;
    };
    CATACAUSTICS_HD Offset offset(const LaneCoordinates<S>& at, int block) const {
        using P = Pack<S>;
        const P dy = P::load(at.y[block >> 3]) + P(y);
        return {(P::load(at.x[block & 7]) + P(x)) - P(m) * dy, dy};
    }
    // 0 where the splat is not drawn: outside of its ellipse, and where less than `stop` of the light gets through.
    CATACAUSTICS_HD Pack<S> falloff(const Offset& d, Pack<S> through, Pack<S> stop) const {
        const Pack<S> inside = exp2_or_zero(exponent(d.skew, d.dy, Pack<S>(scaled_w), Pack<S>(scaled_v)), floor);
        return select(through >= stop, inside, Pack<S>(S(0)));
    }
};

// The blocks of a tile in which some pixel still draws: of which the transmittance is neither 0 nor below `stop`.
template <class S>
class LiveBlocks {
    using P = Pack<S>;
    using Shape = TileShape<S>;

   public:
    // Looked at after so many entries; a multiple of kGroup.
    static constexpr int64_t kEvery = 128;

    void set_all() {
        std::memset(live_, 1, sizeof live_);
        count_ = Shape::blocks;
    }
    void update(const S (&through)[Shape::blocks][Shape::lanes], S stop) {
        count_ = 0;
        for (int block = 0; block < Shape::blocks; ++block) {
            const P t = P::load(through[block]);
            live_[block] = any<S>((t >= P(stop)) & (t > P(S(0))));
            count_ += live_[block];
        }
    }
    bool none() const { return count_ == 0; }
    // Leaves out the numbers of the others; returns how many are left.
    int keep(uint8_t* numbers, int count) const {
        if (count_ == Shape::blocks) return count;
        int kept = 0;
        for (int i = 0; i < count; ++i) {
            numbers[kept] = numbers[i];
            kept += live_[numbers[i]];
        }
        return kept;
    }

   private:
    uint8_t live_[Shape::blocks];
    int count_;
};

// Entries whose blocks are listed ahead of the pair loop: the two overlap in the processor, and no branch of the one
// waits for the other.
constexpr int kGroup = 16;

// Writes the numbers of the blocks a splat can touch; returns how many. `numbers` has room for blocks + kSpare.
constexpr int kSpare = 32;
template <class S>
CATACAUSTICS_HD int list_blocks(const LaneCoordinates<S>& at, const Record<S>& r, S x, S y, uint8_t* numbers) {
    using Shape = TileShape<S>;
    constexpr int rows_at_once = Shape::block_rows < Shape::lanes ? Shape::block_rows : Shape::lanes;
    using P = Pack<S, rows_at_once>;
    using Mask = typename P::Mask;
    const S v = r.v(), inv_w = S(kExponentScale) / r.scaled_w;
    const S reach_y = std::sqrt(r.reach2 / v);
    const S room = S(0.01) + S(4e-7) * std::abs(y);
    // Written so that values that are not numbers give all rows.
    S top = -reach_y - y - room, bottom = reach_y - y + room;
    top = top > S(0) ? top : S(0);
    bottom = bottom < S(kTile - 1) ? bottom : S(kTile - 1);
    const int first = int(top < S(kTile) ? top : S(kTile)) / Shape::block_height;
    const int last = (int(bottom > S(-1) ? bottom + S(1) : S(0)) - 1) >> log2_of(Shape::block_height);
    const P room_x(S(0.01) + S(4e-7) * std::abs(x));
    int count = 0;
    alignas(64) typename Bits<S>::type begin[P::size], length[P::size];
    for (int row = first; row <= last; row += P::size) {
        const P low = P::load(at.row) + P(y + S(row * Shape::block_height));
        P left, right;
        row_extent(
            low, low + P(S(Shape::block_height - 1)), P(reach_y), P(r.turn), P(r.reach2), P(r.m), P(v), P(inv_w), left,
            right);
        // Blocks from the one of the first pixel centre not left of `left`, to that of the last not right of `right`.
        left = left - P(x) - room_x;
        right = right - P(x) + room_x;
        left = select(left > P(S(0)), left, P(S(0)));
        left = select(left < P(S(kTile)), left, P(S(kTile)));
        right = select(right < P(S(kTile - 1)), right, P(S(kTile - 1)));
        right = select(right > P(S(-1)), right, P(S(-1)));
        const Mask from = (kTile - __builtin_convertvector((P(S(kTile)) - left).v, Mask)) >> 2;
        const Mask to = (__builtin_convertvector((right + P(S(1))).v, Mask) - 1) >> 2;
        const Mask number = to - from + 1;
        *reinterpret_cast<Mask*>(begin) = from;
        *reinterpret_cast<Mask*>(length) = number > 0 ? number : Mask{};
        // Eight numbers are written at once, of which the first `length` count; four rows at once: few splats have
        // more.
        const int here = last - row + 1 < P::size ? last - row + 1 : P::size;
        for (int i = 0; i < here; i += 4) {
            for (int k = i; k < i + 4; ++k) {
                const uint64_t block = uint64_t((row + k) * Shape::block_columns + begin[k]);
                const uint64_t run = block * 0x0101010101010101ull + 0x0706050403020100ull;
                std::memcpy(numbers + count, &run, 8);
                count += k < here ? int(length[k]) : 0;
            }
        }
    }
    return count;
}

template <class S>
CATACAUSTICS_HD void prefetch_record(const S* record, int channels) {
    const char* bytes = reinterpret_cast<const char*>(record);
    for (int64_t line = 0; line < record_stride(channels) * int64_t(sizeof(S)); line += 64)
        __builtin_prefetch(bytes + line);
}

// Kernels are compiled for every number of channels up to this, and more channels are done in slices.
template <class S>
constexpr int max_channels = sizeof(S) == 4 ? 16 : 4;

// Calls function(std::integral_constant<int, channels>()).
template <class S, int C = 0, class F>
void with_channels(int channels, F&& function) {
    if constexpr (C <= max_channels<S>) {
        if (channels == C)
            function(std::integral_constant<int, C>());
        else
            with_channels<S, C + 1>(channels, function);
    }
}

}  // namespace catacaustics
