// What blending needs of a splat, and which tiles of a window it touches.
#pragma once

#include "blending.h"

namespace catacaustics {

// Pixels to compute: the first, and how many.
struct Window {
    int64_t x0, y0, width, height;

    CATACAUSTICS_HD int64_t tiles_x(int tile) const { return (width + tile - 1) / tile; }
    CATACAUSTICS_HD int64_t tiles_y(int tile) const { return (height + tile - 1) / tile; }
    CATACAUSTICS_HD int64_t tiles(int tile) const { return tiles_x(tile) * tiles_y(tile); }
};

template <class S>
struct Cutoffs {
    S support, alpha_min;

    // Squared Mahalanobis radius in which a splat is drawn; 0 drops it.
    CATACAUSTICS_HD S reach2(S opacity) const {
        const S support2 = support * support;
        if (!(alpha_min > S(0))) return support2;
        const S visible = S(2) * natural_log((opacity > S(1e-30) ? opacity : S(1e-30)) / alpha_min);
        return visible < S(0) ? S(0) : visible < support2 ? visible : support2;
    }
};

template <class S>
struct Record {
    S mean_x, mean_y;
    S m, opacity;
    S scaled_w, scaled_v;  // times kExponentScale
    S reach2, turn;        // turn: dy of the ellipse's rightmost point

    CATACAUSTICS_HD S w() const { return scaled_w * S(1 / kExponentScale); }
    CATACAUSTICS_HD S v() const { return scaled_v * S(1 / kExponentScale); }
    // Least exponent drawn.
    CATACAUSTICS_HD S floor() const {
        const S least = reach2 * S(kExponentScale);
        return least > kLowestExponent<S> ? least : kLowestExponent<S>;
    }
};
constexpr int kHeader = 8;  // values of a record

// Tiles touched: columns [x0, x1], rows [y0, y1]; none where x1 < x0.
struct TileRange {
    uint16_t x0, x1, y0, y1;
};
constexpr int64_t kMostTiles = 65535;  // along a side

// Room for rounding: which pixels are drawn is decided pixel by pixel, a tile too many does no harm.
template <class T>
CATACAUSTICS_HD T rounding_room(T coordinate) {
    return T(0.01) + T(4e-7) * select(coordinate < T(0), -coordinate, coordinate);
}

// Derived values of a record, and the pixels of a window in its bounding box: [first, last] along x and y, clamped so
// that they fit an integer. Values that are not numbers give all pixels.
template <class T>
struct Footprint {
    T scaled_w, scaled_v, turn;
    T first_x, last_x, first_y, last_y;
};

template <class T>
CATACAUSTICS_HD void pixel_bounds(T mean, T reach, int64_t start, int64_t size, T& first, T& last) {
    const T room = reach + rounding_room(mean), middle = mean - T(double(start) + 0.5);
    const T low = middle - room, high = middle + room;
    first = select(low > T(0), low, T(0));
    first = select(first < T(double(size)), first, T(double(size)));
    last = select(high < T(double(size - 1)), high, T(double(size - 1)));
    last = select(last > T(-1), last, T(-1));
}

template <class T>
CATACAUSTICS_HD Footprint<T> footprint(T mean_x, T mean_y, T w, T m, T v, T reach2, const Window& window) {
    const T tiny(1e-30);
    w = select(w > tiny, w, tiny);
    const T reach_x = square_root(reach2 * (T(1) / w + m * m / v)), reach_y = square_root(reach2 / v);
    Footprint<T> f;
    f.turn = reach2 * m / (v * select(reach_x > tiny, reach_x, tiny));
    f.scaled_w = w * T(kExponentScale);
    f.scaled_v = v * T(kExponentScale);
    pixel_bounds(mean_x, reach_x, window.x0, window.width, f.first_x, f.last_x);
    pixel_bounds(mean_y, reach_y, window.y0, window.height, f.first_y, f.last_y);
    return f;
}

// Rounding to the tile of the pixel before is harmless.
template <class S>
CATACAUSTICS_HD TileRange tile_range(
    S first_x, S last_x, S first_y, S last_y, S reach2, const Window& window, int tile) {
    const bool none = last_x < S(0) || last_y < S(0) || first_x >= S(window.width) || first_y >= S(window.height) ||
                      !(reach2 > S(0));
    if (none) return {1, 0, 1, 0};
    return {
        uint16_t(int(first_x) / tile), uint16_t(int(last_x) / tile), uint16_t(int(first_y) / tile),
        uint16_t(int(last_y) / tile)};
}

// Pixels [first, last] of `size` whose centres lie in [low, high], relative to the first pixel's centre.
template <class S>
CATACAUSTICS_HD void clip(S low, S high, int64_t size, int64_t& first, int64_t& last) {
    first = !(low > S(0)) ? 0 : low > S(size) ? size : int64_t(ceil(low));
    last = !(high < S(size - 1)) ? size - 1 : high < S(0) ? -1 : int64_t(floor(high));
}

// Calls function(tile) for every tile of `range` that the record's ellipse can touch, row by row: an ellipse over many
// tiles leaves out the corners of its bounding box.
template <class S, class F>
CATACAUSTICS_HD void each_tile(const Record<S>& r, TileRange range, const Window& window, int tile, F&& function) {
    const int64_t columns = window.tiles_x(tile);
    const bool trim = range.x1 > range.x0 + 1 && range.y1 > range.y0;
    for (int64_t row = range.y0; row <= range.y1; ++row) {
        int64_t first = range.x0, last = range.x1;
        if (trim) {
            const S v = r.v(), room_y = rounding_room(r.mean_y), room_x = rounding_room(r.mean_x);
            const S low = S(window.y0 + row * tile) + S(0.5) - r.mean_y - room_y;
            S left, right;
            row_extent(
                low, low + S(tile - 1) + S(2) * room_y, square_root(r.reach2 / v), r.turn, r.reach2, r.m, v,
                S(1) / r.w(), left, right);
            const S x = r.mean_x - (S(window.x0) + S(0.5));
            int64_t x0, x1;
            clip(x + left - room_x, x + right + room_x, window.width, x0, x1);
            first = first > x0 / tile ? first : x0 / tile;
            last = x1 < x0 ? first - 1 : last < x1 / tile ? last : x1 / tile;
        }
        for (int64_t column = first; column <= last; ++column) function(row * columns + column);
    }
}

}  // namespace catacaustics
