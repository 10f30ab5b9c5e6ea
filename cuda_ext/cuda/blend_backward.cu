#include "blend.h"
#include "sort.h"

namespace catacaustics {
namespace {

constexpr int kGeometry = 6;  // sums of a splat before those of the features, see PairSums

// Where sums over a tile go: rows of kGeometry + C values, one for each splat, which tiles add to; or, so that the
// order of additions is always the same, one for each entry.
template <class S>
struct Sums {
    S* rows;
    bool by_entry;
};

// Two passes over each chunk of entries, chunks back to front: from the checkpoint in front of it, T of every pair;
// then, back to front, the gradients. Nothing is divided by.
template <class S, int C>
__global__ void __launch_bounds__(kBlock) blend_gradients(
    Splats<S> splats, Window window, S stop, Slice slice, const S* g_image, const S* g_transmittance,
    const S* checkpoints, const int64_t* walked, Sums<S> sums) {
    constexpr int kValues = kGeometry + C, kPadded = kValues > 16 ? 32 : 16, chunk_size = kChunk<S>;
    static_assert(kValues <= 32, "a lane each");
    __shared__ Record<S> records[chunk_size];
    __shared__ S features[chunk_size][C];
    __shared__ unsigned touched[chunk_size];
    __shared__ S through_at[chunk_size][kBlock];
    __shared__ S partial[kWarps][chunk_size][kValues];
    const int thread = int(threadIdx.x), warp = thread / 32, lane = thread % 32;
    const int64_t tile = blockIdx.x, begin = splats.starts[tile];
    const Pixel<S> pixel(window, tile);
    S g[C] = {}, behind = S(0);
    if (pixel.index >= 0) {
#pragma unroll
        for (int c = 0; c < C; ++c)
            if (c < slice.count) g[c] = g_image[pixel.index * splats.channels + slice.first + c];
        // Gradients are linear in those of the image: the slices' sum counts transmittance once.
        if (slice.first == 0) behind = g_transmittance[pixel.index];
    }
    for (int64_t chunk = (walked[tile] + chunk_size - 1) / chunk_size; chunk-- > 0;) {
        const int64_t base = begin + chunk * chunk_size, rest = walked[tile] - chunk * chunk_size;
        const int here = int(rest < chunk_size ? rest : chunk_size);
        __syncthreads();
        if (thread < here) {
            records[thread] = splats.records[splats.entries[base + thread]];
            touched[thread] = touched_warps(records[thread], window, tile);
        }
        for (int i = thread; i < here * C; i += kBlock) {
            const int c = i % C;
            const int64_t point = splats.visible[splats.entries[base + i / C]];
            features[i / C][c] = c < slice.count ? splats.features[point * splats.channels + slice.first + c] : S(0);
        }
        __syncthreads();
        const unsigned mine = __ballot_sync(kAllLanes, lane < here && (touched[lane % chunk_size] >> warp & 1));
        S through = checkpoints[(first_checkpoint<S>(splats.starts, tile) + chunk) * kBlock + thread];
        for (unsigned left = mine; left; left &= left - 1) {
            const int i = __ffs(int(left)) - 1;
            through_at[i][thread] = through;
            const Offset<S> at(records[i], pixel.x, pixel.y, through, stop);
            blend_step(records[i].opacity, at.falloff, through);
        }
        for (unsigned left = mine; left;) {
            const int i = 31 - __clz(int(left));
            left &= ~(1u << i);
            const S opacity = records[i].opacity, t = through_at[i][thread];
            const Offset<S> at(records[i], pixel.x, pixel.y, t, stop);
            const S weight = opacity * at.falloff * t;
            S values[kPadded] = {}, shade = S(0);
#pragma unroll
            for (int c = 0; c < C; ++c) {
                shade += g[c] * features[i][c];
                values[kGeometry + c] = weight * g[c];
            }
            PairSums<S> pair{};
            add_pair(pair, blend_step_backward(opacity, at.falloff, t, shade, behind), at.skew, at.dy);
            values[0] = pair.h;
            values[1] = pair.skew;
            values[2] = pair.dy;
            values[3] = pair.skew2;
            values[4] = pair.skew_dy;
            values[5] = pair.dy2;
            const S sum = warp_sums(values);
            if (lane < kValues) partial[warp][i][lane] = sum;
        }
        __syncthreads();
        for (int k = thread; k < here * kValues; k += kBlock) {
            const int i = k / kValues, value = k % kValues;
            S total = S(0);
            for (int w = 0; w < kWarps; ++w)
                if (touched[i] >> w & 1) total += partial[w][i][value];
            if (sums.by_entry)
                sums.rows[(base + i) * kValues + value] = total;
            else if (touched[i])
                atomicAdd(&sums.rows[int64_t(splats.entries[base + i]) * kValues + value], total);
        }
    }
}

template <class S>
struct BlendGradients {
    S *means, *forms, *opacities, *features;
};

// Gradients of each splat from its rows of sums: `order` lists the entries by splat where there is a row for each, and
// is null where splats have one row each.
template <class S, int C>
__global__ void write_gradients(
    Splats<S> splats, Slice slice, const S* rows, const int32_t* splat_of, const int32_t* order, int64_t entries,
    BlendGradients<S> out) {
    constexpr int kValues = kGeometry + C;
    const int64_t splat = global_thread();
    if (splat >= splats.count) return;
    S sums[kValues] = {};
    if (order) {
        int64_t low = 0, high = entries;
        while (low < high) {
            const int64_t middle = (low + high) / 2;
            if (splat_of[middle] < splat)
                low = middle + 1;
            else
                high = middle;
        }
        for (; low < entries && splat_of[low] == splat; ++low)
            for (int k = 0; k < kValues; ++k) sums[k] += rows[int64_t(order[low]) * kValues + k];
    } else {
        for (int k = 0; k < kValues; ++k) sums[k] = rows[splat * kValues + k];
    }
    const Record<S> r = splats.records[splat];
    const SplatGradient<S> g = splat_gradient(
        PairSums<S>{sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]}, r.opacity, r.w(), r.m, r.v());
    const int64_t point = splats.visible[splat];
    out.means[2 * splat] += g.mean_x;
    out.means[2 * splat + 1] += g.mean_y;
    out.forms[3 * splat] += g.w;
    out.forms[3 * splat + 1] += g.m;
    out.forms[3 * splat + 2] += g.v;
    out.opacities[point] += g.opacity;
#pragma unroll
    for (int c = 0; c < C; ++c)
        if (c < slice.count) out.features[point * splats.channels + slice.first + c] += sums[kGeometry + c];
}

__global__ void number(int64_t count, int32_t* numbers) {
    const int64_t i = global_thread();
    if (i < count) numbers[i] = int32_t(i);
}

// What all slices of channels share.
template <class S>
struct Backward {
    const Run& run;
    Splats<S> splats;
    Window window;
    S stop;
    const S *g_image, *g_transmittance;
    BlendGradients<S> out;
    int64_t entries;
    const S* checkpoints;
    const int64_t* walked;
    const int32_t *splat_of, *order;  // entries sorted by splat, where results must not depend on the order of threads

    template <int C>
    void blend(Slice slice, S* rows) const {
        const bool by_entry = run.deterministic;
        const int64_t tiles = window.tiles(kTile), count = by_entry ? entries : splats.count;
        clear(run, rows, count * (kGeometry + C) * int64_t(sizeof(S)));
        launch(
            run, blend_gradients<S, C>, tiles, splats, window, stop, slice, g_image, g_transmittance, checkpoints,
            walked, Sums<S>{rows, by_entry});
        launch(
            run, write_gradients<S, C>, blocks_for(splats.count), splats, slice, rows, splat_of, order, entries, out);
    }
};

template <class S>
int64_t blend_backward(
    const Run& run, const Splats<S>& splats, const Window& window, S stop, const S* g_image, const S* g_transmittance,
    const BlendGradients<S>& out) {
    const int64_t tiles = window.tiles(kTile);
    if (splats.count == 0 || tiles == 0) return 0;
    const int64_t entries = read_back(run, splats.starts + tiles);
    if (entries == 0) return 0;
    S* checkpoints = allocate<S>(run, (entries / kChunk<S> + tiles + 1) * kBlock);
    int64_t* walked = allocate<int64_t>(run, tiles);
    set_checkpoints(run, splats, window, stop, checkpoints, walked);
    int32_t *splat_of = nullptr, *order = nullptr;
    if (run.deterministic) {
        int32_t* numbers = allocate<int32_t>(run, entries);
        splat_of = allocate<int32_t>(run, entries);
        order = allocate<int32_t>(run, entries);
        launch(run, number, blocks_for(entries), entries, numbers);
        sort_pairs(
            run, reinterpret_cast<const uint32_t*>(splats.entries), reinterpret_cast<uint32_t*>(splat_of), numbers,
            order, entries, 31);
    }
    const Backward<S> pass{run,     splats,      window, stop,     g_image, g_transmittance, out,
                           entries, checkpoints, walked, splat_of, order};
    const int64_t rows = run.deterministic ? entries : splats.count;
    S* sums = allocate<S>(run, rows * (kGeometry + max_channels<S>));
    int first = 0;
    do {
        const int rest = int(splats.channels) - first;
        const Slice slice{first, rest < max_channels<S> ? rest : max_channels<S>};
        if (slice.count <= 4) pass.template blend<4>(slice, sums);
        if constexpr (max_channels<S> > 4) {
            if (slice.count > 4 && slice.count <= 8) pass.template blend<8>(slice, sums);
            if (slice.count > 8) pass.template blend<16>(slice, sums);
        }
        first += slice.count;
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
        return guarded(*run, [&] {                                                                                     \
            return blend_backward<S>(                                                                                  \
                *run, {count, channels, features, visible, records, starts, entries}, {x0, y0, width, height},         \
                S(stop), g_image, g_transmittance, {g_means, g_forms, g_opacities, g_features});                       \
        });                                                                                                            \
    }

CATACAUSTICS_BLEND_BACKWARD(float, f32)
CATACAUSTICS_BLEND_BACKWARD(double, f64)

}  // namespace catacaustics
