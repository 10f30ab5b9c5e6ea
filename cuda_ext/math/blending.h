// One splat at one pixel: alpha, blending, and the linear two-pass backward (METHOD: no division, exact at alpha = 1).
#pragma once

#include "common.h"

namespace catacaustics {

// Quadratic form -log2(falloff) of a splat at offset (skew + m dy, dy): scaled so that falloff = 2^exponent.
template <class T>
CATACAUSTICS_HD T exponent(T skew, T dy, T scaled_w, T scaled_v) {
    return scaled_w * skew * skew + scaled_v * dy * dy;
}

// -1/2 log2(e): q -> exponent.
constexpr double kExponentScale = -0.72134752044448170368;

// Front to back: returns the weight alpha T of the splat's colour, and moves T behind the splat.
template <class T>
CATACAUSTICS_HD T blend_step(T opacity, T falloff, T& transmittance) {
    const T alpha = opacity * falloff;
    const T weight = alpha * transmittance;
    transmittance = transmittance * (T(1) - alpha);
    return weight;
}

// Back to front: `through` is T before the splat, `color` is g . c, `behind` is dL/dT behind the splat and is moved in
// front of it. Returns falloff dL/dalpha, from which all gradients but that of the features follow.
template <class T>
CATACAUSTICS_HD T blend_step_backward(T opacity, T falloff, T through, T color, T& behind) {
    const T alpha = opacity * falloff;
    const T g_alpha = through * (color - behind);
    behind = alpha * color + (T(1) - alpha) * behind;
    return falloff * g_alpha;
}

// Sums over a splat's pixels of h = falloff dL/dalpha and its moments.
template <class T>
struct PairSums {
    T h, skew, dy, skew2, skew_dy, dy2;
};

template <class T>
CATACAUSTICS_HD void add_pair(PairSums<T>& sums, T h, T skew, T dy) {
    const T h_skew = h * skew, h_dy = h * dy;
    sums.h = sums.h + h;
    sums.skew = sums.skew + h_skew;
    sums.dy = sums.dy + h_dy;
    sums.skew2 = sums.skew2 + h_skew * skew;
    sums.skew_dy = sums.skew_dy + h_skew * dy;
    sums.dy2 = sums.dy2 + h_dy * dy;
}

template <class T>
struct SplatGradient {
    T mean_x, mean_y, w, m, v, opacity;
};

template <class T>
CATACAUSTICS_HD SplatGradient<T> splat_gradient(const PairSums<T>& sums, T opacity, T w, T m, T v) {
    const T skew = opacity * w * sums.skew;
    const T half = T(-0.5) * opacity;
    return {
        skew,
        opacity * v * sums.dy - m * skew,
        half * sums.skew2,
        opacity * w * sums.skew_dy,
        half * sums.dy2,
        sums.h,
    };
}

// The ellipse q <= reach2 cut by rows dy in [low, high]: its extent [left, right] along dx. Empty where right < left.
// `turn` is the dy of the ellipse's rightmost point (-turn of its leftmost), `reach_y` its largest dy.
template <class T>
CATACAUSTICS_HD void row_extent(
    T low, T high, T reach_y, T turn, T reach2, T m, T v, T inv_w, T& left, T& right) {
    low = select(low > -reach_y, low, -reach_y);
    high = select(high < reach_y, high, reach_y);
    T at = select(-turn > low, -turn, low);
    at = select(at < high, at, high);
    T rest = reach2 - v * at * at;
    left = m * at - square_root(select(rest > T(0), rest, T(0)) * inv_w);
    at = select(turn > low, turn, low);
    at = select(at < high, at, high);
    rest = reach2 - v * at * at;
    right = m * at + square_root(select(rest > T(0), rest, T(0)) * inv_w);
    right = select(low > high, left - T(1), right);
}

}  // namespace catacaustics
