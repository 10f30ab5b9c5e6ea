// Vectors of three.
#pragma once

#include "common.h"

namespace catacaustics {

template <class T>
struct Vec3 {
    T x, y, z;
};

template <class T>
CATACAUSTICS_HD Vec3<T> operator+(Vec3<T> a, Vec3<T> b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}

template <class T>
CATACAUSTICS_HD T dot(Vec3<T> a, Vec3<T> b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <class T>
CATACAUSTICS_HD Vec3<T> operator-(Vec3<T> a, Vec3<T> b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}

template <class T>
CATACAUSTICS_HD Vec3<T> operator*(T scale, Vec3<T> a) {
    return {scale * a.x, scale * a.y, scale * a.z};
}

template <class Condition, class T>
CATACAUSTICS_HD Vec3<T> select(Condition condition, Vec3<T> yes, Vec3<T> no) {
    return {select(condition, yes.x, no.x), select(condition, yes.y, no.y), select(condition, yes.z, no.z)};
}

// Two orthonormal tangents of a unit vector (Duff et al. 2017, "Building an Orthonormal Basis, Revisited").
template <class T>
struct Tangents {
    T sign, a, b;
    Vec3<T> first, second;

    CATACAUSTICS_HD explicit Tangents(Vec3<T> n) {
        sign = select(n.z < T(0), T(-1), T(1));
        a = T(-1) / (sign + n.z);
        b = n.x * n.y * a;
        first = {T(1) + sign * n.x * n.x * a, sign * b, -(sign * n.x)};
        second = {b, sign + n.y * n.y * a, -n.y};
    }
    CATACAUSTICS_HD Vec3<T> combine(T x, T y) const { return x * first + y * second; }
};

}  // namespace catacaustics
