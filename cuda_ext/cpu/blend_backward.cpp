#include <cstring>
#include <memory>
#include <vector>

#include "guarded.h"
#include "tile.h"

namespace catacaustics {
namespace {

// Gradients of a splat from one tile, before they are summed over its tiles: kGeometry values, then the features'.
constexpr int kGeometry = 6;
// Such gradients held at a time.
constexpr int64_t kBatchBytes = int64_t(1) << 27;

constexpr int gradient_stride(int channels) { return (kGeometry + channels + 7) / 8 * 8; }

template <class S>
struct Gradients {
    const S *g_image, *g_transmittance;
    S *means, *forms, *opacities, *features;
};

// Goes through the entries of a tile front to back and then back to front. The way back is compiled for every number of
// channels, the rest once.
template <class S>
class TileSweeps {
    using P = Pack<S>;
    using Shape = TileShape<S>;

   public:
    struct Pair {
        alignas(64) S falloff[Shape::lanes], through[Shape::lanes];
    };
    struct Place {
        S x, y;  // the tile's first pixel centre
        S stop;
        int channels;
    };
    LaneCoordinates<S> at;

    // Front to back, leaving checkpoints; returns how many entries come before those that are drawn nowhere.
    int64_t to_the_back(const Bins<S>& bins, const int32_t* entries, int64_t count, Place place) {
        for (auto& block : through_) P(S(1)).store(block);
        checkpoints_.clear();
        for (int64_t entry = 0; entry < count;) {
            checkpoints_.emplace_back();
            checkpoints_.back().entry = entry;
            std::memcpy(checkpoints_.back().through, through_, sizeof through_);
            entry = sweep(bins, entries, entry, count, place);
            if (!live_) return entry;
        }
        return count;
    }

    // Calls function(entry, its blocks, their pairs) from the entry before `end` to the first.
    template <class F>
    void to_the_front(
        const Bins<S>& bins, const int32_t* entries, int64_t end, Place place, F&& function) {
        for (std::size_t k = checkpoints_.size(); k-- > 0;) {
            const int64_t begin = checkpoints_[k].entry;
            if (k + 1 < checkpoints_.size()) {  // the store holds the pairs of the last one
                std::memcpy(through_, checkpoints_[k].through, sizeof through_);
                sweep(bins, entries, begin, end, place);
            }
            for (; end-- > begin;) {
                if (end >= begin + kGroup) prefetch_record(bins.record(entries[end - kGroup]), place.channels);
                const BlockSet<S> set = sets_[end - begin];
                held_ -= count_blocks(set);
                function(end, set, pairs_ + held_);
            }
            end = begin;
        }
    }

   private:
    // Blocks of pairs held at a time.
    static constexpr int kStored = 1 << 13;
    // Transmittance in front of an entry from which a later sweep starts again.
    struct Checkpoint {
        int64_t entry;
        alignas(64) S through[Shape::blocks][Shape::lanes];
    };

    // Front to back from entry `from`, storing the pairs, until they fill the store; returns the entry after the last.
    int64_t sweep(const Bins<S>& bins, const int32_t* entries, int64_t from, int64_t count, Place place) {
        sets_.clear();
        int stored = 0;
        // Without early stop all count: the gradient of an opaque splat is the difference that it makes.
        live_ = kAllBlocks<S>;
        for (const int64_t first = from; from < count && stored + kGroup * Shape::blocks <= kStored;) {
            if (place.stop > S(0) && (from - first) % kLiveEvery == 0) live_ = live_blocks(through_, place.stop);
            if (!live_) break;
            const int here = int(std::min<int64_t>(count - from, kGroup));
            prefetch_group(bins, entries + from + kGroup, entries + count, place.channels);
            sets_.resize(sets_.size() + here);
            BlockSet<S>* own = &sets_[sets_.size() - here];
            find_blocks(bins, entries + from, here, place.x, place.y, own);
            for (int i = 0; i < here; ++i) {
                own[i] &= live_;
                const TileSplat<S> splat(bins.header(entries[from + i]), place.x, place.y);
                each_block(own[i], [&](int block) {
                    P t = P::load(through_[block]);
                    const P falloff = splat.falloff(splat.offset(at, block), t, P(place.stop));
                    t.store(pairs_[stored].through);
                    falloff.store(pairs_[stored].falloff);
                    blend_step(P(splat.opacity), falloff, t);
                    t.store(through_[block]);
                    ++stored;
                });
            }
            from += here;
        }
        held_ = stored;
        return from;
    }

    alignas(64) S through_[Shape::blocks][Shape::lanes];
    Pair pairs_[kStored];
    BlockSet<S> live_;
    int held_;  // blocks of pairs
    std::vector<BlockSet<S>> sets_;  // of the entries whose pairs are held
    std::vector<Checkpoint> checkpoints_;
};

// Of this thread, for all numbers of channels.
template <class S>
TileSweeps<S>& own_sweeps() {
    static thread_local const std::unique_ptr<TileSweeps<S>> sweeps(new TileSweeps<S>);
    return *sweeps;
}

template <class S, int C>
struct BackwardTile {
    using P = Pack<S>;
    using Shape = TileShape<S>;
    using Sweeps = TileSweeps<S>;
    static constexpr int kSums = gradient_stride(C);

    alignas(64) S g_image[Shape::blocks][C > 0 ? C : 1][Shape::lanes];
    alignas(64) S behind[Shape::blocks][Shape::lanes];

    // Writes the gradients of every entry of the tile.
    void blend(const Bins<S>& bins, int64_t tile, S tile_x, S tile_y, S stop, S* out) {
        Sweeps& sweeps = own_sweeps<S>();
        const typename Sweeps::Place place{tile_x, tile_y, stop, C};
        const int32_t* entries = bins.begin(tile);
        const int64_t count = bins.end(tile) - entries, stride = gradient_stride(C);
        const int64_t drawn = sweeps.to_the_back(bins, entries, count, place);
        std::memset(out + drawn * stride, 0, (count - drawn) * stride * sizeof(S));
        sweeps.to_the_front(
            bins, entries, drawn, place,
            [&](int64_t entry, BlockSet<S> set, const typename Sweeps::Pair* pairs) {
                blend_splat(
                    bins.header(entries[entry]), bins.record(entries[entry]) + kHeader, sweeps.at, set, pairs, tile_x,
                    tile_y, out + entry * stride);
            });
    }

    CATACAUSTICS_HD void blend_splat(
        const Record<S>& record, const S* features, const LaneCoordinates<S>& at, BlockSet<S> set,
        const typename Sweeps::Pair* pair, S tile_x, S tile_y, S* out) {
        const TileSplat<S> splat(record, tile_x, tile_y);
        const P opacity(splat.opacity), zero(S(0));
        P feature[C > 0 ? C : 1], sums[kSums];
        for (int c = 0; c < C; ++c) feature[c] = P(features[c]);
        for (auto& sum : sums) sum = zero;
        PairSums<P> geometry{zero, zero, zero, zero, zero, zero};
        each_block(set, [&](int block) {
            const P falloff = P::load(pair->falloff), t = P::load(pair->through);
            ++pair;
            const P weight = opacity * falloff * t;
            P color = zero;
            for (int c = 0; c < C; ++c) {
                const P g = P::load(g_image[block][c]);
                color = color + g * feature[c];
                sums[kGeometry + c] = sums[kGeometry + c] + weight * g;
            }
            P r = P::load(behind[block]);
            const P h = blend_step_backward(opacity, falloff, t, color, r);
            r.store(behind[block]);
            const auto d = splat.offset(at, block);
            add_pair(geometry, h, d.skew, d.dy);
        });
        sums[0] = geometry.h;
        sums[1] = geometry.skew;
        sums[2] = geometry.dy;
        sums[3] = geometry.skew2;
        sums[4] = geometry.skew_dy;
        sums[5] = geometry.dy2;
        sum_lanes<kSums>(sums, out);
        const PairSums<S> total{out[0], out[1], out[2], out[3], out[4], out[5]};
        const SplatGradient<S> g = splat_gradient(total, record.opacity, record.w(), record.m, record.v());
        out[0] = g.mean_x;
        out[1] = g.mean_y;
        out[2] = g.w;
        out[3] = g.m;
        out[4] = g.v;
        out[5] = g.opacity;
    }
};

// Adds up the gradients of a batch's entries splat by splat, over tiles in order.
template <class S>
void reduce(
    const Bins<S>& bins, int64_t first_tile, int64_t last_tile, int threads, const S* entry_gradients,
    const Splats<S>& splats, int first_channel, int channels, const Gradients<S>& out) {
    const int64_t stride = gradient_stride(channels), chunk = 4096;
    const int64_t chunks = (splats.count + chunk - 1) / chunk, parts = std::min<int64_t>(chunks, 4 * threads);
    parallel_for(threads, parts, [&](int64_t part) {
        const int64_t begin = chunks * part / parts * chunk;
        const int64_t end = std::min(splats.count, chunks * (part + 1) / parts * chunk);
        std::vector<const int32_t*> next(last_tile - first_tile);
        for (int64_t tile = first_tile; tile < last_tile; ++tile)
            next[tile - first_tile] = std::lower_bound(bins.begin(tile), bins.end(tile), int32_t(begin));
        Scratch<S> sums(chunk * stride);
        for (int64_t low = begin; low < end; low += chunk) {
            const int64_t high = std::min(end, low + chunk);
            std::memset(sums.data(), 0, (high - low) * stride * sizeof(S));
            for (int64_t tile = first_tile; tile < last_tile; ++tile) {
                if (tile + 2 < last_tile) {
                    const int64_t ahead = next[tile + 2 - first_tile] - bins.begin(first_tile);
                    const S* row = entry_gradients + ahead * stride;
                    for (int line = 0; line < 4; ++line) __builtin_prefetch(row + 16 * line);
                }
                const int32_t *entry = next[tile - first_tile], *tile_end = bins.end(tile);
                const S* from = entry_gradients + (entry - bins.begin(first_tile)) * stride;
                for (; entry < tile_end && *entry < high; ++entry, from += stride) {
                    S* to = sums.data() + (*entry - low) * stride;
                    for (int64_t k = 0; k < stride; ++k) to[k] += from[k];
                }
                next[tile - first_tile] = entry;
            }
            for (int64_t i = low; i < high; ++i) {
                if (i + 16 < high) {
                    const int64_t later = splats.visible[i + 16];
                    __builtin_prefetch(out.opacities + later, 1);
                    __builtin_prefetch(out.features + later * splats.channels + first_channel, 1);
                }
                const S* sum = sums.data() + (i - low) * stride;
                const int64_t point = splats.visible[i];
                for (int k = 0; k < 2; ++k) out.means[2 * i + k] += sum[k];
                for (int k = 0; k < 3; ++k) out.forms[3 * i + k] += sum[2 + k];
                out.opacities[point] += sum[5];
                S* features = out.features + point * splats.channels + first_channel;
                for (int c = 0; c < channels; ++c) features[c] += sum[kGeometry + c];
            }
        }
    });
}

template <class S, int C>
void blend_tiles(
    const Bins<S>& bins, int64_t first_tile, int64_t last_tile, int threads, S stop, const Splats<S>& splats,
    int first_channel, const Gradients<S>& gradients, S* entry_gradients) {
    using Shape = TileShape<S>;
    const Window& w = bins.window;
    parallel_for(threads, last_tile - first_tile, [&](int64_t task) {
        static thread_local const std::unique_ptr<BackwardTile<S, C>> state(new BackwardTile<S, C>);
        const int64_t tile = first_tile + task;
        const int64_t x0 = tile % w.tiles_x(kTile) * kTile, y0 = tile / w.tiles_x(kTile) * kTile;
        const int columns = int(std::min<int64_t>(kTile, w.width - x0));
        const int rows = int(std::min<int64_t>(kTile, w.height - y0));
        if (columns < kTile || rows < kTile) {
            std::memset(state->g_image, 0, sizeof state->g_image);
            std::memset(state->behind, 0, sizeof state->behind);
        }
        for (int y = 0; y < rows; ++y) {
            const int64_t row = (y0 + y) * w.width + x0;
            for (int x = 0; x < columns; ++x) {
                const int block = Shape::block(x, y), lane = Shape::lane(x, y);
                const S* pixel = gradients.g_image + (row + x) * splats.channels + first_channel;
                for (int c = 0; c < C; ++c) state->g_image[block][c][lane] = pixel[c];
                // Gradients are linear in those of the image: the slices' sum counts transmittance once.
                state->behind[block][lane] = first_channel == 0 ? gradients.g_transmittance[row + x] : S(0);
            }
        }
        state->blend(
            bins, tile, S(w.x0 + x0) + S(0.5), S(w.y0 + y0) + S(0.5), stop,
            entry_gradients + bins.entries_between(first_tile, tile) * gradient_stride(C));
    });
}

template <class S>
int64_t blend_backward(
    const Splats<S>& splats, const Window& window, S stop, int threads, const Gradients<S>& gradients) {
    Bins<S> bins(splats, window);
    Scratch<S> entry_gradients;
    int64_t room = 0;
    int first = 0;
    do {
        const int channels = int(std::min<int64_t>(max_channels<S>, splats.channels - first));
        bins.pack(first, channels, threads);
        const int64_t stride = gradient_stride(channels);
        for (int64_t tile = 0; tile < window.tiles(kTile);) {
            const int64_t last = bins.batch_end(tile, kBatchBytes / (stride * int64_t(sizeof(S))));
            const int64_t needed = bins.entries_between(tile, last) * stride;
            if (needed > room) entry_gradients.allocate(room = needed);
            with_channels<S>(channels, [&](auto c) {
                blend_tiles<S, c()>(bins, tile, last, threads, stop, splats, first, gradients, entry_gradients.data());
            });
            reduce(bins, tile, last, threads, entry_gradients.data(), splats, first, channels, gradients);
            tile = last;
        }
        first += channels;
    } while (first < splats.channels);
    return 0;
}

}  // namespace

// The gradients are added to what is there.
#define CATACAUSTICS_BLEND_BACKWARD(S, SUFFIX)                                                                         \
    CATACAUSTICS_EXPORT int64_t catacaustics_blend_backward_##SUFFIX(                                                  \
        const Run* run, int64_t count, int64_t channels, const S* features, const int64_t* visible,                    \
        const Record<S>* records, const int64_t* starts, const int32_t* entries, int64_t x0, int64_t y0,               \
        int64_t width, int64_t height, double stop, const S* g_image, const S* g_transmittance, S* g_means,            \
        S* g_forms, S* g_opacities, S* g_features) {                                                                   \
        return guarded([&] {                                                                                           \
            return blend_backward<S>(                                                                                  \
                {count, channels, features, visible, records, starts, entries}, {x0, y0, width, height}, S(stop),      \
                int(run->threads), {g_image, g_transmittance, g_means, g_forms, g_opacities, g_features});             \
        });                                                                                                            \
    }

CATACAUSTICS_BLEND_BACKWARD(float, f32)
CATACAUSTICS_BLEND_BACKWARD(double, f64)

}  // namespace catacaustics
