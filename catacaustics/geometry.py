"""Rigid and similarity transforms; convex polyhedra.

A transform named `b_from_a` takes coordinates in a to coordinates in b.
"""

from typing import NamedTuple

import numpy as np

from catacaustics.shapes import Float, Int


class Similarity(NamedTuple):
    """x_b = scale * rotation @ x_a + translation."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        return self.scale * points @ self.rotation.T + self.translation


def normalize(vectors: Float[np.ndarray, "*batch d"]) -> Float[np.ndarray, "*batch d"]:
    """Unit vectors; a zero vector stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def sphere_directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Unit vectors spread evenly over the sphere: a spiral by the golden angle, from +z to -z."""
    turn = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * turn / count), np.pi * (1 + 5**0.5) * turn
    return np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], -1)


def rigid(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """The 4x4 matrix of x -> rotation @ x + translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def rigid_inverse(b_from_a: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    rotation = b_from_a[:3, :3].T
    return rigid(rotation, -rotation @ b_from_a[:3, 3])


def transform(b_from_a: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return points @ b_from_a[:3, :3].T + b_from_a[:3, 3]


def look_at(
    eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """camera_from_world (OpenCV axes: x right, y down, z forward) of a camera at `eye` that looks at `target`.

    Raises:
        ValueError: `up` is parallel to the line of sight, or eye and target coincide.
    """
    forward = normalize(target - eye)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9 * max(np.linalg.norm(up), 1e-300):
        raise ValueError(f"look_at needs eye, target and up in general position, got {eye}, {target}, {up}")
    right = normalize(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rigid(rotation, -rotation @ eye)


def rotation_angle(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    """Angle of a rotation in radians, accurate near 0 too: |R - I|_F = 2 sqrt(2) sin(angle / 2)."""
    half_sine = np.linalg.norm(rotation - np.eye(3), axis=(-2, -1)) / (2 * np.sqrt(2))
    return np.asarray(2 * np.arcsin(np.clip(half_sine, 0, 1)))


def fit_similarity(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> Similarity:
    """Least-squares similarity target_from_source (Umeyama, PAMI 1991).

    Raises:
        ValueError: fewer than 3 points, or all on one line: the rotation is not determined.
    """
    if len(source) < 3 or len(source) != len(target):
        raise ValueError(f"fit_similarity needs 3 or more matched points, got {len(source)} and {len(target)}")
    source_mean, target_mean = source.mean(0), target.mean(0)
    a, b = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd(b.T @ a / len(a))
    if singular[1] < 1e-12 * singular[0]:
        raise ValueError("fit_similarity needs points that are not all on one line")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((singular * sign).sum() / (a**2).sum(1).mean())
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


# Convex polyhedra. A half-space (n, d) is the set of x with n . x + d <= 0; n has unit length and points outward.


def chebyshev_center(halfspaces: Float[np.ndarray, "k 4"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Centre and radius of the largest ball inside an intersection of half-spaces, by linear programming.

    The radius is negative where the intersection is empty (minus the smallest violation that a point can have), and
    infinite where balls of any size fit.
    """
    from scipy.optimize import linprog

    bounds = [(None, None)] * 4
    matrix = np.concatenate([halfspaces[:, :3], np.ones((len(halfspaces), 1))], -1)
    answer = linprog([0, 0, 0, -1], A_ub=matrix, b_ub=-halfspaces[:, 3], bounds=bounds, method="highs")
    if answer.x is None:  # the problem always has a feasible point, so it is unbounded
        return np.zeros(3), np.inf
    return answer.x[:3], float(answer.x[3])


def is_bounded(normals: Float[np.ndarray, "k 3"]) -> bool:
    """Whether a non-empty intersection of half-spaces with these outward normals is bounded: no direction v, other
    than zero, has n . v <= 0 for all of them."""
    from scipy.optimize import linprog

    for objective in np.concatenate([np.eye(3), -np.eye(3)]):
        answer = linprog(objective, A_ub=normals, b_ub=np.zeros(len(normals)), bounds=[(-1, 1)] * 3, method="highs")
        if answer.fun < -1e-6:
            return False
    return True


def intersect_halfspaces(
    halfspaces: Float[np.ndarray, "k 4"], inside: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "m"]]:
    """Vertices of a bounded intersection of half-spaces, and the indices of the half-spaces that bound it.

    Args:
        inside: a point strictly inside, such as the Chebyshev centre.
    """
    from scipy.spatial import HalfspaceIntersection

    result = HalfspaceIntersection(halfspaces, inside)
    return result.intersections, np.unique(np.concatenate([np.asarray(f, int) for f in result.dual_facets]))


def hull_mesh(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Convex hull of points as a triangle mesh: vertices, and faces that run counter-clockwise seen from outside."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    index = np.full(len(points), -1)
    index[hull.vertices] = np.arange(len(hull.vertices))
    faces, corners = index[hull.simplices], points[hull.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (normals * hull.equations[:, :3]).sum(-1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return points[hull.vertices], faces
