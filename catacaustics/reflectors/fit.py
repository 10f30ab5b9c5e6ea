"""Where the learned mirrors start: planes, spheres and ellipsoids that touch a reflection volume from inside.

Each plane that bounds the volume was lifted from a mask's outline, so the reflector touches it: fits are to the planes,
not to the volume's corners, which lie outside the reflector.
"""

import numpy as np

from catacaustics.geometry import normalize, sphere_directions
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.shapes import Float

_THINNEST = 0.1
"""A fitted radius below this share of the largest one is not believed."""


def fit_plane(
    volume: ReflectionVolume, cameras: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """A point and the unit normal of the face of a thin volume: across its least extent, on the side of most cameras.

    Args:
        cameras: camera centres.
    """
    rng = np.random.default_rng(0)
    surface = volume.sample_surface(4000, rng)[0]
    middle = surface.mean(0)
    normal = np.linalg.svd(surface - middle, full_matrices=False)[2][2]
    if np.median((cameras - middle) @ normal) < 0:
        normal = -normal
    height = np.quantile((surface - middle) @ normal, 0.95)
    return middle + height * normal, normal


def fit_sphere(volume: ReflectionVolume) -> tuple[Float[np.ndarray, "3"], float]:
    """Centre s and radius r of the sphere that the bounding planes touch: n . s + d + r = 0, least squares."""
    planes = volume.halfspaces
    matrix = np.c_[planes[:, :3], np.ones(len(planes))]
    # About the volume's centre, so that a direction without planes leaves the centre there.
    answer = np.linalg.lstsq(matrix, -(planes[:, 3] + planes[:, :3] @ volume.center), rcond=1e-6)[0]
    smallest, largest = 0.1 * volume.radius, volume.radius
    return volume.center + answer[:3], float(np.clip(answer[3], smallest, largest))


def fit_ellipsoid(volume: ReflectionVolume) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Centre and half-axes (columns) of the ellipsoid x = s + A u that the bounding planes touch.

    A plane touches where (n . s + d)^2 = n' Q n, Q = A A': linear in s and Q - s s' (the dual quadric, Cross and
    Zisserman 1998). Where no ellipsoid fits, the sphere of `fit_sphere`.
    """
    center, radius = fit_sphere(volume)
    normals = volume.halfspaces[:, :3]
    d = (volume.halfspaces[:, 3] + normals @ center) / radius
    x, y, z = normals.T
    matrix = np.stack(
        [x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, -2 * d * x, -2 * d * y, -2 * d * z], axis=1
    )
    answer, _, rank, _ = np.linalg.lstsq(matrix, d * d, rcond=1e-9)
    a, b, c, xy, xz, yz, *shift = answer
    squared = np.array([[a, xy, xz], [xy, b, yz], [xz, yz, c]]) + np.outer(shift, shift)
    values, vectors = np.linalg.eigh(squared)
    if rank < 9 or values[0] < (_THINNEST**2) * values[2] or np.linalg.norm(shift) > 1 or values[2] > 9:
        return center, radius * np.eye(3)
    return center + radius * np.array(shift), radius * vectors * np.sqrt(values)


def surroundings(
    points: Float[np.ndarray, "n 3"],
    colors: Float[np.ndarray, "n 3"],
    volume: ReflectionVolume,
    count: int,
    far: float,
    fallback: Float[np.ndarray, "3"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
    """World points around a reflector and their colours, evenly spread over directions: what it may mirror.

    In each of `count` directions stands the nearest known point; where there is none, a point as far as the known
    ones in neighbouring directions, at least `far` where none is near, of the colour `fallback`.
    """
    from scipy.spatial import cKDTree

    directions = sphere_directions(count)
    offsets = points - volume.center
    distances = np.linalg.norm(offsets, axis=1)
    outside = distances > 1.02 * volume.radius
    known = normalize(offsets[outside])
    distance, color = np.full(count, np.nan), np.tile(fallback, (count, 1))
    if len(known):
        # The nearest of the points within a direction's own cone; all points of a cone are asked, nearest last.
        cell = cKDTree(directions).query(known)[1]
        order = np.argsort(-distances[outside], kind="stable")
        distance[cell[order]] = distances[outside][order]
        color[cell[order]] = colors[outside][order]
    filled = np.isfinite(distance)
    if filled.any() and not filled.all():
        gap, nearest = cKDTree(directions[filled]).query(directions[~filled], k=min(4, int(filled.sum())))
        gap, nearest = gap.reshape(len(gap), -1), nearest.reshape(len(nearest), -1)
        guess = np.median(distance[filled][nearest], axis=1)
        close = gap[:, 0] < 0.25
        distance[~filled] = np.where(close, guess, np.maximum(guess, far))
        color[~filled] = np.where(close[:, None], color[filled][nearest[:, 0]], fallback)
    distance[~np.isfinite(distance)] = far
    order = rng.permutation(count)
    return (volume.center + distance[:, None] * directions)[order], color[order]
