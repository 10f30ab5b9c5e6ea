#include <cstdint>

#include "../math/binning.h"
#include "../math/projection.h"
#include "launch.h"
#include "sort.h"

namespace catacaustics {
namespace {

template <class S>
struct Points {
    int64_t count;
    const S *positions, *normals, *footprints, *opacities;
    const S *pose, *lens;
};

template <class S>
struct Drawn {
    Frame<S> frame;
    Cutoffs<S> cutoffs;
    S low_pass;
};

struct Tally {
    int visible, invalid;
};

template <class S>
__device__ Vec3<S> row(const S* values, int64_t i) {
    return {values[3 * i], values[3 * i + 1], values[3 * i + 2]};
}

template <class S>
__device__ bool all_finite(Vec3<S> a) {
    return is_finite(a.x) && is_finite(a.y) && is_finite(a.z);
}

template <class S>
__device__ Projection<S> project_point(const Points<S>& points, const View<S>& view, int64_t i, S low_pass) {
    return project_disk(view, row(points.positions, i), row(points.normals, i), points.footprints[i], low_pass);
}

// Keys for sorting by depth; points that are not drawn go last.
template <class S>
__global__ void find_visible(Points<S> points, Drawn<S> drawn, SortKey<S>* keys, int32_t* numbers, Tally* tally) {
    const int64_t i = global_thread();
    bool visible = false, invalid = false;
    if (i < points.count) {
        const S s = points.footprints[i], opacity = points.opacities[i];
        invalid = !(all_finite(row(points.positions, i)) && all_finite(row(points.normals, i)) && is_finite(s) &&
                    s >= S(0) && s <= S(kLargestFootprint) && opacity >= S(0) && opacity <= S(1));
        const View<S> view = make_view<S>(points.pose, points.lens);
        const ScreenSplat<S> splat = screen_splat(view, project_point(points, view, i, drawn.low_pass));
        visible = !invalid && can_touch(splat, drawn.cutoffs.reach2(opacity), drawn.frame);
        keys[i] = visible ? sort_key(splat.depth) : ~SortKey<S>(0);
        numbers[i] = int32_t(i);
    }
    const unsigned lanes = __ballot_sync(kAllLanes, visible);
    if (threadIdx.x % 32 == 0 && lanes) atomicAdd(&tally->visible, __popc(lanes));
    if (invalid) tally->invalid = 1;
}

template <class S>
__global__ void write_visible(
    Points<S> points, S low_pass, int64_t count, const int32_t* numbers, S* means, S* forms, int64_t* visible) {
    const int64_t k = global_thread();
    if (k >= count) return;
    const View<S> view = make_view<S>(points.pose, points.lens);
    const ScreenSplat<S> splat = screen_splat(view, project_point(points, view, numbers[k], low_pass));
    means[2 * k] = splat.mean_x;
    means[2 * k + 1] = splat.mean_y;
    forms[3 * k] = splat.w;
    forms[3 * k + 1] = splat.m;
    forms[3 * k + 2] = splat.v;
    visible[k] = numbers[k];
}

template <class S>
int64_t project(
    const Run& run, const Points<S>& points, const Drawn<S>& drawn, S* means, S* forms, int64_t* visible) {
    const int64_t n = points.count;
    if (n > INT32_MAX) return kTooLarge;
    if (n == 0) return 0;
    SortKey<S>* keys = allocate<SortKey<S>>(run, 2 * n);
    int32_t* numbers = allocate<int32_t>(run, 2 * n);
    Tally* tally = allocate<Tally>(run, 1);
    clear(run, tally, sizeof(Tally));
    launch(run, find_visible<S>, blocks_for(n), points, drawn, keys, numbers, tally);
    sort_pairs(run, keys, keys + n, numbers, numbers + n, n, int(sizeof(S)) * 8);
    const Tally seen = read_back(run, tally);
    if (seen.invalid) return kInvalidValues;
    launch(
        run, write_visible<S>, blocks_for(seen.visible), points, drawn.low_pass, seen.visible, numbers + n, means,
        forms, visible);
    return seen.visible;
}

template <class S>
struct ProjectGradients {
    const S *means, *forms;                             // from the screen
    S *positions, *normals, *footprints, *pose, *lens;  // to the inputs
};

constexpr int kCameraBlocks = 256;

// Each block leaves what its points add to the gradients of the camera in a row of `camera`.
template <class S>
__global__ void project_gradients(
    Points<S> points, S low_pass, int64_t count, const int64_t* visible, ProjectGradients<S> g, S* camera) {
    __shared__ S partial[kBlock / 32][kCameraValues];
    const View<S> view = make_view<S>(points.pose, points.lens);
    S sums[kCameraValues] = {};
    for (int64_t k = global_thread(); k < count; k += int64_t(gridDim.x) * kBlock) {
        const int64_t i = visible[k];
        const DiskGradient<S> d = project_disk_backward(
            view, row(points.positions, i), row(points.normals, i), points.footprints[i], low_pass,
            project_point(points, view, i, low_pass),
            {g.means[2 * k], g.means[2 * k + 1], g.forms[3 * k], g.forms[3 * k + 1], g.forms[3 * k + 2]});
        g.positions[3 * i] = d.position.x;
        g.positions[3 * i + 1] = d.position.y;
        g.positions[3 * i + 2] = d.position.z;
        g.normals[3 * i] = d.normal.x;
        g.normals[3 * i + 1] = d.normal.y;
        g.normals[3 * i + 2] = d.normal.z;
        g.footprints[i] = d.footprint;
        S terms[kCameraValues];
        camera_terms(d, terms);
        for (int j = 0; j < kCameraValues; ++j) sums[j] += terms[j];
    }
    const int warp = int(threadIdx.x) / 32, lane = int(threadIdx.x) % 32;
    const S sum = warp_sums(sums);
    if (lane < kCameraValues) partial[warp][lane] = sum;
    __syncthreads();
    if (threadIdx.x < kCameraValues) {
        S total = 0;
        for (int w = 0; w < kBlock / 32; ++w) total += partial[w][threadIdx.x];
        camera[int64_t(blockIdx.x) * kCameraValues + threadIdx.x] = total;
    }
}

// One block: a row of kCameraValues threads takes every 16th row, then these are summed.
template <class S>
__global__ void sum_camera(int64_t rows, const S* camera, S* pose, S* lens) {
    constexpr int kRows = kBlock / kCameraValues;
    __shared__ double partial[kRows][kCameraValues];
    const int value = int(threadIdx.x) % kCameraValues, first = int(threadIdx.x) / kCameraValues;
    double sum = 0;
    for (int64_t i = first; i < rows; i += kRows) sum += double(camera[i * kCameraValues + value]);
    partial[first][value] = sum;
    __syncthreads();
    if (first > 0) return;
    for (int i = 1; i < kRows; ++i) sum += partial[i][value];
    (value < 12 ? pose[value] : lens[value - 12]) = S(sum);
}

template <class S>
int64_t project_backward(
    const Run& run, const Points<S>& points, S low_pass, int64_t count, const int64_t* visible,
    const ProjectGradients<S>& g) {
    const int64_t most = blocks_for(count), blocks = most < kCameraBlocks ? most : kCameraBlocks;
    S* camera = allocate<S>(run, blocks * kCameraValues);
    launch(run, project_gradients<S>, blocks, points, low_pass, count, visible, g, camera);
    launch(run, sum_camera<S>, 1, blocks, camera, g.pose, g.lens);
    return 0;
}

template <class S>
__global__ void find_invalid(const S* values, int64_t count, int* invalid) {
    bool bad = false;
    for (int64_t i = global_thread(); i < count; i += int64_t(gridDim.x) * kBlock) bad |= !is_finite(values[i]);
    if (bad) *invalid = 1;
}

template <class S>
int64_t finite(const Run& run, const S* values, int64_t count) {
    int* invalid = allocate<int>(run, 1);
    clear(run, invalid, sizeof(int));
    const int64_t most = blocks_for(count);
    launch(run, find_invalid<S>, most < 2048 ? most : 2048, values, count, invalid);
    return read_back(run, invalid) ? kInvalidValues : 0;
}

}  // namespace

#define CATACAUSTICS_PROJECT(S, SUFFIX)                                                                                \
    CATACAUSTICS_EXPORT int64_t catacaustics_project_##SUFFIX(                                                         \
        const Run* run, int64_t count, const S* positions, const S* normals, const S* footprints, const S* opacities,  \
        const S* pose, const S* lens, int64_t x0, int64_t y0, int64_t width, int64_t height, double low_pass,          \
        double support, double alpha_min, double near, double guard_left, double guard_top, double guard_right,        \
        double guard_bottom, S* means, S* forms, int64_t* visible) {                                                   \
        return guarded(*run, [&] {                                                                                     \
            const Frame<S> frame{S(x0),         S(y0),        S(x0 + width),  S(y0 + height), S(guard_left),           \
                                 S(guard_top),  S(guard_right), S(guard_bottom), S(near)};                             \
            return project<S>(                                                                                         \
                *run, {count, positions, normals, footprints, opacities, pose, lens},                                  \
                {frame, {S(support), S(alpha_min)}, S(low_pass)}, means, forms, visible);                              \
        });                                                                                                            \
    }                                                                                                                  \
    CATACAUSTICS_EXPORT int64_t catacaustics_project_backward_##SUFFIX(                                                \
        const Run* run, int64_t count, const S* positions, const S* normals, const S* footprints, const S* pose,       \
        const S* lens, double low_pass, int64_t visible_count, const int64_t* visible, const S* g_means,               \
        const S* g_forms, S* g_positions, S* g_normals, S* g_footprints, S* g_pose, S* g_lens) {                       \
        return guarded(*run, [&] {                                                                                     \
            return project_backward<S>(                                                                                \
                *run, {count, positions, normals, footprints, nullptr, pose, lens}, S(low_pass), visible_count,        \
                visible, {g_means, g_forms, g_positions, g_normals, g_footprints, g_pose, g_lens});                    \
        });                                                                                                            \
    }                                                                                                                  \
    CATACAUSTICS_EXPORT int64_t catacaustics_finite_##SUFFIX(const Run* run, const S* values, int64_t count) {         \
        return guarded(*run, [&] { return finite(*run, values, count); });                                             \
    }

CATACAUSTICS_PROJECT(float, f32)
CATACAUSTICS_PROJECT(double, f64)

}  // namespace catacaustics
