#include "../math/quadric.h"

#include <algorithm>
#include <limits>

#include "columns.h"
#include "guarded.h"
#include "scratch.h"
#include "threads.h"

namespace catacaustics {
namespace {

// Sources in one task; fixed, so that sums over sources do not depend on the number of threads.
constexpr int64_t kChunk = 2048;
constexpr int kIterations = 20;

template <class S>
CATACAUSTICS_HD void store(Pack<S> v, S* to, int64_t first, int here) {
    alignas(64) S values[Pack<S>::size];
    v.store(values);
    std::copy(values, values + here, to + first);
}

// Calls function(first, here) for every pack of a chunk.
template <class S, class F>
void each_pack(int64_t count, int threads, F&& function) {
    parallel_for(threads, (count + kChunk - 1) / kChunk, [&](int64_t chunk) {
        const int64_t end = std::min(count, (chunk + 1) * kChunk);
        for (int64_t first = chunk * kChunk; first < end; first += Pack<S>::size)
            function(first, int(std::min<int64_t>(Pack<S>::size, end - first)), chunk);
    });
}

// Newton's method on a convex mirror, where L has one minimum. A step that makes the path longer is taken back and cut to
// a quarter: near the mirror L is no parabola.
template <class S>
CATACAUSTICS_HD Vec3<Pack<S>> stationary(const Mirror<Pack<S>>& mirror, Vec3<Pack<S>> source, S tolerance) {
    using P = Pack<S>;
    const P rounding(1 + 8 * std::numeric_limits<S>::epsilon());
    Vec3<P> u = first_guess(mirror, source), best = u, move{P(S(0)), P(S(0)), P(S(0))};
    P least(std::numeric_limits<S>::max());
    for (int i = 0; i < kIterations; ++i) {
        MirrorPath<P> path(mirror, source, u, kTinyLength<S>);
        path.make_convex();
        const auto step = path.step(kTinyLength<S>);
        const P total = path.camera_distance + path.source_distance;
        const auto shorter = total <= least * rounding;
        const Vec3<P> next = path.basis.combine(step.cut * step.x, step.cut * step.y);
        least = select(shorter, total, least);
        best = select(shorter, u, best);
        move = select(shorter, next, P(S(0.25)) * move);
        u = normalized(best - move);
        if (!any<S>(dot(move, move) >= P(tolerance * tolerance))) break;
    }
    return u;
}

template <class S>
struct Images {
    S *u, *positions, *normals, *stretch, *near;
    uint8_t* visible;
};

template <class S>
int64_t images(
    const Run& run, int64_t count, const S* sources, const Mirror<Pack<S>>& mirror, bool solve, const Images<S>& out) {
    using P = Pack<S>;
    const S eps = std::numeric_limits<S>::epsilon(), tolerance = std::pow(eps, S(0.6));
    const S least = std::numeric_limits<S>::min();
    each_pack<S>(count, int(run.threads), [&](int64_t first, int here, int64_t) {
        Columns<S> columns;
        const Vec3<P> source = columns.load(sources, first, here);
        Vec3<P> u;
        if (solve) {
            u = stationary(mirror, source, tolerance);
            columns.store(u, out.u, first, here);
        } else {
            u = columns.load(out.u, first, here);
        }
        const MirrorPath<P> path(mirror, source, u, kTinyLength<S>);
        const auto shown = display(mirror, source, normalized(path.moved(u, path.step(kTinyLength<S>))));
        columns.store(shown.position, out.positions, first, here);
        store(shown.near, out.near, first, here);
        Vec3<P> normal;
        P stretch;
        image_disk(path, P(-1) * shown.direction, kTinyLength<S>, least, normal, stretch);
        columns.store(normal, out.normals, first, here);
        store(stretch, out.stretch, first, here);
        const auto visible = reflects(mirror, path, u);
        for (int lane = 0; lane < here; ++lane) out.visible[first + lane] = visible[lane] != 0;
    });
    return 0;
}

template <class S>
int64_t positions(
    const Run& run, int64_t count, const S* sources, const S* start, const Mirror<Pack<S>>& mirror, S* out, S* near) {
    each_pack<S>(count, int(run.threads), [&](int64_t first, int here, int64_t) {
        Columns<S> columns;
        const Vec3<Pack<S>> source = columns.load(sources, first, here), u = columns.load(start, first, here);
        const MirrorPath<Pack<S>> path(mirror, source, u, kTinyLength<S>);
        const auto shown = display(mirror, source, normalized(path.moved(u, path.step(kTinyLength<S>))));
        columns.store(shown.position, out, first, here);
        store(shown.near, near, first, here);
    });
    return 0;
}

template <class S>
int64_t positions_backward(
    const Run& run, int64_t count, const S* sources, const S* start, const Mirror<Pack<S>>& mirror, const S* g,
    S* g_sources, S* g_mirror) {
    using P = Pack<S>;
    const int64_t chunks = (count + kChunk - 1) / kChunk;
    Scratch<double> sums(chunks * kMirrorValues);
    std::fill(sums.data(), sums.data() + chunks * kMirrorValues, 0.0);
    each_pack<S>(count, int(run.threads), [&](int64_t first, int here, int64_t chunk) {
        Columns<S> columns;
        const Vec3<P> source = columns.load(sources, first, here), u = columns.load(start, first, here);
        P terms[kMirrorValues];
        const Vec3<P> g_source =
            display_backward(mirror, source, u, columns.load(g, first, here), kTinyLength<S>, terms);
        columns.store(g_source, g_sources, first, here);
        for (int k = 0; k < kMirrorValues; ++k)
            for (int lane = 0; lane < here; ++lane) sums[chunk * kMirrorValues + k] += double(terms[k].v[lane]);
    });
    for (int k = 0; k < kMirrorValues; ++k) {
        double total = 0;
        for (int64_t chunk = 0; chunk < chunks; ++chunk) total += sums[chunk * kMirrorValues + k];
        g_mirror[k] = S(total);
    }
    return 0;
}

}  // namespace

// camera (3), center (3), axes (3, 3); sources, u, positions, normals (count, 3); stretch, near, visible (count). `u` is
// written where solve is 1, and else read. g_mirror: gradients of camera, center and axes (15 values).
#define CATACAUSTICS_QUADRIC(S, SUFFIX)                                                                                \
    CATACAUSTICS_EXPORT int64_t catacaustics_quadric_images_##SUFFIX(                                                  \
        const Run* run, int64_t count, const S* sources, const S* camera, const S* center, const S* axes,              \
        int64_t concave, int64_t solve, S* u, S* positions, S* normals, S* stretch, S* near, uint8_t* visible) {       \
        return guarded([&] {                                                                                           \
            const auto mirror = make_mirror<Pack<S>>(camera, center, axes, concave != 0);                              \
            return images<S>(                                                                                          \
                *run, count, sources, mirror, solve != 0, {u, positions, normals, stretch, near, visible});            \
        });                                                                                                            \
    }                                                                                                                  \
    CATACAUSTICS_EXPORT int64_t catacaustics_quadric_positions_##SUFFIX(                                               \
        const Run* run, int64_t count, const S* sources, const S* u, const S* camera, const S* center, const S* axes,  \
        S* out, S* near) {                                                                                             \
        return guarded([&] {                                                                                           \
            const auto mirror = make_mirror<Pack<S>>(camera, center, axes, false);                                     \
            return positions<S>(*run, count, sources, u, mirror, out, near);                                           \
        });                                                                                                            \
    }                                                                                                                  \
    CATACAUSTICS_EXPORT int64_t catacaustics_quadric_backward_##SUFFIX(                                                \
        const Run* run, int64_t count, const S* sources, const S* u, const S* camera, const S* center, const S* axes,  \
        const S* g_positions, S* g_sources, S* g_mirror) {                                                             \
        return guarded([&] {                                                                                           \
            const auto mirror = make_mirror<Pack<S>>(camera, center, axes, false);                                     \
            return positions_backward<S>(*run, count, sources, u, mirror, g_positions, g_sources, g_mirror);           \
        });                                                                                                            \
    }

CATACAUSTICS_QUADRIC(float, f32)
CATACAUSTICS_QUADRIC(double, f64)

}  // namespace catacaustics
