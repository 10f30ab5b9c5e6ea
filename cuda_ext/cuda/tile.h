// Tiles of 16 x 16 pixels, one block of threads each, a pixel a thread. A warp has 8 x 4 pixels: small splats then
// touch few warps, and the others pass them by.
#pragma once

#include "../math/binning.h"
#include "launch.h"

namespace catacaustics {

constexpr int kTile = 16;
constexpr int kWarpWidth = 8, kWarpHeight = 4;
constexpr int kWarps = kBlock / 32, kWarpColumns = kTile / kWarpWidth, kWarpRows = kTile / kWarpHeight;
static_assert(kTile * kTile == kBlock && kWarpColumns * kWarpRows == kWarps, "a pixel a thread");

// Entries between two checkpoints of the transmittance; bounds what a block keeps in shared memory.
template <class S>
constexpr int kChunk = 64 / int(sizeof(S));

// As listed by catacaustics_bin; see cpu/bins.h.
template <class S>
struct Splats {
    int64_t count, channels;
    const S* features;
    const int64_t* visible;
    const Record<S>* records;
    const int64_t* starts;
    const int32_t* entries;
};

// Channels of the image computed at a time.
struct Slice {
    int first, count;
};

// Checkpoints of a tile are rows of kBlock values from this one on; those of two tiles never overlap:
// floor(b / chunk) - floor(a / chunk) + 1 >= ceil((b - a) / chunk).
template <class S>
CATACAUSTICS_HD int64_t first_checkpoint(const int64_t* starts, int64_t tile) {
    return starts[tile] / kChunk<S> + tile;
}

// A thread's pixel.
template <class S>
struct Pixel {
    int64_t index;  // in the window, row by row; -1 outside
    S x, y;         // of its centre

    __device__ Pixel(const Window& window, int64_t tile) {
        const int warp = int(threadIdx.x) / 32, lane = int(threadIdx.x) % 32;
        const int64_t columns = window.tiles_x(kTile);
        const int64_t px = tile % columns * kTile + warp % kWarpColumns * kWarpWidth + lane % kWarpWidth;
        const int64_t py = tile / columns * kTile + warp / kWarpColumns * kWarpHeight + lane / kWarpWidth;
        index = px < window.width && py < window.height ? py * window.width + px : -1;
        x = S(window.x0 + px) + S(0.5);
        y = S(window.y0 + py) + S(0.5);
    }
};

// Offset of a pixel from a splat, and what of the splat's opacity is there: 0 outside of its ellipse, and where less
// than `stop` of the light gets through.
template <class S>
struct Offset {
    S skew, dy, falloff;

    CATACAUSTICS_HD Offset(const Record<S>& r, S x, S y, S through, S stop) {
        dy = y - r.mean_y;
        skew = (x - r.mean_x) - r.m * dy;
        const S inside = exp2_or_zero(exponent(skew, dy, r.scaled_w, r.scaled_v), r.floor());
        falloff = through >= stop ? inside : S(0);
    }
};

// Which warps of a tile a splat can touch, a bit each. Values that are not numbers touch all.
template <class S>
CATACAUSTICS_HD unsigned touched_warps(const Record<S>& r, const Window& window, int64_t tile) {
    const int64_t columns = window.tiles_x(kTile);
    const S x = S(window.x0 + tile % columns * kTile) + S(0.5) - r.mean_x;
    const S y = S(window.y0 + tile / columns * kTile) + S(0.5) - r.mean_y;
    const S room_x = rounding_room(x), room_y = rounding_room(y), v = r.v(), inv_w = S(1) / r.w();
    const S reach_y = square_root(r.reach2 / v);
    unsigned warps = 0;
    for (int i = 0; i < kWarpRows; ++i) {
        const S low = y + S(i * kWarpHeight) - room_y, high = y + S((i + 1) * kWarpHeight - 1) + room_y;
        S left, right;
        row_extent(low, high, reach_y, r.turn, r.reach2, r.m, v, inv_w, left, right);
        if (right < left) continue;
        left -= x + room_x;
        right -= x - room_x;
        for (int k = 0; k < kWarpColumns; ++k)
            if (!(left > S((k + 1) * kWarpWidth - 1)) && !(right < S(k * kWarpWidth)))
                warps |= 1u << (i * kWarpColumns + k);
    }
    return warps;
}

}  // namespace catacaustics
