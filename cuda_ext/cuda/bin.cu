#include "sort.h"
#include "tile.h"

namespace catacaustics {
namespace {

template <class S>
struct Screen {
    int64_t count;
    const S *means, *forms, *opacities;
    const int64_t* visible;
};

// Records and tiles of the splats, and how many tiles each has; one more count is left 0.
template <class S>
__global__ void make_records(
    Screen<S> splats, Window window, Cutoffs<S> cutoffs, Record<S>* records, TileRange* ranges, int64_t* counts) {
    const int64_t i = global_thread();
    if (i > splats.count) return;
    int64_t count = 0;
    if (i < splats.count) {
        const S mean_x = splats.means[2 * i], mean_y = splats.means[2 * i + 1];
        const S w = splats.forms[3 * i], m = splats.forms[3 * i + 1], v = splats.forms[3 * i + 2];
        const S opacity = splats.opacities[splats.visible[i]], reach2 = cutoffs.reach2(opacity);
        const Footprint<S> f = footprint(mean_x, mean_y, w, m, v, reach2, window);
        const Record<S> record{mean_x, mean_y, m, opacity, f.scaled_w, f.scaled_v, reach2, f.turn};
        const TileRange range = tile_range(f.first_x, f.last_x, f.first_y, f.last_y, reach2, window, kTile);
        records[i] = record;
        ranges[i] = range;
        each_tile(record, range, window, kTile, [&](int64_t) { ++count; });
    }
    counts[i] = count;
}

// Entries in depth order: splats come near to far, each with its tiles.
template <class S>
__global__ void list_tiles(
    int64_t count, Window window, const Record<S>* records, const TileRange* ranges, const int64_t* offsets,
    uint32_t* tiles, int32_t* splats) {
    const int64_t i = global_thread();
    if (i >= count) return;
    int64_t next = offsets[i];
    each_tile(records[i], ranges[i], window, kTile, [&](int64_t tile) {
        tiles[next] = uint32_t(tile);
        splats[next++] = int32_t(i);
    });
}

// Places where the entries of each tile start among the sorted ones.
__global__ void find_starts(int64_t tiles, int64_t count, const uint32_t* sorted, int64_t* starts) {
    const int64_t tile = global_thread();
    if (tile > tiles) return;
    int64_t low = 0, high = count;
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        if (int64_t(sorted[middle]) < tile)
            low = middle + 1;
        else
            high = middle;
    }
    starts[tile] = low;
}

// The splats are sorted by depth already, so that a stable sort by tile alone sorts by (tile, depth): with half the
// bits and a third of the passes; and points at equal depth keep their order.
template <class S>
int64_t bin(
    const Run& run, const Screen<S>& splats, const Window& window, const Cutoffs<S>& cutoffs, Record<S>* records,
    int64_t* starts, int32_t** entries) {
    const int64_t n = splats.count, tiles = window.tiles(kTile);
    if (window.tiles_x(kTile) > kMostTiles || window.tiles_y(kTile) > kMostTiles || n >= INT32_MAX ||
        tiles >= INT32_MAX)
        return kTooLarge;
    TileRange* ranges = allocate<TileRange>(run, n);
    int64_t* counts = allocate<int64_t>(run, n + 1);
    int64_t* offsets = allocate<int64_t>(run, n + 1);
    launch(run, make_records<S>, blocks_for(n + 1), splats, window, cutoffs, records, ranges, counts);
    exclusive_sum(run, counts, offsets, n + 1);
    const int64_t total = read_back(run, offsets + n);
    if (total > INT32_MAX) return kTooLarge;
    uint32_t* keys = allocate<uint32_t>(run, 2 * total);
    int32_t* listed = allocate<int32_t>(run, total);
    *entries = allocate<int32_t>(run, total);
    launch(run, list_tiles<S>, blocks_for(n), n, window, records, ranges, offsets, keys, listed);
    int bits = 1;
    while (bits < 32 && (tiles - 1) >> bits > 0) ++bits;
    if (total > 0) sort_pairs(run, keys, keys + total, listed, *entries, total, bits);
    launch(run, find_starts, blocks_for(tiles + 1), tiles, total, keys + total, starts);
    return total;
}

}  // namespace

CATACAUSTICS_EXPORT int64_t catacaustics_tile() { return kTile; }

#define CATACAUSTICS_BIN(S, SUFFIX)                                                                                    \
    CATACAUSTICS_EXPORT int64_t catacaustics_bin_##SUFFIX(                                                             \
        const Run* run, int64_t count, const S* means, const S* forms, const S* opacities, const int64_t* visible,     \
        int64_t x0, int64_t y0, int64_t width, int64_t height, double support, double alpha_min, Record<S>* records,   \
        int64_t* starts, int32_t** entries) {                                                                          \
        return guarded(*run, [&] {                                                                                     \
            return bin<S>(                                                                                             \
                *run, {count, means, forms, opacities, visible}, {x0, y0, width, height}, {S(support), S(alpha_min)},  \
                records, starts, entries);                                                                             \
        });                                                                                                            \
    }

CATACAUSTICS_BIN(float, f32)
CATACAUSTICS_BIN(double, f64)

}  // namespace catacaustics
