"""Where the learned mirrors start: planes, spheres and ellipsoids that touch a reflection volume from inside,
and bodies that most of a visual hull lies on.

Each plane that bounds the volume was lifted from a mask's outline, so the reflector touches it: fits are to the planes,
not to the volume's corners, which lie outside the reflector.
"""

import numpy as np
import torch

from catacaustics.geometry import normalize, sphere_directions
from catacaustics.reflectors.quadric import distances as distances_from_quadric
from catacaustics.reflectors.revolution import Revolution
from catacaustics.reflectors.revolution import distances as distances_from_revolution
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.shapes import Float

_FLAT = 0.1
"""A volume thinner than this share of its length is a plate as it is."""
_PLANES = 150
"""Bounding planes that a mirror's plane is fitted to, at most: a round body of many masks has ten times as many."""
BODY_SCALE = 0.03
"""Of the size of a body: points farther from it belong to something else."""
_THINNEST = 0.1
"""A fitted radius below this share of the largest one is not believed."""
PROFILE = 24
"""Coefficients of the profile of a surface of revolution."""
_STIFFNESS = 0.03
"""Of the profile against bends that the points of a visual hull do not ask for."""


def fit_plane(
    volume: ReflectionVolume, cameras: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """A point and the unit normal, towards most cameras, of the plane of a flat reflector.

    A thin volume shows its face. Views from the front alone leave a double pyramid: the mirror is the section that all
    bounding planes touch, as each was lifted from its outline. Least squares of their distances from the section.

    Args:
        cameras: camera centres.
    """
    from scipy.optimize import minimize

    surface = volume.sample_surface(4000, np.random.default_rng(0))[0]
    middle = surface.mean(0)
    extents, axes = np.linalg.svd(surface - middle, full_matrices=False)[1:]
    thin = axes[2] if np.median((cameras - middle) @ axes[2]) > 0 else -axes[2]
    if extents[2] < _FLAT * extents[0]:
        return middle + np.quantile((surface - middle) @ thin, 0.95) * thin, thin

    def plane(start: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        normal = normalize(start + x[:2] @ np.linalg.svd(start[None])[2][1:])
        return middle + x[2] * volume.radius * normal, normal

    planes = volume.halfspaces[:: -(-len(volume.halfspaces) // _PLANES)]
    found = []
    for start in (thin, normalize(np.median(cameras, 0) - middle)):
        simplex = np.vstack([np.zeros(3), 0.3 * np.eye(3)])
        answer = minimize(
            lambda x, start=start: _gaps(planes, volume.radius, *plane(start, x)),
            np.zeros(3),
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-9},
        )
        found.append((answer.fun, plane(start, answer.x)))
    point, normal = min(found, key=lambda pair: pair[0])[1]
    return point, normal if np.median((cameras - point) @ normal) > 0 else -normal


def _gaps(
    planes: Float[np.ndarray, "k 4"], radius: float, point: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"]
) -> float:
    """Mean squared distance of the bounding planes of a volume of some radius from its section by a plane, in units of
    the radius; 1 where the plane misses the volume."""
    basis = np.linalg.svd(normal[None])[2][1:]
    lines = np.c_[planes[:, :3] @ basis.T, planes[:, :3] @ point + planes[:, 3]]
    corners = 4 * radius * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    for *slope, offset in lines:  # Sutherland and Hodgman 1974
        height = corners @ slope + offset
        inside, following = height <= 0, np.roll(height, -1)
        if inside.all():
            continue
        crossing = inside != (following <= 0)
        share = height / np.where(crossing, height - following, 1)
        cuts = corners + share[:, None] * (np.roll(corners, -1, axis=0) - corners)
        kept = np.stack([inside, crossing], 1).ravel()
        corners = np.stack([corners, cuts], 1).reshape(-1, 2)[kept]
        if not len(corners):
            return 1.0
    gaps = (lines[:, :2] @ corners.T).max(1) + lines[:, 2]
    return float(np.mean(gaps**2)) / radius**2


def fit_sphere(volume: ReflectionVolume) -> tuple[Float[np.ndarray, "3"], float]:
    """Centre and radius of the sphere that the bounding planes touch."""
    center, radius = _touching_sphere(volume, volume.halfspaces)
    return center, float(np.clip(radius, 0.1 * volume.radius, volume.radius))


def fit_bowl(volume: ReflectionVolume, cameras: Float[np.ndarray, "m 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Centre and radius of the sphere of a bowl's inner side: of the planes that face away from the cameras, which
    touch its thin wall; the others touch its rim."""
    planes = volume.halfspaces
    away = planes[:, :3] @ (np.median(cameras, 0) - volume.center) < 0
    center, radius = _touching_sphere(volume, planes[away] if away.sum() >= 4 else planes)
    return center, float(np.clip(radius, 0.5 * volume.radius, 3 * volume.radius))


def _touching_sphere(volume: ReflectionVolume, planes: Float[np.ndarray, "k 4"]) -> tuple[np.ndarray, float]:
    """Centre s and radius r of the sphere that planes touch: n . s + d + r = 0, least squares."""
    matrix = np.c_[planes[:, :3], np.ones(len(planes))]
    # About the volume's centre, so that a direction without planes leaves the centre there.
    answer = np.linalg.lstsq(matrix, -(planes[:, 3] + planes[:, :3] @ volume.center), rcond=1e-6)[0]
    return volume.center + answer[:3], float(answer[3])


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


def body_loss(distances: Float[torch.Tensor, "n"]) -> Float[torch.Tensor, ""]:
    """Cauchy's loss of distances of a visual hull's points from a body, in units of its size; differentiable."""
    return torch.log1p((distances / BODY_SCALE) ** 2).mean()


def fit_body(
    points: Float[np.ndarray, "n 3"],
    center: Float[np.ndarray, "3"],
    axes: Float[np.ndarray, "3 3"],
    sphere: bool,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Centre and half-axes (columns) of the ellipsoid, or sphere, that most points of a surface lie on: the body of a
    kettle without its spout, the belly of a vase without its neck.

    Least squares of first-order distances (Taubin 1991) with Cauchy's loss at 3 % of the size, from three sizes.

    Args:
        points: on the surface of a visual hull.
        center, axes: of the largest size to start from; a sphere starts with their mean length.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    start = np.linalg.norm(axes, axis=0)
    size = float(start.mean())
    frame = np.eye(3) if sphere else axes / start * np.sign(np.linalg.det(axes))

    def body(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if sphere:
            return center + size * x[:3], frame, np.full(3, size * np.exp(x[3]))
        return center + size * x[:3], Rotation.from_rotvec(x[3:6]).as_matrix() @ frame, start * np.exp(x[6:])

    def distances(x: np.ndarray) -> np.ndarray:
        middle, rotation, radii = body(x)
        shape = (torch.from_numpy(v) for v in (middle, rotation * radii))
        return distances_from_quadric(cloud, *shape).numpy() / size

    cloud = torch.from_numpy(points)
    starts = [np.r_[np.zeros(3 if sphere else 6), np.full(1 if sphere else 3, np.log(f))] for f in (1, 0.8, 0.6)]
    answers = [least_squares(distances, x, loss="cauchy", f_scale=BODY_SCALE, max_nfev=100) for x in starts]
    answer = min(answers, key=lambda a: a.cost)
    middle, rotation, radii = body(answer.x)
    believed = np.isfinite(answer.x).all() and radii.min() > 0.2 * size and radii.max() < 3 * size
    return (middle, rotation * radii) if believed else (center, axes)


def fit_bent_sheet(volume: ReflectionVolume) -> list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]]:
    """Cylinders, as long ellipsoids (centre and half-axes in columns), for a sheet that is bent about either of its
    long directions; none for a volume that is not flat.

    Over a width 2 w and a height s, an arc has the radius (w^2 + s^2) / (2 s). Its hull has more surface near the chord
    than near the crown, which tells the convex side.
    """
    surface = volume.sample_surface(40_000, np.random.default_rng(0))[0]
    middle = surface.mean(0)
    axes = np.linalg.svd(surface - middle, full_matrices=False)[2]
    heights = (volume.vertices - middle) @ axes.T
    if heights[:, 2].max() < -heights[:, 2].min():
        axes[2], heights[:, 2] = -axes[2], -heights[:, 2]
    half = np.ptp(heights, axis=0) / 2
    if half[2] > 0.5 * half[1]:
        return []
    found = []
    for along, across in ((0, 1), (1, 0)):
        radius = (half[across] ** 2 + 4 * half[2] ** 2) / (4 * half[2])
        center = middle + (heights[:, 2].max() - radius) * axes[2]
        found.append((center, np.stack([8 * half[along] * axes[along], radius * axes[across], radius * axes[2]], 1)))
    return found


def fit_revolution(
    points: Float[np.ndarray, "n 3"], center: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"]
) -> tuple[Revolution, float]:
    """The surface of revolution about one of an ellipsoid's axes that most points of a surface lie on, and its loss by
    `body_loss`.

    Least squares of first-order distances with Cauchy's loss, as `fit_body`; third differences of the profile are held
    small, so that ellipsoids of revolution are free.

    Args:
        points: on the surface of a visual hull.
        center, axes: of the ellipsoid that `fit_body` found.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    cloud, size = torch.from_numpy(points), float(np.linalg.norm(axes, axis=0).mean())
    starts = [_coaxial(points, center, np.roll(axes, 2 - third, axis=1), size) for third in range(3)]
    start = min(starts, key=lambda surface: _off(cloud, surface, size))

    def moved(x: np.ndarray) -> Revolution:
        tilt = torch.from_numpy(Rotation.from_rotvec([x[2], x[3], 0]).as_matrix())
        return start._replace(
            center=start.center + size * start.frame[:, :2] @ torch.from_numpy(x[:2]),
            frame=start.frame @ tilt,
            squared=start.squared + size**2 * torch.from_numpy(x[4:]),
        )

    def residuals(x: np.ndarray) -> np.ndarray:
        surface = moved(x)
        stiff = _STIFFNESS * len(points) ** 0.5 * np.diff(surface.squared.numpy(), 3) / size**2
        return np.concatenate([distances_from_revolution(surface, cloud).numpy() / size, stiff])

    answer = least_squares(residuals, np.zeros(4 + PROFILE), loss="cauchy", f_scale=BODY_SCALE, max_nfev=30)
    surface = moved(answer.x)
    return surface, _off(cloud, surface, size)


def _off(points: torch.Tensor, surface: Revolution, size: float) -> float:
    return float(body_loss(distances_from_revolution(surface, points) / size))


def _coaxial(
    points: Float[np.ndarray, "n 3"], center: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"], size: float
) -> Revolution:
    """The surface of revolution about the last of an ellipsoid's axes: reweighted least squares."""
    from scipy.interpolate import BSpline

    radii = np.linalg.norm(axes, axis=0)
    frame = axes / radii * np.sign(np.linalg.det(axes))
    local = (points - center) @ frame
    ends = np.quantile(local[:, 2], (0.002, 0.998))
    knots = ends[0] + (ends[1] - ends[0]) / (PROFILE - 3) * (np.arange(PROFILE + 4) - 3)
    matrix = BSpline(knots, np.eye(PROFILE), 3)(np.clip(local[:, 2], *ends))
    squared = (local[:, :2] ** 2).sum(1) / size**2
    stiff = _STIFFNESS * len(points) ** 0.5 * np.diff(np.eye(PROFILE), 3, axis=0)
    weights, answer = np.ones(len(points)), np.zeros(PROFILE)
    for _ in range(15):
        rows = np.concatenate([weights[:, None] * matrix, stiff])
        answer = np.linalg.lstsq(rows, np.concatenate([weights * squared, np.zeros(len(stiff))]), rcond=None)[0]
        weights = 1 / np.sqrt(1 + ((matrix @ answer - squared) / (2 * BODY_SCALE)) ** 2)
    arrays = (np.array(center, float), frame, radii, ends, size**2 * answer)
    return Revolution(*(torch.from_numpy(np.ascontiguousarray(a)) for a in arrays))


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
    from scipy.spatial import KDTree

    directions = sphere_directions(count)
    offsets = points - volume.center
    distances = np.linalg.norm(offsets, axis=1)
    outside = distances > 1.02 * volume.radius
    known = normalize(offsets[outside])
    distance, color = np.full(count, np.nan), np.tile(fallback, (count, 1))
    if len(known):
        # The nearest of the points within a direction's own cone; all points of a cone are asked, nearest last.
        cell = np.asarray(KDTree(directions).query(known)[1])
        order = np.argsort(-distances[outside], kind="stable")
        distance[cell[order]] = distances[outside][order]
        color[cell[order]] = colors[outside][order]
    filled = np.isfinite(distance)
    if filled.any() and not filled.all():
        found = KDTree(directions[filled]).query(directions[~filled], k=min(4, int(filled.sum())))
        gap, nearest = (np.reshape(part, (int((~filled).sum()), -1)) for part in found)
        guess = np.median(distance[filled][nearest], axis=1)
        close = gap[:, 0] < 0.25
        distance[~filled] = np.where(close, guess, np.maximum(guess, far))
        color[~filled] = np.where(close[:, None], color[filled][nearest[:, 0]], fallback)
    distance[~np.isfinite(distance)] = far
    order = rng.permutation(count)
    return (volume.center + distance[:, None] * directions)[order], color[order]
