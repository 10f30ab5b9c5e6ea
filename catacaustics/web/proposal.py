"""Which views to paint first: a few whose masks together bound the reflector well."""

from collections.abc import Sequence

import numpy as np

from catacaustics.cameras import Camera
from catacaustics.geometry import normalize, sphere_directions
from catacaustics.shapes import Float


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
    lines = normalize(np.array([cameras[i].center for i in candidates]) - target)
    sines = np.sqrt(np.maximum(1 - (lines @ sphere_directions(600).T) ** 2, 0.02))
    reach = sines**-3.0  # its cube is the volume by solid angle
    chosen = _exchange(reach, count, len(fixed))
    return sorted(candidates[chosen].tolist())


def _exchange(reach: Float[np.ndarray, "views directions"], count: int, fixed: int) -> list[int]:
    """The first `fixed` rows and others, so that the minimum by column has a small mean: taken one by one, then
    exchanged while that helps."""
    chosen = list(range(fixed))
    for _ in range(count - fixed):
        left = reach[chosen].min(0) if chosen else np.inf
        chosen.append(int(np.minimum(reach, left).mean(1).argmin()))
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
