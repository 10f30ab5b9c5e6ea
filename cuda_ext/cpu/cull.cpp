#include <algorithm>
#include <vector>

#include "../math/projection.h"
#include "columns.h"
#include "guarded.h"
#include "threads.h"

namespace catacaustics {
namespace {

// Points in one task.
constexpr int64_t kChunk = 8192;

template <class S>
struct Cull {
    int64_t count;
    const S *positions, *footprints;
    View<Pack<S>> view;
    Frame<S> frame;
    S low_pass, support;
};

// Lists the points of [begin, end) that may touch the window; `visible` has room for all of them.
template <class S>
int64_t cull_chunk(const Cull<S>& cull, int64_t begin, int64_t end, int64_t* visible) {
    using P = Pack<S>;
    alignas(64) S footprint[P::size];
    Columns<S> columns;
    int64_t kept = 0;
    for (int64_t first = begin; first < end; first += P::size) {
        const int here = int(std::min<int64_t>(P::size, end - first));
        for (int lane = 0; lane < P::size; ++lane)
            footprint[lane] = cull.footprints[first + std::min(lane, here - 1)];
        const auto touches = may_touch(
            cull.view, columns.load(cull.positions, first, here), P::load(footprint), P(cull.support),
            P(cull.low_pass), cull.frame);
        if (!any<S>(touches)) continue;
        for (int lane = 0; lane < here; ++lane) {
            visible[kept] = first + lane;
            kept += touches[lane] != 0;
        }
    }
    return kept;
}

template <class S>
int64_t cull(const Cull<S>& points, int threads, int64_t* visible) {
    const int64_t chunks = (points.count + kChunk - 1) / kChunk;
    std::vector<int64_t> kept(chunks);
    parallel_for(threads, chunks, [&](int64_t chunk) {
        const int64_t begin = chunk * kChunk, end = std::min(points.count, begin + kChunk);
        kept[chunk] = cull_chunk(points, begin, end, visible + begin);
    });
    int64_t count = 0;
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
        std::memmove(visible + count, visible + chunk * kChunk, kept[chunk] * sizeof *visible);
        count += kept[chunk];
    }
    return count;
}

}  // namespace

// Points that may touch the window, ascending; `visible` has room for all points. Returns how many there are.
#define CATACAUSTICS_CULL(S, SUFFIX)                                                                                \
    CATACAUSTICS_EXPORT int64_t catacaustics_cull_##SUFFIX(                                                         \
        const Run* run, int64_t count, const S* positions, const S* footprints, const S* pose, const S* lens,       \
        int64_t x0, int64_t y0, int64_t width, int64_t height, double low_pass, double support, double near,        \
        double guard_left, double guard_top, double guard_right, double guard_bottom, int64_t* visible) {           \
        return guarded([&] {                                                                                        \
            const Frame<S> frame{S(x0),         S(y0),        S(x0 + width),  S(y0 + height), S(guard_left),        \
                                 S(guard_top),  S(guard_right), S(guard_bottom), S(near)};                          \
            return cull<S>(                                                                                         \
                {count, positions, footprints, make_view<Pack<S>>(pose, lens), frame, S(low_pass), S(support)},     \
                int(run->threads), visible);                                                                        \
        });                                                                                                         \
    }

CATACAUSTICS_CULL(float, f32)
CATACAUSTICS_CULL(double, f64)

}  // namespace catacaustics
