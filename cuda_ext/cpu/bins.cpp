#include "bins.h"

#include <algorithm>
#include <vector>

#include "guarded.h"

namespace catacaustics {

template <class S>
void Bins<S>::pack(int first, int channels, int threads) {
    const int64_t stride = record_stride(channels);
    if (stride != stride_) records_.allocate(splats_.count * stride);
    stride_ = stride;
    const int64_t chunk = 4096;
    parallel_for(threads, (splats_.count + chunk - 1) / chunk, [&](int64_t task) {
        const int64_t end = std::min(splats_.count, (task + 1) * chunk);
        for (int64_t i = task * chunk; i < end; ++i) {
            if (i + 16 < end) __builtin_prefetch(splats_.features + splats_.visible[i + 16] * splats_.channels + first);
            S* record = records_.data() + i * stride;
            std::memcpy(record, &splats_.headers[i], sizeof(Record<S>));
            const S* features = splats_.features + splats_.visible[i] * splats_.channels + first;
            for (int c = 0; c < channels; ++c) record[kHeader + c] = features[c];
        }
    });
}

template <class S>
int64_t Bins<S>::batch_end(int64_t first, int64_t limit) const {
    const int64_t *starts = splats_.starts, *end = starts + window.tiles(kTile) + 1;
    const int64_t* past = std::upper_bound(starts + first, end, starts[first] + limit);
    return std::max(first + 1, int64_t(past - starts) - 1);
}

template class Bins<float>;
template class Bins<double>;

namespace {

template <class S>
struct Screen {
    int64_t count;
    const S *means, *forms, *opacities;
    const int64_t* visible;
};

// Records and tiles of the splats [begin, begin + lanes) that are before `end`, all lanes at once.
template <class S>
void make_records(
    const Screen<S>& splats, const Window& window, const Cutoffs<S>& cutoffs, int64_t begin, int64_t end,
    Record<S>* records, TileRange* ranges) {
    using P = Pack<S>;
    constexpr int lanes = P::size;
    const int here = int(std::min<int64_t>(lanes, end - begin));
    alignas(64) S in[7][lanes], out[7][lanes];
    for (int lane = 0; lane < lanes; ++lane) {
        const int64_t i = begin + std::min(lane, here - 1);
        for (int k = 0; k < 2; ++k) in[k][lane] = splats.means[2 * i + k];
        for (int k = 0; k < 3; ++k) in[2 + k][lane] = splats.forms[3 * i + k];
        in[5][lane] = splats.opacities[splats.visible[i]];
        in[6][lane] = cutoffs.reach2(in[5][lane]);
    }
    const auto f = footprint(
        P::load(in[0]), P::load(in[1]), P::load(in[2]), P::load(in[3]), P::load(in[4]), P::load(in[6]), window);
    const P values[7] = {f.scaled_w, f.scaled_v, f.turn, f.first_x, f.last_x, f.first_y, f.last_y};
    for (int k = 0; k < 7; ++k) values[k].store(out[k]);
    for (int lane = 0; lane < here; ++lane) {
        records[begin + lane] = {in[0][lane],  in[1][lane],  in[3][lane], in[5][lane],
                                 out[0][lane], out[1][lane], in[6][lane], out[2][lane]};
        ranges[begin + lane] =
            tile_range(out[3][lane], out[4][lane], out[5][lane], out[6][lane], in[6][lane], window, kTile);
    }
}

// Splats are dealt to parts in depth order; each part counts, then lists, its own.
template <class S>
int64_t bin(
    const Run& run, const Screen<S>& splats, const Window& window, const Cutoffs<S>& cutoffs, Record<S>* records,
    int64_t* starts, int32_t** entries) {
    if (window.tiles_x(kTile) > kMostTiles || window.tiles_y(kTile) > kMostTiles || splats.count > INT32_MAX)
        return kTooLarge;
    const int threads = int(run.threads);
    const int64_t tiles = window.tiles(kTile);
    const int64_t parts = std::max<int64_t>(1, std::min<int64_t>(threads, splats.count / 1024));
    const auto part_begin = [&](int64_t part) { return splats.count * part / parts; };
    Scratch<TileRange> ranges(splats.count);
    std::vector<int64_t> counts(parts * tiles, 0);
    parallel_for(threads, parts, [&](int64_t part) {
        int64_t* own = counts.data() + part * tiles;
        const int64_t end = part_begin(part + 1);
        for (int64_t begin = part_begin(part); begin < end; begin += Pack<S>::size) {
            make_records(splats, window, cutoffs, begin, end, records, ranges.data());
            for (int64_t i = begin; i < std::min(end, begin + Pack<S>::size); ++i) {
                if (i + 64 < end) __builtin_prefetch(splats.opacities + splats.visible[i + 64]);
                each_tile(records[i], ranges[i], window, kTile, [&](int64_t tile) { ++own[tile]; });
            }
        }
    });
    int64_t total = 0;
    for (int64_t tile = 0; tile < tiles; ++tile) {
        starts[tile] = total;
        for (int64_t part = 0; part < parts; ++part) {
            const int64_t own = counts[part * tiles + tile];
            counts[part * tiles + tile] = total;
            total += own;
        }
    }
    starts[tiles] = total;
    int32_t* listed = *entries = allocate<int32_t>(run, total);
    parallel_for(threads, parts, [&](int64_t part) {
        int64_t* next = counts.data() + part * tiles;
        for (int64_t i = part_begin(part); i < part_begin(part + 1); ++i)
            each_tile(records[i], ranges[i], window, kTile, [&](int64_t tile) { listed[next[tile]++] = int32_t(i); });
    });
    return total;
}

}  // namespace

CATACAUSTICS_EXPORT int64_t catacaustics_tile() { return kTile; }

// Gives the memory that is kept for calls to come back to the system.
CATACAUSTICS_EXPORT void catacaustics_release() { kept_blocks().release(); }

// Returns how many entries there are; `entries` is set to the one of the allocated blocks that holds them.
#define CATACAUSTICS_BIN(S, SUFFIX)                                                                                    \
    CATACAUSTICS_EXPORT int64_t catacaustics_bin_##SUFFIX(                                                             \
        const Run* run, int64_t count, const S* means, const S* forms, const S* opacities, const int64_t* visible,     \
        int64_t x0, int64_t y0, int64_t width, int64_t height, double support, double alpha_min, Record<S>* records,   \
        int64_t* starts, int32_t** entries) {                                                                          \
        return guarded([&] {                                                                                           \
            return bin<S>(                                                                                             \
                *run, {count, means, forms, opacities, visible}, {x0, y0, width, height}, {S(support), S(alpha_min)},  \
                records, starts, entries);                                                                             \
        });                                                                                                            \
    }

CATACAUSTICS_BIN(float, f32)
CATACAUSTICS_BIN(double, f64)

}  // namespace catacaustics
