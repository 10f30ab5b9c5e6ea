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
    static_assert(blocks <= 128, "the blocks of a tile fit two words");

    // Where pixel (x, y) of a tile is kept: its block, and its lane in the block.
    static int block(int x, int y) { return y / block_height * block_columns + x / block_width; }
    static int lane(int x, int y) { return y % block_height * block_width + x % block_width; }
};

// Some of the blocks of a tile, a bit each.
template <class S>
using BlockSet = std::conditional_t<TileShape<S>::blocks <= 64, uint64_t, unsigned __int128>;
template <class S>
constexpr BlockSet<S> kAllBlocks = ~BlockSet<S>(0) >> (8 * sizeof(BlockSet<S>) - TileShape<S>::blocks);

// Calls function(block) for each of a set, in order.
template <class F>
CATACAUSTICS_HD void each_block(uint64_t set, F&& function, int first = 0) {
    for (; set; set &= set - 1) function(first + __builtin_ctzll(set));
}
template <class F>
CATACAUSTICS_HD void each_block(unsigned __int128 set, F&& function) {
    each_block(uint64_t(set), function);
    each_block(uint64_t(set >> 64), function, 64);
}

inline int count_blocks(uint64_t set) { return __builtin_popcountll(set); }
inline int count_blocks(unsigned __int128 set) {
    return count_blocks(uint64_t(set)) + count_blocks(uint64_t(set >> 64));
}

// Pixel coordinates within the tile, block by block.
template <class S>
struct LaneCoordinates {
    using Shape = TileShape<S>;
    alignas(64) S x[Shape::blocks][Shape::lanes];
    alignas(64) S y[Shape::blocks][Shape::lanes];

    LaneCoordinates() {
        for (int py = 0; py < kTile; ++py)
            for (int px = 0; px < kTile; ++px) {
                x[Shape::block(px, py)][Shape::lane(px, py)] = S(px);
                y[Shape::block(px, py)][Shape::lane(px, py)] = S(py);
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
        const P dy = P::load(at.y[block]) + P(y);
        return {(P::load(at.x[block]) + P(x)) - P(m) * dy, dy};
    }
    // 0 where the splat is not drawn: outside of its ellipse, and where less than `stop` of the light gets through.
    CATACAUSTICS_HD Pack<S> falloff(const Offset& d, Pack<S> through, Pack<S> stop) const {
        const Pack<S> inside = exp2_or_zero(exponent(d.skew, d.dy, Pack<S>(scaled_w), Pack<S>(scaled_v)), floor);
        return select(through >= stop, inside, Pack<S>(S(0)));
    }
};

// The blocks of a tile in which some pixel still draws: of which the transmittance is neither 0 nor below `stop`.
template <class S>
CATACAUSTICS_HD BlockSet<S> live_blocks(const S (&through)[TileShape<S>::blocks][TileShape<S>::lanes], S stop) {
    using P = Pack<S>;
    BlockSet<S> live = 0;
    for (int block = 0; block < TileShape<S>::blocks; ++block) {
        const P t = P::load(through[block]);
        live |= BlockSet<S>(any<S>((t >= P(stop)) & (t > P(S(0))))) << block;
    }
    return live;
}
// They are looked for after so many entries; a multiple of kGroup.
constexpr int64_t kLiveEvery = 128;

// Entries whose blocks are found ahead of the pair loop: the two overlap in the processor, and no branch of the one
// waits for the other.
constexpr int kGroup = 16;

// The first pixel not before `at`, in [0, kTile]; 0 for values that are not numbers.
template <class S>
CATACAUSTICS_HD typename Pack<S>::Mask ceiling(Pack<S> at) {
    using P = Pack<S>;
    at = select(at > P(S(0)), at, P(S(0)));
    at = select(at < P(S(kTile)), at, P(S(kTile)));
    return kTile - __builtin_convertvector((P(S(kTile)) - at).v, typename P::Mask);
}
// The last pixel not after `at`, in [-1, kTile - 1]; kTile - 1 for values that are not numbers.
template <class S>
CATACAUSTICS_HD typename Pack<S>::Mask flooring(Pack<S> at) {
    using P = Pack<S>;
    at = select(at < P(S(kTile - 1)), at, P(S(kTile - 1)));
    at = select(at > P(S(-1)), at, P(S(-1)));
    return __builtin_convertvector((at + P(S(1))).v, typename P::Mask) - 1;
}

// The blocks that each of up to kGroup entries of a tile can touch, a pack of entries at a time.
template <class S>
void find_blocks(const Bins<S>& bins, const int32_t* entries, int count, S tile_x, S tile_y, BlockSet<S>* sets) {
    using Shape = TileShape<S>;
    using P = Pack<S>;
    using Mask = typename P::Mask;
    constexpr int lanes = P::size, block_shift = log2_of(Shape::block_height);
    // The sets of the rows are kept from the first row that a splat touches on, in parts of 32 bits.
    constexpr int part_rows = 32 / Shape::block_columns, parts = Shape::block_rows / part_rows;
    for (int first = 0; first < count; first += lanes) {
        alignas(64) S in[7][lanes];
        alignas(64) typename Bits<S>::type out[parts][lanes], shift[lanes];
        for (int lane = 0; lane < lanes; ++lane) {
            const Record<S>& r = bins.header(entries[std::min(first + lane, count - 1)]);
            in[0][lane] = r.mean_x;
            in[1][lane] = r.mean_y;
            in[2][lane] = r.m;
            in[3][lane] = r.scaled_w;
            in[4][lane] = r.scaled_v;
            in[5][lane] = r.reach2;
            in[6][lane] = r.turn;
        }
        const P m = P::load(in[2]), reach2 = P::load(in[5]), turn = P::load(in[6]);
        const P inv_w = P(kExponentScale) / P::load(in[3]), v = P::load(in[4]) * P(1 / kExponentScale);
        const P x = P(tile_x) - P::load(in[0]), y = P(tile_y) - P::load(in[1]);
        const P reach_y = square_root(reach2 / v), room_x = rounding_room(x), room_y = rounding_room(y);
        const Mask top = ceiling(-reach_y - y - room_y) >> block_shift;
        const Mask bottom = flooring(reach_y - y + room_y) >> block_shift;
        Mask part[parts] = {};
        for (int k = 0; k < Shape::block_rows; ++k) {
            const Mask row = top + k, drawn = row <= bottom;
            if (!any<S>(drawn)) break;
            const P at = y + P(__builtin_convertvector(row << block_shift, typename P::Raw));
            P left, right;
            row_extent(at, at + P(S(Shape::block_height - 1)), reach_y, turn, reach2, m, v, inv_w, left, right);
            // From the block of the first pixel centre not left of `left`, to that of the last not right of `right`.
            const Mask from = ceiling(left - x - room_x) >> 2, to = (flooring(right - x + room_x) >> 2) + 1;
            const Mask one = Mask{} + 1, set = drawn & (from < to) & ((one << to) - (one << from));
            part[k / part_rows] |= set << Shape::block_columns * (k % part_rows);
        }
        for (int i = 0; i < parts; ++i) *reinterpret_cast<Mask*>(out[i]) = part[i];
        *reinterpret_cast<Mask*>(shift) = top * Shape::block_columns & Mask(Mask{} + (8 * int(sizeof(*sets)) - 1));
        for (int lane = 0; lane < std::min(lanes, count - first); ++lane) {
            BlockSet<S> set = 0;
            for (int i = 0; i < parts; ++i) set |= BlockSet<S>(uint32_t(out[i][lane])) << 32 * i;
            sets[first + lane] = set << shift[lane];
        }
    }
}

template <class S>
CATACAUSTICS_HD void prefetch_record(const S* record, int channels) {
    const char* bytes = reinterpret_cast<const char*>(record);
    for (int64_t line = 0; line < record_stride(channels) * int64_t(sizeof(S)); line += 64)
        __builtin_prefetch(bytes + line);
}

// The records of the next kGroup entries, but for those beyond `end`.
template <class S>
CATACAUSTICS_HD void prefetch_group(const Bins<S>& bins, const int32_t* entries, const int32_t* end, int channels) {
    for (int i = 0; i < kGroup && entries + i < end; ++i) prefetch_record(bins.record(entries[i]), channels);
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
