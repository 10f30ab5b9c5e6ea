#include <algorithm>
#include <cmath>
#include <vector>

#include "../math/projection.h"
#include "bins.h"
#include "guarded.h"
#include "sort.h"

namespace catacaustics {
namespace {

// Points in one task; fixed, so that sums over points do not depend on the number of threads.
constexpr int64_t kChunk = 8192;

template <class S>
struct Points {
    int64_t count;
    const S *positions, *normals, *footprints, *opacities;
};

// A pack's worth of points, lane by lane; index(lane) names the point.
template <class S>
struct PointPack {
    alignas(64) S position[3][Pack<S>::size], normal[3][Pack<S>::size], footprint[Pack<S>::size];

    template <class Index>
    CATACAUSTICS_HD PointPack(const S* positions, const S* normals, const S* footprints, Index&& index) {
        for (int lane = 0; lane < Pack<S>::size; ++lane) {
            const int64_t i = index(lane);
            for (int k = 0; k < 3; ++k) {
                position[k][lane] = positions[3 * i + k];
                normal[k][lane] = normals[3 * i + k];
            }
            footprint[lane] = footprints[i];
        }
    }
    Vec3<Pack<S>> p() const { return load(position); }
    Vec3<Pack<S>> n() const { return load(normal); }
    Pack<S> s() const { return Pack<S>::load(footprint); }

   private:
    static Vec3<Pack<S>> load(const S (&from)[3][Pack<S>::size]) {
        return {Pack<S>::load(from[0]), Pack<S>::load(from[1]), Pack<S>::load(from[2])};
    }
};

template <class S>
bool all_finite(const S* values, int64_t count) {
    int bad = 0;
    for (int64_t i = 0; i < count; ++i) bad |= int(!is_finite(values[i]));
    return !bad;
}

// Finite, footprints in [0, kLargestFootprint] and opacities in [0, 1].
template <class S>
bool valid(const Points<S>& points, int64_t begin, int64_t end) {
    if (!all_finite(points.positions + 3 * begin, 3 * (end - begin))) return false;
    if (!all_finite(points.normals + 3 * begin, 3 * (end - begin))) return false;
    int bad = 0;
    for (int64_t i = begin; i < end; ++i)
        bad |= int(!(points.footprints[i] >= S(0))) | int(!(points.footprints[i] <= S(kLargestFootprint))) |
               int(!(points.opacities[i] >= S(0))) | int(!(points.opacities[i] <= S(1)));
    return !bad;
}

template <class S>
struct ProjectTarget {
    S *means, *forms;
    int64_t* visible;
};

template <class S>
struct Drawn {
    Frame<S> frame;
    Cutoffs<S> cutoffs;
    S low_pass;
};

template <class S>
struct Packed {
    S mean_x, mean_y, w, m, v;
};

// Projects every point and keeps those that can touch the window: its key for sorting, number and screen splat.
template <class S>
int64_t project_chunk(
    const Points<S>& points, const View<Pack<S>>& view, const Drawn<S>& drawn, int64_t begin, int64_t end,
    SortItem<S>* items, Packed<S>* splats) {
    using P = Pack<S>;
    int64_t kept = 0;
    alignas(64) S out[8][P::size], reach[P::size];
    for (int64_t first = begin; first < end; first += P::size) {
        const int here = int(std::min<int64_t>(P::size, end - first));
        const auto point = [&](int lane) { return first + std::min(lane, here - 1); };
        const PointPack<S> pack(points.positions, points.normals, points.footprints, point);
        const auto splat = screen_splat(view, project_disk(view, pack.p(), pack.n(), pack.s(), P(drawn.low_pass)));
        for (int lane = 0; lane < P::size; ++lane)
            reach[lane] = drawn.cutoffs.reach2(points.opacities[point(lane)]);
        const auto touches = can_touch(splat, P::load(reach), drawn.frame);
        splat.mean_x.store(out[0]);
        splat.mean_y.store(out[1]);
        splat.w.store(out[2]);
        splat.m.store(out[3]);
        splat.v.store(out[4]);
        splat.depth.store(out[5]);
        for (int lane = 0; lane < here; ++lane) {
            items[kept] = {sort_key(out[5][lane]), int32_t(first + lane)};
            splats[kept] = {out[0][lane], out[1][lane], out[2][lane], out[3][lane], out[4][lane]};
            kept += touches[lane] != 0;
        }
    }
    return kept;
}

template <class S>
int64_t project(
    const Points<S>& points, const S* pose, const S* lens, const Drawn<S>& drawn, int threads,
    const ProjectTarget<S>& out) {
    const auto view = make_view<Pack<S>>(pose, lens);
    const int64_t chunks = (points.count + kChunk - 1) / kChunk;
    if (points.count + chunks > INT32_MAX) return kTooLarge;
    // One item more than points: the place after the last is written to, and kept only where it counts.
    Scratch<SortItem<S>> items(points.count + chunks);
    Scratch<Packed<S>> splats(points.count + chunks);
    std::vector<int64_t> kept(chunks + 1, 0);
    std::vector<char> bad(chunks, 0);
    parallel_for(threads, chunks, [&](int64_t chunk) {
        const int64_t begin = chunk * kChunk, end = std::min(points.count, begin + kChunk);
        if (!valid(points, begin, end)) {
            bad[chunk] = 1;
            return;
        }
        kept[chunk + 1] = project_chunk(
            points, view, drawn, begin, end, items.data() + begin + chunk, splats.data() + begin + chunk);
    });
    for (char b : bad)
        if (b) return kInvalidValues;
    for (int64_t chunk = 0; chunk < chunks; ++chunk) kept[chunk + 1] += kept[chunk];
    const int64_t count = kept[chunks];
    // Sorted items remember where their splat lies.
    Scratch<SortItem<S>> sorted(count), other(count);
    parallel_for(threads, chunks, [&](int64_t chunk) {
        const int64_t from = chunk * (kChunk + 1);
        for (int64_t k = kept[chunk]; k < kept[chunk + 1]; ++k) {
            sorted[k] = items[from + k - kept[chunk]];
            sorted[k].place = int32_t(from + k - kept[chunk]);
        }
    });
    const SortItem<S>* order = sort_by_key(sorted.data(), other.data(), count, threads);
    parallel_for(threads, (count + kChunk - 1) / kChunk, [&](int64_t chunk) {
        const int64_t end = std::min(count, (chunk + 1) * kChunk);
        for (int64_t k = chunk * kChunk; k < end; ++k) {
            if (k + 16 < end) {
                __builtin_prefetch(&splats[order[k + 16].place]);
                __builtin_prefetch(&items[order[k + 16].place]);
            }
            const Packed<S>& splat = splats[order[k].place];
            out.means[2 * k] = splat.mean_x;
            out.means[2 * k + 1] = splat.mean_y;
            out.forms[3 * k] = splat.w;
            out.forms[3 * k + 1] = splat.m;
            out.forms[3 * k + 2] = splat.v;
            out.visible[k] = items[order[k].place].place;
        }
    });
    return count;
}

template <class S>
struct ProjectGradients {
    const S *means, *forms;                        // from the screen
    S *positions, *normals, *footprints, *pose, *lens;  // to the inputs
};

// Gradients of the points [begin, end), of which rank[i] >= 0 is the place among the visible ones: points are walked in
// their order, not near to far, so that the arrays stream through memory.
template <class S>
void project_backward_chunk(
    const Points<S>& points, const View<Pack<S>>& view, S low_pass, const int32_t* rank, int64_t begin, int64_t end,
    const ProjectGradients<S>& g, double* camera) {
    using P = Pack<S>;
    P sums[kCameraValues];
    for (auto& sum : sums) sum = P(S(0));
    alignas(64) S in[5][P::size], out[7][P::size];
    for (int64_t first = begin; first < end; first += P::size) {
        const int here = int(std::min<int64_t>(P::size, end - first));
        int64_t some = -1;  // a visible point, to stand in for lanes without one
        for (int lane = 0; lane < here; ++lane) {
            if (rank[first + lane] >= 0) some = first + lane;
            if (first + lane + 64 < end && rank[first + lane + 64] >= 0) {
                __builtin_prefetch(g.means + 2 * rank[first + lane + 64]);
                __builtin_prefetch(g.forms + 3 * rank[first + lane + 64]);
            }
        }
        if (some < 0) continue;
        const auto seen = [&](int lane) { return lane < here && rank[first + lane] >= 0; };
        const PointPack<S> pack(points.positions, points.normals, points.footprints, [&](int lane) {
            return seen(lane) ? first + lane : some;
        });
        for (int lane = 0; lane < P::size; ++lane) {
            const int64_t k = seen(lane) ? rank[first + lane] : 0;
            in[0][lane] = seen(lane) ? g.means[2 * k] : S(0);
            in[1][lane] = seen(lane) ? g.means[2 * k + 1] : S(0);
            in[2][lane] = seen(lane) ? g.forms[3 * k] : S(0);
            in[3][lane] = seen(lane) ? g.forms[3 * k + 1] : S(0);
            in[4][lane] = seen(lane) ? g.forms[3 * k + 2] : S(0);
        }
        const auto projection = project_disk(view, pack.p(), pack.n(), pack.s(), P(low_pass));
        const DiskGradient<P> d = project_disk_backward(
            view, pack.p(), pack.n(), pack.s(), P(low_pass), projection,
            {P::load(in[0]), P::load(in[1]), P::load(in[2]), P::load(in[3]), P::load(in[4])});
        P terms[kCameraValues];
        camera_terms(d, terms);
        for (int k = 0; k < kCameraValues; ++k) sums[k] = sums[k] + terms[k];
        const P values[7] = {d.position.x, d.position.y, d.position.z, d.normal.x, d.normal.y, d.normal.z, d.footprint};
        for (int k = 0; k < 7; ++k) values[k].store(out[k]);
        for (int lane = 0; lane < here; ++lane) {
            const int64_t i = first + lane;
            for (int k = 0; k < 3; ++k) {
                g.positions[3 * i + k] = out[k][lane];
                g.normals[3 * i + k] = out[3 + k][lane];
            }
            g.footprints[i] = out[6][lane];
        }
    }
    for (int k = 0; k < kCameraValues; ++k) {
        camera[k] = 0;
        for (int lane = 0; lane < P::size; ++lane) camera[k] += double(sums[k].v[lane]);
    }
}

template <class S>
int64_t project_backward(
    const Points<S>& points, const S* pose, const S* lens, S low_pass, int64_t count, const int64_t* visible,
    int threads, const ProjectGradients<S>& g) {
    const auto view = make_view<Pack<S>>(pose, lens);
    const int64_t size = 4096, chunks = (points.count + size - 1) / size;
    Scratch<int32_t> rank(points.count);
    parallel_for(threads, chunks, [&](int64_t chunk) {
        std::fill(&rank[chunk * size], &rank[std::min(points.count, (chunk + 1) * size)], -1);
    });
    parallel_for(threads, (count + size - 1) / size, [&](int64_t chunk) {
        for (int64_t k = chunk * size; k < std::min(count, (chunk + 1) * size); ++k) rank[visible[k]] = int32_t(k);
    });
    std::vector<double> camera(chunks * kCameraValues);
    parallel_for(threads, chunks, [&](int64_t chunk) {
        project_backward_chunk(
            points, view, low_pass, rank.data(), chunk * size, std::min(points.count, (chunk + 1) * size), g,
            camera.data() + chunk * kCameraValues);
    });
    for (int k = 0; k < kCameraValues; ++k) {
        double sum = 0;
        for (int64_t chunk = 0; chunk < chunks; ++chunk) sum += camera[chunk * kCameraValues + k];
        (k < 12 ? g.pose[k] : g.lens[k - 12]) = S(sum);
    }
    return 0;
}

template <class S>
int64_t finite(const S* values, int64_t count, int threads) {
    const int64_t size = 1 << 16, chunks = (count + size - 1) / size;
    std::vector<char> bad(chunks, 0);
    parallel_for(threads, chunks, [&](int64_t chunk) {
        bad[chunk] = !all_finite(values + chunk * size, std::min(size, count - chunk * size));
    });
    return std::count(bad.begin(), bad.end(), 1) ? kInvalidValues : 0;
}

}  // namespace

// means (count, 2), forms (count, 3) and visible (count) have room for all points; returns how many were written. In
// the backward pass, gradients of points that are not visible are left as they are.
#define CATACAUSTICS_PROJECT(S, SUFFIX)                                                                                \
    CATACAUSTICS_EXPORT int64_t catacaustics_project_##SUFFIX(                                                         \
        const Run* run, int64_t count, const S* positions, const S* normals, const S* footprints, const S* opacities,  \
        const S* pose, const S* lens, int64_t x0, int64_t y0, int64_t width, int64_t height, double low_pass,          \
        double support, double alpha_min, double near, double guard_left, double guard_top, double guard_right,        \
        double guard_bottom, S* means, S* forms, int64_t* visible) {                                                   \
        return guarded([&] {                                                                                           \
            const Frame<S> frame{S(x0),         S(y0),        S(x0 + width),  S(y0 + height), S(guard_left),           \
                                 S(guard_top),  S(guard_right), S(guard_bottom), S(near)};                             \
            return project<S>(                                                                                         \
                {count, positions, normals, footprints, opacities}, pose, lens,                                        \
                {frame, {S(support), S(alpha_min)}, S(low_pass)}, int(run->threads), {means, forms, visible});         \
        });                                                                                                            \
    }                                                                                                                  \
    CATACAUSTICS_EXPORT int64_t catacaustics_project_backward_##SUFFIX(                                                \
        const Run* run, int64_t count, const S* positions, const S* normals, const S* footprints, const S* pose,       \
        const S* lens, double low_pass, int64_t visible_count, const int64_t* visible, const S* g_means,               \
        const S* g_forms, S* g_positions, S* g_normals, S* g_footprints, S* g_pose, S* g_lens) {                       \
        return guarded([&] {                                                                                           \
            return project_backward<S>(                                                                                \
                {count, positions, normals, footprints, nullptr}, pose, lens, S(low_pass), visible_count, visible,     \
                int(run->threads), {g_means, g_forms, g_positions, g_normals, g_footprints, g_pose, g_lens});          \
        });                                                                                                            \
    }                                                                                                                  \
    CATACAUSTICS_EXPORT int64_t catacaustics_finite_##SUFFIX(const Run* run, const S* values, int64_t count) {         \
        return guarded([&] { return finite(values, count, int(run->threads)); });                                      \
    }

CATACAUSTICS_PROJECT(float, f32)
CATACAUSTICS_PROJECT(double, f64)

}  // namespace catacaustics
