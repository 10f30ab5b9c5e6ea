"""Which views to paint first: a few whose masks together bound the reflector well."""

from collections.abc import Sequence

import numpy as np

from catacaustics.cameras import Camera
from catacaustics.geometry import sphere_directions
from catacaustics.shapes import Float

_RADIUS = 0.15
"""Of the object, in units of the cameras' distance from it."""
_TANGENT = _RADIUS / np.sqrt(1 - _RADIUS**2)
_STARTS = 12
"""Searches for good views, each from another view."""
_SECTORS = 24
"""Of an outline, in which its radius is found."""


def look_at_point(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """The point nearest to all optical axes (least squares); for parallel axes the one among them nearest to the
    origin."""
    axes = np.array([c.camera_from_world[2, :3] for c in cameras])
    centers = np.array([c.center for c in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projects onto the plane across each axis
    return np.linalg.lstsq(across.sum(0), (across @ centers[..., None]).sum(0)[:, 0], rcond=None)[0]


def propose_views(
    cameras: Sequence[Camera], target: Float[np.ndarray, "3"], count: int = 4, painted: Sequence[int] = ()
) -> list[int]:
    """Indices of views that bound an object at `target` well, in ascending order. Views that are painted already are
    among them; where there are enough, only those.

    Only views that have the target in their middle (within half of the way to the border) are taken, as long as there
    are enough. Among them those are sought whose pyramids over a ball leave little beside the ball: far along a
    direction n the pyramid of a view with line of sight d reaches 1 / sin(n, d) times the ball's radius.
    """
    off_center = np.empty(len(cameras))
    for i, camera in enumerate(cameras):
        pixel, depth = camera.project(target)
        away = np.abs(pixel / [camera.width / 2, camera.height / 2] - 1).max()
        off_center[i] = away if depth > 0 else np.inf
    order = np.argsort(off_center, kind="stable")
    central = order[: max(2 * count, int((off_center <= 0.5).sum()))]
    fixed = list(painted) if len(painted) < count else []
    candidates = np.array(painted if len(painted) >= count else [*fixed, *np.setdiff1d(central, fixed)])
    if len(candidates) <= count:
        return sorted(candidates.tolist())
    offsets = np.array([cameras[i].center for i in candidates]) - target
    directions = sphere_directions(2000)
    reach = _reach(offsets, directions)
    seeds = range(0, len(candidates), max(1, len(candidates) // _STARTS))
    found = {tuple(sorted(_exchange(reach**3, count, len(fixed), seed))) for seed in seeds}  # the cube: volume
    watching = np.array([c.center for c in cameras[:: max(1, len(cameras) // 60)]]) - target
    best = max(sorted(found), key=lambda chosen: _worst_overlap(reach[list(chosen)].min(0), directions, watching))
    return sorted(candidates[list(best)].tolist())


def _reach(
    cameras: Float[np.ndarray, "views 3"], directions: Float[np.ndarray, "directions 3"]
) -> Float[np.ndarray, "views directions"]:
    """How far the cones of views over a ball at the origin reach along directions, in radii of the ball, at most 7."""
    distance = np.linalg.norm(cameras, axis=1, keepdims=True)
    towards = -(cameras / distance) @ directions.T
    # Inside: t sin <= tan(half angle) (distance + t cos), with the ball's radius = _RADIUS distance.
    slack = np.sqrt(1 - np.minimum(towards**2, 1)) - _TANGENT * towards
    return np.minimum(_TANGENT / _RADIUS / np.maximum(slack, 1e-6), 7)


def _worst_overlap(
    reach: Float[np.ndarray, "directions"],
    directions: Float[np.ndarray, "directions 3"],
    cameras: Float[np.ndarray, "views 3"],
) -> float:
    """Of a ball and a body around it that reaches `reach` radii along directions: the least overlap (intersection over
    union) of their outlines as cameras see them."""
    overlaps = []
    for camera in cameras:
        distance = np.linalg.norm(camera)
        basis = np.linalg.svd(camera[None])[2][1:]
        points = _RADIUS * directions * reach[:, None]  # distance 1
        flat = points @ basis.T / (1 - points @ (camera / distance))[:, None] / _TANGENT
        sector = ((np.arctan2(flat[:, 1], flat[:, 0]) / np.pi + 1) / 2 * _SECTORS).astype(int) % _SECTORS
        radius = np.ones(_SECTORS)
        np.maximum.at(radius, sector, np.linalg.norm(flat, axis=1))
        overlaps.append(1 / np.mean(radius**2))
    return min(overlaps)


def _exchange(reach: Float[np.ndarray, "views directions"], count: int, fixed: int, seed: int) -> list[int]:
    """The first `fixed` rows, `seed` and others, so that the minimum by column has a small mean: taken one by one, then
    exchanged, all but the fixed ones, while that helps."""
    chosen = list(dict.fromkeys([*range(fixed), seed]))
    for _ in range(count - len(chosen)):
        chosen.append(int(np.minimum(reach, reach[chosen].min(0)).mean(1).argmin()))
    while True:
        best = reach[chosen].min(0).mean()
        for i in range(fixed, count):
            others = chosen[:i] + chosen[i + 1 :]
            left = reach[others].min(0) if others else np.inf
            sums = np.minimum(reach, left).mean(1)
            if sums.min() < best - 1e-9:
                chosen[i] = int(sums.argmin())
                break
        else:
            return chosen
