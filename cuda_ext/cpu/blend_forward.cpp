#include <cstring>
#include <memory>

#include "guarded.h"
#include "tile.h"

namespace catacaustics {
namespace {

template <class S, int C>
struct ForwardTile {
    using P = Pack<S>;
    using Shape = TileShape<S>;

    LaneCoordinates<S> at;
    alignas(64) S image[Shape::blocks][C > 0 ? C : 1][Shape::lanes];
    alignas(64) S through[Shape::blocks][Shape::lanes];
    BlockSet<S> sets[kGroup];

    void blend(const Bins<S>& bins, int64_t tile, S tile_x, S tile_y, S stop) {
        std::memset(image, 0, sizeof image);
        for (auto& block : through) P(S(1)).store(block);
        BlockSet<S> live = kAllBlocks<S>;
        const int32_t* entries = bins.begin(tile);
        const int64_t count = bins.end(tile) - entries;
        for (int64_t first = 0; first < count; first += kGroup) {
            if (first > 0 && first % kLiveEvery == 0) live = live_blocks(through, stop);
            if (!live) return;
            const int here = int(std::min<int64_t>(count - first, kGroup));
            prefetch_group(bins, entries + first + kGroup, entries + count, C);
            find_blocks(bins, entries + first, here, tile_x, tile_y, sets);
            for (int i = 0; i < here; ++i)
                blend_splat(bins.record(entries[first + i]), sets[i] & live, tile_x, tile_y, stop);
        }
    }

    CATACAUSTICS_HD void blend_splat(const S* data, BlockSet<S> set, S tile_x, S tile_y, S stop) {
        const TileSplat<S> splat(*reinterpret_cast<const Record<S>*>(data), tile_x, tile_y);
        P color[C > 0 ? C : 1];
        for (int c = 0; c < C; ++c) color[c] = P(data[kHeader + c]);
        each_block(set, [&](int block) {
            P t = P::load(through[block]);
            const P falloff = splat.falloff(splat.offset(at, block), t, P(stop));
            const P weight = blend_step(P(splat.opacity), falloff, t);
            t.store(through[block]);
            auto& pixels = image[block];
            for (int c = 0; c < C; ++c) (P::load(pixels[c]) + weight * color[c]).store(pixels[c]);
        });
    }
};

template <class S>
struct Target {
    S *image, *transmittance;
    int channels, first;  // channels of the image; the first that this slice computes
};

template <class S, int C>
void blend_tiles(const Bins<S>& bins, int threads, S stop, const Target<S>& target) {
    using Shape = TileShape<S>;
    const Window& w = bins.window;
    parallel_for(threads, w.tiles(kTile), [&](int64_t tile) {
        static thread_local const std::unique_ptr<ForwardTile<S, C>> state(new ForwardTile<S, C>);
        const int64_t x0 = tile % w.tiles_x(kTile) * kTile, y0 = tile / w.tiles_x(kTile) * kTile;
        state->blend(bins, tile, S(w.x0 + x0) + S(0.5), S(w.y0 + y0) + S(0.5), stop);
        const int columns = int(std::min<int64_t>(kTile, w.width - x0));
        const int rows = int(std::min<int64_t>(kTile, w.height - y0));
        for (int y = 0; y < rows; ++y) {
            const int64_t row = (y0 + y) * w.width + x0;
            for (int x = 0; x < columns; ++x) {
                const int block = Shape::block(x, y), lane = Shape::lane(x, y);
                S* pixel = target.image + (row + x) * target.channels + target.first;
                for (int c = 0; c < C; ++c) pixel[c] = state->image[block][c][lane];
                if (target.first == 0) target.transmittance[row + x] = state->through[block][lane];
            }
        }
    });
}

template <class S>
int64_t blend(const Splats<S>& splats, const Window& window, S stop, int threads, S* image, S* transmittance) {
    Bins<S> bins(splats, window);
    int first = 0;
    do {  // at least once: without channels there is still transmittance
        const int channels = int(std::min<int64_t>(max_channels<S>, splats.channels - first));
        bins.pack(first, channels, threads);
        with_channels<S>(channels, [&](auto c) {
            blend_tiles<S, c()>(bins, threads, stop, {image, transmittance, int(splats.channels), first});
        });
        first += channels;
    } while (first < splats.channels);
    return 0;
}

}  // namespace

#define CATACAUSTICS_BLEND(S, SUFFIX)                                                                                  \
    CATACAUSTICS_EXPORT int64_t catacaustics_blend_##SUFFIX(                                                           \
        const Run* run, int64_t count, int64_t channels, const S* features, const int64_t* visible,                    \
        const Record<S>* records, const int64_t* starts, const int32_t* entries, int64_t x0, int64_t y0,               \
        int64_t width, int64_t height, double stop, S* image, S* transmittance) {                                      \
        return guarded([&] {                                                                                           \
            return blend<S>(                                                                                           \
                {count, channels, features, visible, records, starts, entries}, {x0, y0, width, height}, S(stop),      \
                int(run->threads), image, transmittance);                                                              \
        });                                                                                                            \
    }

CATACAUSTICS_BLEND(float, f32)
CATACAUSTICS_BLEND(double, f64)

}  // namespace catacaustics
