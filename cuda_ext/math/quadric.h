// Where a sphere or an ellipsoid shows a source: Fermat's principle (catacaustics/reflectors/quadric.py has the
// equations). The mirror is x = s + A u, |u| = 1; L(u) = |c - x| + |x - P| is stationary at the point of reflection.
#pragma once

#include "vector.h"

namespace catacaustics {

// Cosine of incidence below which a point counts as invisible; what is left of a stationary path's derivative; the
// largest magnification: as in catacaustics/reflectors/fermat.py.
constexpr double kGrazing = 1e-3, kStationary = 1e-2, kStretch = 30.0;
// Newton steps are cut to this many radians.
constexpr double kMaxStep = 0.4;

template <class S>
constexpr S kTinyLength = sizeof(S) == 4 ? S(1.0842022e-19) : S(1.4916681462400413e-154);  // square root of the least

// A quadric with a camera before it.
template <class T>
struct Mirror {
    Vec3<T> camera, center;
    Vec3<T> axes[3];      // columns of A
    Vec3<T> inverse[3];   // rows of the inverse of A
    T radius, side;       // mean of the half-axes; 1, or -1 where the inner side mirrors

    // A u
    CATACAUSTICS_HD Vec3<T> stretch(Vec3<T> u) const { return u.x * axes[0] + u.y * axes[1] + u.z * axes[2]; }
    // A' n
    CATACAUSTICS_HD Vec3<T> project(Vec3<T> n) const { return {dot(axes[0], n), dot(axes[1], n), dot(axes[2], n)}; }
    // A^-1' u
    CATACAUSTICS_HD Vec3<T> normal(Vec3<T> u) const { return u.x * inverse[0] + u.y * inverse[1] + u.z * inverse[2]; }
};

// `axes` is A row by row.
template <class T, class S>
CATACAUSTICS_HD Mirror<T> make_mirror(const S* camera, const S* center, const S* axes, bool concave) {
    Mirror<T> mirror;
    const auto at = [](const S* v) { return Vec3<T>{T(v[0]), T(v[1]), T(v[2])}; };
    mirror.camera = at(camera);
    mirror.center = at(center);
    S sum = 0;
    for (int k = 0; k < 3; ++k) {
        mirror.axes[k] = {T(axes[k]), T(axes[3 + k]), T(axes[6 + k])};
        sum += square_root(axes[k] * axes[k] + axes[3 + k] * axes[3 + k] + axes[6 + k] * axes[6 + k]);
    }
    const auto cofactor = [&](int i, int j) {
        const int a = (i + 1) % 3, b = (i + 2) % 3, c = (j + 1) % 3, d = (j + 2) % 3;
        return axes[3 * a + c] * axes[3 * b + d] - axes[3 * a + d] * axes[3 * b + c];
    };
    const S det = axes[0] * cofactor(0, 0) + axes[1] * cofactor(0, 1) + axes[2] * cofactor(0, 2);
    for (int k = 0; k < 3; ++k)  // row k of the inverse: cofactors of column k
        mirror.inverse[k] = {T(cofactor(0, k) / det), T(cofactor(1, k) / det), T(cofactor(2, k) / det)};
    mirror.radius = T(sum / 3);
    mirror.side = T(concave ? -1 : 1);
    return mirror;
}

template <class T>
CATACAUSTICS_HD T length(Vec3<T> a) {
    return square_root(dot(a, a));
}

template <class T>
CATACAUSTICS_HD Vec3<T> normalized(Vec3<T> a) {
    const T norm = length(a);
    return (T(1) / select(norm > T(1e-12), norm, T(1e-12))) * a;
}

template <class T>
CATACAUSTICS_HD T absolute(T x) {
    return select(x < T(0), -x, x);
}

// The path over the point of u: unit vectors to camera and source, and the distances. With E = A B, B the tangents of
// the unit sphere at u: gradient B' dL/du and Hessian of L.
template <class T>
struct MirrorPath {
    Tangents<T> basis;
    Vec3<T> edge1, edge2;
    Vec3<T> to_camera, to_source;
    T camera_distance, source_distance;
    T g1, g2;
    T h11, h12, h22;

    template <class S>
    CATACAUSTICS_HD MirrorPath(const Mirror<T>& mirror, Vec3<T> source, Vec3<T> u, S tiny) : basis(u) {
        edge1 = mirror.stretch(basis.first);
        edge2 = mirror.stretch(basis.second);
        const Vec3<T> radial = mirror.stretch(u), point = mirror.center + radial;
        const Vec3<T> a = mirror.camera - point, b = source - point;
        camera_distance = square_root(dot(a, a) + T(tiny));
        source_distance = square_root(dot(b, b) + T(tiny));
        const T inv_a = T(1) / camera_distance, inv_b = T(1) / source_distance;
        to_camera = inv_a * a;
        to_source = inv_b * b;
        const Vec3<T> both = to_camera + to_source;
        g1 = -dot(edge1, both);
        g2 = -dot(edge2, both);
        const T a1 = dot(edge1, to_camera), a2 = dot(edge2, to_camera);
        const T b1 = dot(edge1, to_source), b2 = dot(edge2, to_source);
        const T curvature = dot(radial, both), inv_sum = inv_a + inv_b;
        h11 = inv_sum * dot(edge1, edge1) - inv_a * a1 * a1 - inv_b * b1 * b1 + curvature;
        h22 = inv_sum * dot(edge2, edge2) - inv_a * a2 * a2 - inv_b * b2 * b2 + curvature;
        h12 = inv_sum * dot(edge1, edge2) - inv_a * a1 * a2 - inv_b * b1 * b2;
    }

    // The Hessian's determinant, kept away from zero.
    template <class S>
    CATACAUSTICS_HD T determinant(S tiny) const {
        const T value = h11 * h22 - h12 * h12;
        const T floor = T(1e-6) * (h11 * h11 + T(2) * h12 * h12 + h22 * h22) + T(tiny);
        return select(absolute(value) < floor, select(value < T(0), -floor, floor), value);
    }
    // Raises the diagonal until both eigenvalues are positive: Newton's method then goes downhill.
    CATACAUSTICS_HD void make_convex() {
        const T middle = T(0.5) * (h11 + h22), half = T(0.5) * (h11 - h22);
        const T spread = square_root(half * half + h12 * h12);
        const T lift = T(1e-3) * (absolute(middle) + spread) - (middle - spread);
        const T raised = select(lift > T(0), lift, T(0));
        h11 = h11 + raised;
        h22 = h22 + raised;
    }
    // H^-1 of a vector along the tangents.
    template <class S>
    CATACAUSTICS_HD void solve(T x, T y, S tiny, T& out_x, T& out_y) const {
        const T inv = T(1) / determinant(tiny);
        out_x = (h22 * x - h12 * y) * inv;
        out_y = (h11 * y - h12 * x) * inv;
    }
    // A Newton step along the tangents, cut to kMaxStep, and its length before.
    struct Step {
        T x, y, size, cut;
    };
    template <class S>
    CATACAUSTICS_HD Step step(S tiny) const {
        T x, y;
        solve(g1, g2, tiny, x, y);
        const T size = square_root(x * x + y * y);
        const T cut = T(1) / select(size > T(kMaxStep), size * T(1 / kMaxStep), T(1));
        return {x, y, size, cut};
    }
    CATACAUSTICS_HD Vec3<T> moved(Vec3<T> u, const Step& s) const {
        return u - basis.combine(s.cut * s.x, s.cut * s.y);
    }
};

// u to start from on a convex mirror. On a sphere the normal lies between the directions of camera and source: in the
// middle where both are far away, and at the share of the nearer one's height where both are close, as on a plane.
template <class T>
CATACAUSTICS_HD Vec3<T> first_guess(const Mirror<T>& mirror, Vec3<T> source) {
    const Vec3<T> v = mirror.camera - mirror.center, w = source - mirror.center;
    const T dv = length(v), dw = length(w), r = mirror.radius;
    const T tiny = T(1e-6) * r;
    const auto share = [&](T distance) {
        const T height = distance - r, above = select(height > tiny, height, tiny);
        return above / (r + above);
    };
    const auto at_least = [&](T distance) { return select(distance > tiny, distance, tiny); };
    const Vec3<T> between = (share(dw) / at_least(dv)) * v + (share(dv) / at_least(dw)) * w;
    // Opposite directions leave nothing between them: a way across them is as good as any.
    const Vec3<T> across = Tangents<T>((T(1) / at_least(dv)) * v).first;
    return normalized(mirror.project(between + T(1e-6) * across));
}

// As reflectors/warps.py displays a source: on the ray of its image, at the length of the path.
template <class T>
struct Displayed {
    Vec3<T> point, direction, position;
    T near, rest;  // distances from the camera to the point of reflection, and from there to the source
};

template <class T>
CATACAUSTICS_HD Displayed<T> display(const Mirror<T>& mirror, Vec3<T> source, Vec3<T> u) {
    Displayed<T> r;
    r.point = mirror.center + mirror.stretch(u);
    const Vec3<T> ray = r.point - mirror.camera;
    const T norm = length(ray);
    r.near = select(norm > T(1e-12), norm, T(1e-12));
    r.rest = length(source - r.point);
    r.direction = (T(1) / r.near) * ray;
    r.position = mirror.camera + (r.near + r.rest) * r.direction;
    return r;
}

// Whether camera and source face the mirror there and the path is stationary.
template <class T>
CATACAUSTICS_HD auto reflects(const Mirror<T>& mirror, const MirrorPath<T>& path, Vec3<T> u) {
    const Vec3<T> normal = mirror.side * normalized(mirror.normal(u));
    const Vec3<T> both = path.to_camera + path.to_source;
    const Vec3<T> along = both - dot(both, normal) * normal;
    return (dot(normal, path.to_camera) > T(kGrazing)) & (dot(normal, path.to_source) > T(kGrazing)) &
           (dot(along, along) < T(kStationary * kStationary));
}

// Normal and factor of the squared radius of the disk that looks like the image of a round source: the Jacobian
// D / (d1 d2) (I - a a') E H^-1 E' (I - b b') of the displayed point, see fermat.display_jacobian and tilted_disks.
template <class T, class S>
CATACAUSTICS_HD void image_disk(
    const MirrorPath<T>& path, Vec3<T> to_camera, S tiny, S least, Vec3<T>& normal, T& stretch) {
    const auto across = [](Vec3<T> edge, Vec3<T> direction, T inv) {
        return inv * (edge - dot(edge, direction) * direction);
    };
    const T inv_a = T(1) / path.camera_distance, inv_b = T(1) / path.source_distance;
    const Vec3<T> a1 = across(path.edge1, path.to_camera, inv_a), a2 = across(path.edge2, path.to_camera, inv_a);
    const Vec3<T> b1 = across(path.edge1, path.to_source, inv_b), b2 = across(path.edge2, path.to_source, inv_b);
    const Tangents<T> basis(to_camera);
    const T scale = (path.camera_distance + path.source_distance) / path.determinant(tiny);
    const auto row = [&](Vec3<T> tangent) {  // of the Jacobian as seen along the ray
        const T x = dot(tangent, a1), y = dot(tangent, a2);
        return scale * ((x * path.h22 - y * path.h12) * b1 + (y * path.h11 - x * path.h12) * b2);
    };
    const Vec3<T> first = row(basis.first), second = row(basis.second);
    const T a = dot(first, first), b = dot(first, second), d = dot(second, second);
    const T middle = T(0.5) * (a + d), half = T(0.5) * (a - d), spread = square_root(half * half + b * b);
    const T major = middle + spread, rest = middle - spread;
    const T ratio = select(rest > T(0), rest, T(0)) / select(major > T(least), major, T(least));
    const T aspect = select(ratio < T(1), ratio, T(1));
    // The major axis is at half the angle of (half, b): cosine and sine of half an angle, the larger one by a root and
    // the other by what both multiply to.
    const T round = select(spread > T(least), spread, T(least)), cosine = half / round, sine = b / round;
    const T larger = square_root(T(0.5) * (T(1) + absolute(cosine))), other = T(0.5) * sine / larger;
    const auto ahead = cosine < T(0);
    const T cos_half = select(ahead, absolute(other), larger);
    const T sin_half = select(ahead, select(sine < T(0), -larger, larger), other);
    normal = square_root(aspect) * to_camera + square_root(T(1) - aspect) * basis.combine(-sin_half, cos_half);
    const T low = T(1e-8), high = T(kStretch * kStretch);
    stretch = select(major > low, select(major < high, major, high), low);
}

// What a source adds to the gradients of the camera, the mirror's centre and its axes, row by row.
constexpr int kMirrorValues = 15;

template <class T>
CATACAUSTICS_HD void add_outer(Vec3<T> rows, Vec3<T> columns, T* axes) {
    const T r[3] = {rows.x, rows.y, rows.z}, c[3] = {columns.x, columns.y, columns.z};
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) axes[3 * i + j] = axes[3 * i + j] + r[i] * c[j];
}

// Gradient to the source of g . displayed position; `terms` gets the others. By the implicit function theorem: the last
// Newton step is differentiated with its Hessian held fixed.
template <class T, class S>
CATACAUSTICS_HD Vec3<T> display_backward(
    const Mirror<T>& mirror, Vec3<T> source, Vec3<T> u, Vec3<T> g, S tiny, T (&terms)[kMirrorValues]) {
    const MirrorPath<T> path(mirror, source, u, tiny);
    const auto step = path.step(tiny);
    const Vec3<T> moved = path.moved(u, step);
    const T inv_norm = T(1) / length(moved);
    const Vec3<T> unit = inv_norm * moved;
    const Displayed<T> r = display(mirror, source, unit);
    // position = c + (near + rest) direction.
    const T along = dot(g, r.direction);
    const Vec3<T> g_ray = along * r.direction + ((r.near + r.rest) / r.near) * (g - along * r.direction);
    const Vec3<T> to_source = (along / select(r.rest > T(1e-12), r.rest, T(1e-12))) * (source - r.point);
    const Vec3<T> g_point = g_ray - to_source;
    // point = s + A unit, unit = normalised u - B cut H^-1 B' dL/du; dL/du = -A' (a + b). H is symmetric.
    const Vec3<T> g_unit = mirror.project(g_point);
    const Vec3<T> g_moved = inv_norm * (g_unit - dot(g_unit, unit) * unit);
    T x = -dot(path.basis.first, g_moved), y = -dot(path.basis.second, g_moved);
    // A step that is cut keeps its length.
    const T squared = step.x * step.x + step.y * step.y;
    const T lost = select(step.size > T(kMaxStep), (x * step.x + y * step.y) / squared, T(0));
    x = step.cut * (x - lost * step.x);
    y = step.cut * (y - lost * step.y);
    path.solve(x, y, tiny, x, y);
    const Vec3<T> w = path.basis.combine(x, y), v = T(-1) * mirror.stretch(w);
    const auto across = [&](Vec3<T> direction, T distance) {
        return (T(1) / distance) * (v - dot(v, direction) * direction);
    };
    const Vec3<T> g_a = across(path.to_camera, path.camera_distance);
    const Vec3<T> g_b = across(path.to_source, path.source_distance);
    const Vec3<T> g_start = T(-1) * (g_a + g_b);  // to the point of u
    const Vec3<T> g_camera = (g - g_ray) + g_a, g_center = g_point + g_start;
    terms[0] = g_camera.x;
    terms[1] = g_camera.y;
    terms[2] = g_camera.z;
    terms[3] = g_center.x;
    terms[4] = g_center.y;
    terms[5] = g_center.z;
    for (int k = 6; k < kMirrorValues; ++k) terms[k] = T(0);
    add_outer(g_point, unit, terms + 6);
    add_outer(g_start, u, terms + 6);
    add_outer(T(-1) * (path.to_camera + path.to_source), w, terms + 6);
    return to_source + g_b;
}

}  // namespace catacaustics
