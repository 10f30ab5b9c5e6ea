"""A rough scribble over an object becomes its outline, by edges or by colour.

By edges: the closed curve around the scribble that follows the strongest edges, found by dynamic programming along rays
from its middle. By colour: GrabCut (Rother, Kolmogorov, Blake, SIGGRAPH 2004). A mirror shows the colours of its
surroundings, so edges are the better guide there.
"""

import numpy as np

from catacaustics.errors import UserError
from catacaustics.shapes import Bool, Float, UInt8

_WORK_SIZE = 360
"""Longer side in pixels of what is worked on."""
_REACH = 0.25
"""GrabCut: how far beyond the scribble's hull the object may go, in radii of the hull."""
_CORE = 0.25
"""GrabCut: scribbled pixels deeper inside the hull than this share of its depth are the object for certain."""
_RAYS, _STEPS = 180, 81
"""Edges: rays around the middle, and places on each."""
_ROUNDS = ((0.75, 1.45, 1.1), (0.85, 1.27, 1.0), (0.91, 1.16, 1.0))
"""Edges: from where to where the curve is searched, and where it is expected, in radii of the last round's curve;
people scribble inside."""
_STRAY, _TURN = 2.0, 1.5
"""Edges: cost of a place away from the expected one, and of a step between neighbouring rays (squared); the best edge
counts 3."""


def outline_scribble(
    image: UInt8[np.ndarray, "height width 3"],
    scribble: Bool[np.ndarray, "height width"],
    by_color: bool = False,
) -> Bool[np.ndarray, "height width"]:
    """The object that a scribble marks: a mask without holes. The same input always gives the same mask.

    Args:
        scribble: over most of the object, its convex hull roughly the object's.
        by_color: by GrabCut instead of by edges.

    Raises:
        UserError: nothing is scribbled, it fills the picture, or no object is found.
    """
    import cv2

    if not scribble.any():
        raise UserError(
            "There is nothing to outline in this view.", "a rough scribble over the object", "paint one with the brush"
        )
    hull = _filled_hull(scribble)
    radius = float(np.sqrt(hull.sum() / np.pi))
    x0, y0, x1, y1 = _window(hull, margin=int(0.6 * radius) + 8)
    scale = min(1.0, _WORK_SIZE / max(x1 - x0, y1 - y0))
    size = (max(round((x1 - x0) * scale), 1), max(round((y1 - y0) * scale), 1))
    if hull[y0:y1, x0:x1].mean() > 0.9 or min(size) < 8:
        raise UserError(
            "The scribble fills nearly the whole picture.", "some background around the object", "scribble less"
        )
    picture = cv2.resize(image[y0:y1, x0:x1, ::-1], size, interpolation=cv2.INTER_AREA)
    small = cv2.resize(scribble[y0:y1, x0:x1].astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.25
    if not small.any():
        small = cv2.resize(hull[y0:y1, x0:x1].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    found = _by_color(picture, small) if by_color else _by_edges(picture, small)
    if not found.any():
        raise UserError(
            "No object stands out under the scribble.",
            "an object that differs from its surroundings",
            "paint it by hand",
        )
    result = np.zeros_like(scribble)
    soft = cv2.resize(found.astype(np.float32), (x1 - x0, y1 - y0), interpolation=cv2.INTER_LINEAR)
    result[y0:y1, x0:x1] = soft > 0.5
    return result


# By edges ------------------------------------------------------------------------------------------------------------


def _by_edges(picture: np.ndarray, scribble: np.ndarray) -> np.ndarray:
    import cv2

    lab = cv2.cvtColor(picture.astype(np.float32) / 255, cv2.COLOR_BGR2LAB)
    lab = cv2.GaussianBlur(lab, (0, 0), 1.5)
    mask = _filled_hull(scribble)
    for nearest, farthest, expected in _ROUNDS:
        mask = _filled_hull(_follow_edges(lab, mask, np.linspace(nearest, farthest, _STEPS), expected))
    return mask


def _follow_edges(lab: np.ndarray, base: np.ndarray, radii: np.ndarray, expected: float) -> np.ndarray:
    """The best closed curve around the middle of a mask, its places in shares of the mask's own (smoothed) radius."""
    import cv2
    from scipy.ndimage import gaussian_filter1d

    y, x = np.nonzero(base)
    middle = np.array([x.mean() + 0.5, y.mean() + 0.5])
    outlines, _ = cv2.findContours(base.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    border = max(outlines, key=len)[:, 0] + 0.5 - middle
    angles = np.linspace(-np.pi, np.pi, _RAYS, endpoint=False)
    order = np.argsort(np.arctan2(border[:, 1], border[:, 0]))
    length = np.hypot(*border[order].T)
    length = np.interp(angles, np.arctan2(border[order, 1], border[order, 0]), length, period=2 * np.pi)
    length = gaussian_filter1d(length, 20 * _RAYS / 360, mode="wrap")
    rays = np.stack([np.cos(angles), np.sin(angles)], -1)
    places = (middle + length[:, None, None] * radii[:, None] * rays[:, None] - 0.5).astype(np.float32)
    along = cv2.remap(lab, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    edges = np.zeros(along.shape[:2])
    edges[:, 2:-2] = np.linalg.norm(along[:, 4:] - along[:, :-4], axis=-1)
    edges = np.minimum(edges / (np.median(edges) + 1e-6), 3)
    path = _closed_path(_STRAY * np.abs(radii - expected) - edges)
    curve = gaussian_filter1d(length * radii[path], 2, mode="wrap")
    corners = np.round((middle + curve[:, None] * rays - 0.5) * 16).astype(np.int32)
    return cv2.fillPoly(np.zeros(base.shape, np.uint8), [corners], 1, shift=4) > 0


def _closed_path(cost: Float[np.ndarray, "rays steps"], reach: int = 3) -> np.ndarray:
    """Indices of the cheapest way around: one place a ray, neighbours at most `reach` apart. It goes around three times
    and the middle round counts, which closes it."""
    cost = np.concatenate([cost] * 3)
    rays, steps = cost.shape
    back = np.zeros((rays, steps), int)
    sums = cost[0]
    for i in range(1, rays):
        ways = np.full((2 * reach + 1, steps), np.inf)
        for d in range(-reach, reach + 1):
            to, start = slice(max(d, 0), steps + min(d, 0)), slice(max(-d, 0), steps - max(d, 0))
            ways[d + reach, to] = sums[start] + _TURN * d * d
        best = ways.argmin(0)
        back[i] = np.arange(steps) - (best - reach)
        sums = ways[best, np.arange(steps)] + cost[i]
    path = np.empty(rays, int)
    path[-1] = sums.argmin()
    for i in range(rays - 1, 0, -1):
        path[i - 1] = back[i, path[i]]
    return path[rays // 3 : 2 * rays // 3]


# By colour -----------------------------------------------------------------------------------------------------------


def _by_color(picture: np.ndarray, scribble: np.ndarray) -> np.ndarray:
    """Deep inside the scribble's hull is the object, far outside is background, GrabCut divides what lies between."""
    import cv2

    hull = _filled_hull(scribble)
    depth = cv2.distanceTransform(hull.astype(np.uint8), cv2.DIST_L2, 5)
    away = cv2.distanceTransform(1 - hull.astype(np.uint8), cv2.DIST_L2, 5)
    core = (depth > _CORE * depth.max()) & scribble
    if not core.any():
        core = depth > _CORE * depth.max()
    radius = np.sqrt(hull.sum() / np.pi)
    labels = np.where(hull, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[away > _REACH * radius] = cv2.GC_BGD
    labels[core] = cv2.GC_FGD
    if not (labels == cv2.GC_BGD).any():
        return np.zeros_like(hull)
    cv2.setRNGSeed(0)  # it starts from k-means with random centres
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(np.ascontiguousarray(picture), labels, (0, 0, 1, 1), *models, 4, cv2.GC_INIT_WITH_MASK)
    return _tidy(np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)), core, smooth=0.05 * radius)


# Masks ---------------------------------------------------------------------------------------------------------------


def _filled_hull(mask: np.ndarray) -> np.ndarray:
    import cv2

    corners = cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32))
    return cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), corners, 1) > 0


def _window(mask: np.ndarray, margin: int) -> tuple[int, int, int, int]:
    """Bounding box of a mask (x0, y0, x1, y1), widened and cut at the image's border."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    height, width = mask.shape
    x0, y0 = max(columns[0] - margin, 0), max(rows[0] - margin, 0)
    return int(x0), int(y0), int(min(columns[-1] + margin + 1, width)), int(min(rows[-1] + margin + 1, height))


def _tidy(found: np.ndarray, core: np.ndarray, smooth: float) -> np.ndarray:
    """Smooth the outline, keep the parts that hold some of the core, fill their holes."""
    import cv2

    side = 2 * max(int(smooth), 1) + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    mask = np.pad(found, side).astype(np.uint8)
    mask = cv2.morphologyEx(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, disk), cv2.MORPH_OPEN, disk)
    mask = mask[side:-side, side:-side]
    _, parts = cv2.connectedComponents(mask)
    kept = np.isin(parts, np.setdiff1d(np.unique(parts[core]), [0]))
    outlines, _ = cv2.findContours(kept.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(kept.shape, np.uint8), outlines, -1, 1, cv2.FILLED) > 0
