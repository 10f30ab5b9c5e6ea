// Projection of an oriented disk (see catacaustics/splatting/reference.py for the equations) and its derivative.
#pragma once

#include "vector.h"

namespace catacaustics {

// Squared radii up to here have gradients that 32 bits can hold, seen at some thousand pixels a unit. The same as
// LARGEST_FOOTPRINT of catacaustics/splatting/reference.py.
constexpr double kLargestFootprint = 1e15;

// camera_from_world as three rows and a translation, and the lens in pixels.
template <class T>
struct View {
    Vec3<T> row[3];
    Vec3<T> translation;
    T fx, fy, cx, cy;
};

template <class T>
CATACAUSTICS_HD Vec3<T> rotate(const View<T>& view, Vec3<T> a) {
    return {dot(view.row[0], a), dot(view.row[1], a), dot(view.row[2], a)};
}

template <class T>
CATACAUSTICS_HD Vec3<T> rotate_back(const View<T>& view, Vec3<T> a) {
    return {
        view.row[0].x * a.x + view.row[1].x * a.y + view.row[2].x * a.z,
        view.row[0].y * a.x + view.row[1].y * a.y + view.row[2].y * a.z,
        view.row[0].z * a.x + view.row[1].z * a.y + view.row[2].z * a.z,
    };
}

// Mean in pixels; quadratic form w (dx - m dy)^2 + v dy^2; variances along x and y; depth.
template <class T>
struct ScreenSplat {
    T mean_x, mean_y;
    T w, m, v;
    T variance_x, variance_y;
    T depth;
};

// The pose has at least three rows of four; lens = fx, fy, cx, cy.
template <class T, class S>
CATACAUSTICS_HD View<T> make_view(const S* pose, const S* lens) {
    View<T> view;
    for (int i = 0; i < 3; ++i) view.row[i] = {T(pose[4 * i]), T(pose[4 * i + 1]), T(pose[4 * i + 2])};
    view.translation = {T(pose[3]), T(pose[7]), T(pose[11])};
    view.fx = T(lens[0]);
    view.fy = T(lens[1]);
    view.cx = T(lens[2]);
    view.cy = T(lens[3]);
    return view;
}

// What the forward and the backward pass both need.
template <class T>
struct Projection {
    Vec3<T> camera, normal;         // in the camera's frame
    T inv_z, u, v, kx, ky;          // u = x/z, v = y/z, kx = fx/z, ky = fy/z
    T sign, a, b;                   // of the tangent basis (Duff et al. 2017)
    T d11, d12, d21, d22;           // J = [[kx d11, kx d12], [ky d21, ky d22]]
    T j11, j12, j21, j22;
    T jj11, jj22, jj12;             // J J^T
    T facing, det_j;                // facing = n . (u, v, 1)
    T sdet;                         // s det J
    T s11, s22, inv_s22, w, m;      // of Sigma
};

template <class T>
CATACAUSTICS_HD Projection<T> project_disk(const View<T>& view, Vec3<T> position, Vec3<T> normal, T s, T low_pass) {
    Projection<T> r;
    r.camera = rotate(view, position) + view.translation;
    r.normal = rotate(view, normal);
    const Vec3<T> n = r.normal;
    r.inv_z = T(1) / r.camera.z;
    r.u = r.camera.x * r.inv_z;
    r.v = r.camera.y * r.inv_z;
    r.kx = view.fx * r.inv_z;
    r.ky = view.fy * r.inv_z;
    const Tangents<T> tangents(n);
    r.sign = tangents.sign;
    r.a = tangents.a;
    r.b = tangents.b;
    const Vec3<T> t1 = tangents.first, t2 = tangents.second;
    r.d11 = t1.x - r.u * t1.z;
    r.d21 = t1.y - r.v * t1.z;
    r.d12 = t2.x - r.u * t2.z;
    r.d22 = t2.y - r.v * t2.z;
    r.j11 = r.kx * r.d11;
    r.j12 = r.kx * r.d12;
    r.j21 = r.ky * r.d21;
    r.j22 = r.ky * r.d22;
    r.jj11 = r.j11 * r.j11 + r.j12 * r.j12;
    r.jj22 = r.j21 * r.j21 + r.j22 * r.j22;
    r.jj12 = r.j11 * r.j21 + r.j12 * r.j22;
    r.facing = n.x * r.u + n.y * r.v + n.z;
    r.det_j = r.kx * r.ky * r.facing;
    const T s11 = s * r.jj11, s22 = s * r.jj22;
    r.sdet = s * r.det_j;
    r.s11 = s11 + low_pass;
    r.s22 = s22 + low_pass;
    r.inv_s22 = T(1) / r.s22;
    // det Sigma / Sigma_22: the determinant itself would overflow for disks that are larger than the scene.
    r.w = T(1) / (r.sdet * (r.sdet * r.inv_s22) + low_pass * ((s11 + r.s22) * r.inv_s22));
    r.m = s * r.jj12 * r.inv_s22;
    return r;
}

template <class T>
CATACAUSTICS_HD ScreenSplat<T> screen_splat(const View<T>& view, const Projection<T>& r) {
    return {view.fx * r.u + view.cx, view.fy * r.v + view.cy, r.w, r.m, r.inv_s22, r.s11, r.s22, r.camera.z};
}

// What is drawn of a view: the window's sides in pixels, the guard band in which means must lie, the near plane.
template <class S>
struct Frame {
    S left, top, right, bottom;
    S guard_left, guard_top, guard_right, guard_bottom;
    S near;
};

// Whether a splat of squared reach `reach2` can touch the window. False for values that are not numbers.
template <class T, class S>
CATACAUSTICS_HD auto can_touch(const ScreenSplat<T>& splat, T reach2, const Frame<S>& frame) {
    const T reach_x = square_root(splat.variance_x * reach2), reach_y = square_root(splat.variance_y * reach2);
    const auto guarded = (splat.depth > T(frame.near)) & (splat.mean_x > T(frame.guard_left)) &
                         (splat.mean_y > T(frame.guard_top)) & (splat.mean_x < T(frame.guard_right)) &
                         (splat.mean_y < T(frame.guard_bottom));
    return guarded & (splat.mean_x + reach_x > T(frame.left)) & (splat.mean_x - reach_x < T(frame.right)) &
           (splat.mean_y + reach_y > T(frame.top)) & (splat.mean_y - reach_y < T(frame.bottom)) & (reach2 > T(0)) &
           (splat.w >= T(0)) & (splat.v > T(0));
}

// Whether a disk of squared radius s may touch the window, whatever its normal: its variance along screen x is at most
// s (fx/z)^2 (1 + (x/z)^2) + low_pass. False for values that are not numbers.
template <class T, class S>
CATACAUSTICS_HD auto may_touch(
    const View<T>& view, Vec3<T> position, T s, T support, T low_pass, const Frame<S>& frame) {
    const Vec3<T> camera = rotate(view, position) + view.translation;
    const T inv_z = T(1) / camera.z, u = camera.x * inv_z, v = camera.y * inv_z;
    const T kx = view.fx * inv_z, ky = view.fy * inv_z;
    const T mean_x = view.fx * u + view.cx, mean_y = view.fy * v + view.cy;
    const T reach_x = support * square_root(s * kx * kx * (T(1) + u * u) + low_pass);
    const T reach_y = support * square_root(s * ky * ky * (T(1) + v * v) + low_pass);
    return (camera.z > T(frame.near)) & (mean_x > T(frame.guard_left)) & (mean_y > T(frame.guard_top)) &
           (mean_x < T(frame.guard_right)) & (mean_y < T(frame.guard_bottom)) & (mean_x + reach_x > T(frame.left)) &
           (mean_x - reach_x < T(frame.right)) & (mean_y + reach_y > T(frame.top)) &
           (mean_y - reach_y < T(frame.bottom));
}

template <class T>
struct ScreenGradient {
    T mean_x, mean_y, w, m, v;
};

// Gradients in world space, and what the disk adds to those of the pose and the lens.
template <class T>
struct DiskGradient {
    Vec3<T> position, normal;
    T footprint;
    Vec3<T> row[3];
    Vec3<T> translation;
    T fx, fy, cx, cy;
};

// What a disk adds to the gradients of the pose (three rows of four) and of the lens.
constexpr int kCameraValues = 16;
template <class T>
CATACAUSTICS_HD void camera_terms(const DiskGradient<T>& g, T (&terms)[kCameraValues]) {
    const T translation[3] = {g.translation.x, g.translation.y, g.translation.z};
    for (int i = 0; i < 3; ++i) {
        terms[4 * i] = g.row[i].x;
        terms[4 * i + 1] = g.row[i].y;
        terms[4 * i + 2] = g.row[i].z;
        terms[4 * i + 3] = translation[i];
    }
    terms[12] = g.fx;
    terms[13] = g.fy;
    terms[14] = g.cx;
    terms[15] = g.cy;
}

template <class T>
CATACAUSTICS_HD DiskGradient<T> project_disk_backward(
    const View<T>& view, Vec3<T> position, Vec3<T> normal, T s, T low_pass, const Projection<T>& r,
    const ScreenGradient<T>& g) {
    const Vec3<T> n = r.normal;
    // Sigma. Factors are ordered so that large ones meet small ones: else, for disks that are larger than the scene,
    // products would be less than 32 bits hold. g_s22 is that of log Sigma_22, without its part in nu.
    const T g_w = g.w * r.w, g_s22 = g_w - (g.m * r.m + g.v * r.inv_s22);
    const T low = low_pass * r.inv_s22, s_inv = s * r.inv_s22, s_w = s * r.w, slope = r.sdet * r.inv_s22;
    DiskGradient<T> out;
    out.footprint = (r.jj22 * r.inv_s22) * g_s22 + (r.jj12 * r.inv_s22) * g.m - (r.jj11 + r.jj22) * (g_w * (r.w * low)) -
                    T(2) * (g_w * (r.w * r.det_j)) * slope;
    // J J^T and det J.
    const T g_jj11 = T(-2) * (g_w * (s_w * low)), g_jj22 = T(2) * s_inv * g_s22 + g_jj11, g_jj12 = s_inv * g.m;
    const T g_det_j = T(-2) * (g_w * s_w) * slope;
    const T g_j11 = r.j11 * g_jj11 + r.j21 * g_jj12;
    const T g_j12 = r.j12 * g_jj11 + r.j22 * g_jj12;
    const T g_j21 = r.j21 * g_jj22 + r.j11 * g_jj12;
    const T g_j22 = r.j22 * g_jj22 + r.j12 * g_jj12;
    const T g_facing = r.kx * r.ky * g_det_j;
    const T g_kx = r.ky * r.facing * g_det_j + r.d11 * g_j11 + r.d12 * g_j12;
    const T g_ky = r.kx * r.facing * g_det_j + r.d21 * g_j21 + r.d22 * g_j22;
    const T g_d11 = r.kx * g_j11, g_d12 = r.kx * g_j12, g_d21 = r.ky * g_j21, g_d22 = r.ky * g_j22;
    // Tangents.
    const T t1z = -(r.sign * n.x), t2z = -n.y;
    const T g_t1z = -(r.u * g_d11 + r.v * g_d21), g_t2z = -(r.u * g_d12 + r.v * g_d22);
    const T g_u = n.x * g_facing - t1z * g_d11 - t2z * g_d12 + view.fx * g.mean_x;
    const T g_v = n.y * g_facing - t1z * g_d21 - t2z * g_d22 + view.fy * g.mean_y;
    const T g_b = r.sign * g_d21 + g_d12;
    const T g_a = r.sign * n.x * n.x * g_d11 + n.y * n.y * g_d22 + n.x * n.y * g_b;
    const Vec3<T> g_n{
        r.u * g_facing + T(2) * r.sign * n.x * r.a * g_d11 - r.sign * g_t1z + n.y * r.a * g_b,
        r.v * g_facing + T(2) * n.y * r.a * g_d22 - g_t2z + n.x * r.a * g_b,
        g_facing + r.a * r.a * g_a,
    };
    // Perspective division.
    const T g_inv_z = view.fx * g_kx + view.fy * g_ky + r.camera.x * g_u + r.camera.y * g_v;
    const Vec3<T> g_camera{r.inv_z * g_u, r.inv_z * g_v, -(r.inv_z * r.inv_z * g_inv_z)};
    out.position = rotate_back(view, g_camera);
    out.normal = rotate_back(view, g_n);
    const T camera[3] = {g_camera.x, g_camera.y, g_camera.z}, turned[3] = {g_n.x, g_n.y, g_n.z};
    for (int i = 0; i < 3; ++i)
        out.row[i] = {
            camera[i] * position.x + turned[i] * normal.x,
            camera[i] * position.y + turned[i] * normal.y,
            camera[i] * position.z + turned[i] * normal.z,
        };
    out.translation = g_camera;
    out.fx = r.inv_z * g_kx + r.u * g.mean_x;
    out.fy = r.inv_z * g_ky + r.v * g.mean_y;
    out.cx = g.mean_x;
    out.cy = g.mean_y;
    return out;
}

}  // namespace catacaustics
