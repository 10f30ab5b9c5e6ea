#include "blend.h"

namespace catacaustics {
namespace {

template <class S>
struct BlendTarget {
    S *image, *transmittance;  // null where not wanted
    S* checkpoints;            // null where not wanted; see blend.h
    int64_t* walked;
};

// C: the most channels in a slice.
template <class S, int C>
__global__ void __launch_bounds__(kBlock)
    blend_tiles(Splats<S> splats, Window window, S stop, Slice slice, BlendTarget<S> target) {
    constexpr int kGroup = C == 0 ? kChunk<S> : 32;  // entries that a warp looks at together
    __shared__ Record<S> records[kBlock];
    __shared__ S features[kBlock * (C > 0 ? C : 1)];
    __shared__ unsigned touched[kBlock];
    const int thread = int(threadIdx.x), warp = thread / 32, lane = thread % 32;
    const int64_t tile = blockIdx.x, begin = splats.starts[tile], end = splats.starts[tile + 1];
    const Pixel<S> pixel(window, tile);
    S through = S(1), color[C > 0 ? C : 1] = {};
    int64_t base = begin;
    for (; base < end; base += kBlock) {
        // Without early stop, pixels that let no light through are finished; but they have checkpoints.
        const bool alive = pixel.index >= 0 && through >= stop && (target.checkpoints || through != S(0));
        if (!__syncthreads_or(alive)) break;
        const int here = int(end - base < kBlock ? end - base : kBlock);
        if (thread < here) {
            const int32_t splat = splats.entries[base + thread];
            records[thread] = splats.records[splat];
            touched[thread] = touched_warps(records[thread], window, tile);
            const S* from = splats.features + splats.visible[splat] * splats.channels + slice.first;
#pragma unroll
            for (int c = 0; c < C; ++c) features[thread * C + c] = c < slice.count ? from[c] : S(0);
        }
        __syncthreads();
        for (int group = 0; group < here; group += kGroup) {
            if (C == 0 && target.checkpoints) {
                const int64_t chunk = first_checkpoint<S>(splats.starts, tile) + (base - begin + group) / kChunk<S>;
                target.checkpoints[chunk * kBlock + thread] = through;
            }
            const bool mine = lane < kGroup && group + lane < here && (touched[group + lane] >> warp & 1);
            for (unsigned rest = __ballot_sync(kAllLanes, mine); rest; rest &= rest - 1) {
                const int i = group + __ffs(int(rest)) - 1;
                const Offset<S> at(records[i], pixel.x, pixel.y, through, stop);
                const S weight = blend_step(records[i].opacity, at.falloff, through);
#pragma unroll
                for (int c = 0; c < C; ++c) color[c] += weight * features[i * C + c];
            }
        }
    }
    if (target.walked && thread == 0) target.walked[tile] = (base < end ? base : end) - begin;
    if (pixel.index < 0) return;
    if (target.transmittance) target.transmittance[pixel.index] = through;
#pragma unroll
    for (int c = 0; c < C; ++c)
        if (c < slice.count) target.image[pixel.index * splats.channels + slice.first + c] = color[c];
}

template <class S>
int64_t blend(const Run& run, const Splats<S>& splats, const Window& window, S stop, S* image, S* transmittance) {
    int first = 0;
    do {  // at least once: without channels there is still transmittance
        const int rest = int(splats.channels) - first;
        const Slice slice{first, rest < max_channels<S> ? rest : max_channels<S>};
        const BlendTarget<S> target{image, first == 0 ? transmittance : nullptr, nullptr, nullptr};
        auto kernel = blend_tiles<S, 0>;
        if (slice.count > 0) kernel = blend_tiles<S, 4>;
        if constexpr (max_channels<S> > 4) {
            if (slice.count > 4) kernel = blend_tiles<S, 8>;
            if (slice.count > 8) kernel = blend_tiles<S, 16>;
        }
        launch(run, kernel, window.tiles(kTile), splats, window, stop, slice, target);
        first += slice.count;
    } while (first < splats.channels);
    return 0;
}

}  // namespace

template <class S>
void set_checkpoints(
    const Run& run, const Splats<S>& splats, const Window& window, S stop, S* checkpoints, int64_t* walked) {
    const BlendTarget<S> target{nullptr, nullptr, checkpoints, walked};
    launch(run, blend_tiles<S, 0>, window.tiles(kTile), splats, window, stop, Slice{0, 0}, target);
}

template void set_checkpoints(const Run&, const Splats<float>&, const Window&, float, float*, int64_t*);
template void set_checkpoints(const Run&, const Splats<double>&, const Window&, double, double*, int64_t*);

#define CATACAUSTICS_BLEND(S, SUFFIX)                                                                                  \
    CATACAUSTICS_EXPORT int64_t catacaustics_blend_##SUFFIX(                                                           \
        const Run* run, int64_t count, int64_t channels, const S* features, const int64_t* visible,                    \
        const Record<S>* records, const int64_t* starts, const int32_t* entries, int64_t x0, int64_t y0,               \
        int64_t width, int64_t height, double stop, S* image, S* transmittance) {                                      \
        return guarded(*run, [&] {                                                                                     \
            return blend<S>(                                                                                           \
                *run, {count, channels, features, visible, records, starts, entries}, {x0, y0, width, height},         \
                S(stop), image, transmittance);                                                                        \
        });                                                                                                            \
    }

CATACAUSTICS_BLEND(float, f32)
CATACAUSTICS_BLEND(double, f64)

}  // namespace catacaustics
