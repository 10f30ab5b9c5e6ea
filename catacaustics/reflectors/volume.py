"""Reflection volume: painted masks of a reflector, seen by calibrated cameras, bound a convex polyhedron around it.

Each mask's convex hull, lifted through its camera, is a pyramid; the volume is the intersection of the pyramids
(Neural Point Catacaustics, 2022, section 4.2). Every step errs on the large side: the volume holds every object whose
pictures lie inside the masks.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from catacaustics.cameras import Camera, Viewport
from catacaustics.capture.dataset import Capture, View
from catacaustics.errors import UserError
from catacaustics.files import read_json, write_json
from catacaustics.geometry import (
    chebyshev_center,
    hull_mesh,
    intersect_halfspaces,
    is_bounded,
    normalize,
    transform,
)
from catacaustics.points import write_mesh
from catacaustics.shapes import Bool, Float, Int

_SMALLEST = 1e-6
"""Inscribed radius, in units of the cameras' spread, below which an intersection counts as empty."""
_SHOWN, _LOSS = 0.8, 0.1
"""A mask shows only part of the object where it has less than this share of the others' picture of it, and takes at
least this share away from the pictures in two others."""
_WITNESSES, _APART = 6, 25.0
"""Others that it takes to say so, from directions at least so many degrees away."""


class MaskError(UserError):
    """Masks that make no volume.

    Args:
        views: names of the views to look at.
    """

    def __init__(self, found: str, expected: str, remedy: str, views: Sequence[str] = ()):
        self.views = tuple(views)
        super().__init__(found, expected, remedy)


@dataclass(frozen=True, eq=False)
class ReflectionVolume:
    """A convex polyhedron around a reflector.

    Args:
        name: the reflector's name.
        halfspaces: n . x + d <= 0 inside, n of unit length and outward.
        vertices: corners.
        faces: triangles, counter-clockwise seen from outside.
    """

    name: str
    halfspaces: Float[np.ndarray, "k 4"]
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]

    def contains(self, points: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Whether points lie inside or on the surface (to 1e-7 of the radius)."""
        flat = points.reshape(-1, 3)
        inside = np.linalg.norm(flat - self.center, axis=-1) <= (1 + 1e-6) * self.radius
        inside[inside] = self.heights(flat[inside]) <= 1e-7 * self.radius
        return inside.reshape(points.shape[:-1])

    def heights(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """How far points lie outside of the farthest bounding plane, in world units; negative inside the volume."""
        planes = np.ascontiguousarray(self.halfspaces.T)
        lifted, heights = np.c_[points, np.ones(len(points))], np.empty(len(points))
        # In blocks that stay in the processor's cache: ten times as fast as all at once.
        block = np.empty((128, planes.shape[1]))
        for i in range(0, len(points), len(block)):
            part = lifted[i : i + len(block)]
            np.matmul(part, planes, out=block[: len(part)]).max(1, out=heights[i : i + len(part)])
        return heights

    @cached_property
    def _cross(self) -> np.ndarray:
        """Outward normals of the faces, as long as twice their areas."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return np.cross(b - a, c - a)

    @property
    def area(self) -> float:
        """Surface area."""
        return float(np.linalg.norm(self._cross, axis=-1).sum() / 2)

    @cached_property
    def center(self) -> Float[np.ndarray, "3"]:
        """Centre of mass of the solid."""
        middle = self.vertices.mean(0)
        corners = self.vertices[self.faces] - middle
        volumes = (corners[:, 0] * self._cross).sum(-1)  # of the tetrahedra from `middle`, times 6
        return middle + (corners.sum(1) / 4 * volumes[:, None]).sum(0) / volumes.sum()

    @cached_property
    def radius(self) -> float:
        """Radius of the ball about `center` that holds the volume."""
        return float(np.linalg.norm(self.vertices - self.center, axis=-1).max())

    def scaled(self, factor: float) -> "ReflectionVolume":
        """Scaled about its centre."""
        planes = self.halfspaces.copy()
        offset = planes[:, :3] @ self.center
        planes[:, 3] = factor * (planes[:, 3] + offset) - offset
        return ReflectionVolume(self.name, planes, self.center + factor * (self.vertices - self.center), self.faces)

    def moved(
        self, scale: float, rotation: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"], name: str
    ) -> "ReflectionVolume":
        """At x_new = scale * rotation x + shift, under another name."""
        normals = self.halfspaces[:, :3] @ rotation.T
        planes = np.c_[normals, scale * self.halfspaces[:, 3] - normals @ shift]
        return ReflectionVolume(name, planes, scale * self.vertices @ rotation.T + shift, self.faces.copy())

    def sample_surface(
        self, n: int, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Random points, uniform by area, and their outward unit normals."""
        areas = np.linalg.norm(self._cross, axis=-1)
        face = rng.choice(len(areas), n, p=areas / areas.sum())
        u, v = rng.random((2, n, 1))
        root = np.sqrt(u)
        a, b, c = np.moveaxis(self.vertices[self.faces[face]], 1, 0)
        return (1 - root) * a + root * (1 - v) * b + root * v * c, normalize(self._cross[face])

    def project_mask(self, camera: Camera, viewport: Viewport | None = None) -> Bool[np.ndarray, "height width"]:
        """True at pixels whose centres see the volume. Parts behind the camera are cut off; a camera inside the volume
        sees it everywhere."""
        view = viewport or camera.viewport
        if self.contains(camera.center[None])[0]:
            return np.ones((view.height, view.width), bool)
        polygon = self.outline(camera)
        return _fill_convex(polygon - [view.x0, view.y0], view.width, view.height)

    def outline(self, camera: Camera) -> Float[np.ndarray, "n 2"]:
        """Outline in pixels (counter-clockwise corners) of the part in front of the camera; (0, 2) where nothing is.
        It may reach far outside the image."""
        from scipy.spatial import ConvexHull

        points = transform(camera.camera_from_world, self.vertices)
        near = 1e-6 * self.radius
        edges = points[self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)]
        crossing = edges[(edges[:, 0, 2] > near) & (edges[:, 1, 2] <= near)]
        t = (crossing[:, 0, 2] - near) / (crossing[:, 0, 2] - crossing[:, 1, 2])
        cut = crossing[:, 0] + t[:, None] * (crossing[:, 1] - crossing[:, 0])
        seen = np.concatenate([points[points[:, 2] > near], cut])
        if not len(seen):
            return np.zeros((0, 2))
        pixels = seen[:, :2] / seen[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        return pixels[ConvexHull(pixels).vertices]

    def save(self, path: Path) -> None:
        """Write as JSON."""
        parts = {key: getattr(self, key).tolist() for key in ("halfspaces", "vertices", "faces")}
        write_json(path, {"name": self.name, **parts})

    @staticmethod
    def load(path: Path) -> "ReflectionVolume":
        """Read a file written by `save`; raises UserError where it is missing or something else."""
        value = read_json(path)
        try:
            parts = (np.array(value["halfspaces"], float), np.array(value["vertices"], float), np.array(value["faces"]))
            if any(p.ndim != 2 or p.shape[1] != n for p, n in zip(parts, (4, 3, 3), strict=True)):
                raise ValueError("wrong shapes")
            return ReflectionVolume(str(value["name"]), *parts)
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"{path} is not a reflection volume: {error!r}.",
                "name, halfspaces (k, 4), vertices (v, 3) and faces (f, 3)",
                "delete it and build the volume from the masks again",
            ) from error

    def write_mesh(self, path: Path) -> None:
        """Write the surface as a PLY triangle mesh, for mesh viewers."""
        write_mesh(path, self.vertices, self.faces)


def _fill_convex(polygon: np.ndarray, width: int, height: int) -> np.ndarray:
    """Pixels whose centres lie inside a convex polygon (to 1e-6 pixels): for each row, from the leftmost to the
    rightmost crossing. Unlike an integer rasterizer it takes corners far outside the image."""
    if not len(polygon):
        return np.zeros((height, width), bool)
    y = np.arange(height)[:, None] + 0.5
    (x0, y0), (x1, y1) = polygon.T, np.roll(polygon, -1, 0).T
    crosses = (np.minimum(y0, y1) <= y) & (y <= np.maximum(y0, y1)) & (y0 != y1)
    x = x0 + (y - y0) / np.where(y0 != y1, y1 - y0, 1) * (x1 - x0)
    left = np.where(crosses, x, np.inf).min(1, keepdims=True)
    right = np.where(crosses, x, -np.inf).max(1, keepdims=True)
    centers = np.arange(width) + 0.5
    return (left - 1e-6 <= centers) & (centers <= right + 1e-6)


def mask_hull(mask: Bool[np.ndarray, "height width"]) -> Float[np.ndarray, "n 2"]:
    """Convex hull of a mask's pixel squares: corners with positive turn in (x, y)."""
    import cv2

    width = mask.shape[1]
    rows = np.flatnonzero(mask.any(1))
    left, right = mask[rows].argmax(1), width - mask[rows, ::-1].argmax(1)
    corners = [np.stack([x, y], -1) for x in (left, right) for y in (rows, rows + 1)]
    hull = cv2.convexHull(np.concatenate(corners).astype(np.int32))[:, 0].astype(np.float64)
    following = np.roll(hull, -1, 0)
    turn = (hull[:, 0] * following[:, 1] - hull[:, 1] * following[:, 0]).sum()
    return hull if turn >= 0 else hull[::-1]


def _hull_chains(mask: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """A mask's hull, and its outline as chains of corners: one closed chain, or, where it runs along the image's
    border, the open chains between."""
    height, width = mask.shape
    hull = mask_hull(mask)
    following = np.roll(hull, -1, 0)
    border = ((hull == following) & ((hull == 0) | (hull == [width, height]))).any(1)
    if not border.any():
        return hull, [np.concatenate([hull, hull[:1]])]
    order = (np.arange(len(hull)) + np.flatnonzero(border)[0] + 1) % len(hull)
    chains = np.split(hull[order], np.flatnonzero(border[order]) + 1)
    return hull, [chain for chain in chains if len(chain) > 1]


def _outward(edges: np.ndarray) -> np.ndarray:
    """Unit normals of edges (m, 2 ends, 2) of an outline with positive turn."""
    along = edges[:, 1] - edges[:, 0]
    return normalize(np.stack([along[:, 1], -along[:, 0]], -1))


def mask_halfplanes(mask: Bool[np.ndarray, "height width"], tolerance: float = 0.5) -> Float[np.ndarray, "m 3"]:
    """Half-planes a x + b y + c <= 0 (pixels) whose intersection is a simple polygon around a mask.

    The convex hull of the mask's pixel squares is simplified by Douglas-Peucker; then each edge is pushed outwards
    until the whole hull is behind it.

    Where the hull runs along the image's border it makes no half-plane: the object may go on there. The edges that end
    on the border are prolonged outside, where the staircase of pixels would turn them into the object: those shorter
    than 8 pixels are left out, the first longer one is turned outwards by a pixel over its length.

    Args:
        tolerance: of the simplification, in pixels.
    """
    import cv2

    hull, chains = _hull_chains(mask)
    edges = []
    for chain in chains:
        closed = np.array_equal(chain[0], chain[-1])
        points = (chain[:-1] if closed else chain).astype(np.float32)
        corners = cv2.approxPolyDP(points[:, None], tolerance, closed)[:, 0].astype(np.float64)
        if closed:
            if len(corners) < 3:  # the tolerance is wider than the mask
                corners = hull
            edges.append(np.stack([corners, np.roll(corners, -1, 0)], 1))
            continue
        sides = np.stack([corners[:-1], corners[1:]], 1)
        long = np.flatnonzero(np.linalg.norm(sides[:, 1] - sides[:, 0], axis=-1) >= 8)
        if len(long):
            first, last = sides[long[0]].copy(), sides[long[-1]].copy()
            first[0] += _outward(first[None])[0]
            last[1] += _outward(last[None])[0]
            edges.append(np.concatenate([first[None], sides[long[0] + 1 : long[-1]], last[None]]))
    if not edges:
        return np.zeros((0, 3))
    normals = _outward(np.concatenate(edges))
    return np.concatenate([normals, -(hull @ normals.T).max(0)[:, None]], -1)


def lift_halfplanes(camera: Camera, halfplanes: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "k 4"]:
    """The pyramid over a polygon in the image: half-spaces in world coordinates, the last one "in front of the
    camera"."""
    local = np.concatenate([halfplanes @ camera.intrinsics, [[0, 0, -1]]])
    local = normalize(local)
    return np.concatenate([local @ camera.camera_from_world[:3, :3], local @ camera.camera_from_world[:3, 3:]], -1)


def _check_mask(name: str, camera: Camera, mask: np.ndarray, view: str) -> None:
    def refuse(found: str, remedy: str) -> None:
        raise MaskError(
            f"The mask of {name} in view {view} {found}.", "a mask that outlines the object", remedy, [view]
        )

    if mask.shape != (camera.height, camera.width):
        size = f"{mask.shape[1]} x {mask.shape[0]} pixels, its photograph {camera.width} x {camera.height}"
        refuse(f"has {size}", "paint it on the undistorted photograph")
    if not mask.any():
        refuse("is all black", "paint the object white, or delete the file where the object is not seen")
    if mask.all():
        refuse("is all white", "paint only the object white, or delete the file")


def _conflicting(names: list[str], groups: list[np.ndarray]) -> list[str]:
    """Views to blame for an empty intersection: each that alone, left out, mends it; where there is none, a small set
    that mends it together."""
    from scipy.optimize import linprog

    def meet(chosen: list[int]) -> bool:
        return bool(chosen) and chebyshev_center(np.concatenate([groups[i] for i in chosen]))[1] > _SMALLEST

    everyone = list(range(len(groups)))
    blamed = [i for i in everyone if meet([j for j in everyone if j != i])]
    if not blamed:
        # The point with the smallest sum of violations satisfies most views; take back those that fit in with them.
        view = np.repeat(everyone, [len(g) for g in groups])
        planes = np.concatenate(groups)
        matrix = np.concatenate([planes[:, :3], -np.eye(len(groups))[view]], -1)
        bounds = [(None, None)] * 3 + [(0, None)] * len(groups)
        objective = np.r_[np.zeros(3), np.ones(len(groups))]
        slack = linprog(objective, A_ub=matrix, b_ub=-planes[:, 3], bounds=bounds, method="highs").x[3:]
        kept = [i for i in everyone if slack[i] <= _SMALLEST]
        for i in np.argsort(slack)[len(kept) :].tolist():
            if meet([*kept, i]):
                kept.append(i)
        blamed = [i for i in everyone if i not in kept]
    return [names[i] for i in blamed]


def _listed(names: list[str], most: int = 6) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def volume_from_masks(
    name: str, masks: list[tuple[str, Camera, Bool[np.ndarray, "height width"]]], tolerance: float = 0.5
) -> ReflectionVolume:
    """Intersect the pyramids over masks.

    A mask may have several parts (something stands in front of the object): its hull counts. Where a mask touches the
    image's border the object is taken to go on outside, so that other views must bound it there.

    Args:
        name: the reflector's name, for messages.
        masks: (view name, camera, mask) of 2 or more views; 3 or 4 from well separated directions are enough.
        tolerance: of the outline's simplification, in pixels.

    Raises:
        MaskError: a mask is unusable, the masks contradict each other, or they leave the volume open; the message
            names the views to repaint.
    """
    if not masks:
        raise MaskError(
            f"The reflector {name} has no masks.", "masks in 3 or 4 views", "paint them in the mask painter"
        )
    views = [view for view, _, _ in masks]
    for view, camera, mask in masks:
        _check_mask(name, camera, mask, view)
    groups = [lift_halfplanes(camera, mask_halfplanes(mask, tolerance)) for _, camera, mask in masks]

    # Linear programming needs numbers near 1: put the origin amid the cameras, and their spread to 1.
    centers = np.array([camera.center for _, camera, _ in masks])
    origin = centers.mean(0)
    spread = np.linalg.norm(centers - origin, axis=-1).max()
    scale = spread if spread > 1e-12 * (1 + np.abs(origin).max()) else 1.0
    groups = [np.c_[g[:, :3], (g[:, 3] + g[:, :3] @ origin) / scale] for g in groups]
    planes = np.concatenate(groups)

    inside, radius = chebyshev_center(planes)
    if radius <= _SMALLEST:
        blamed = _conflicting(views, groups)
        raise MaskError(
            f"The masks of {name} contradict each other: no point in space is inside all {len(masks)}.",
            "masks of the same object, around all of it, and correctly calibrated views",
            f"repaint or delete the masks of {_listed(blamed)}",
            blamed,
        )
    bounded = np.isfinite(radius) and is_bounded(planes[:, :3])
    vertices, active = intersect_halfspaces(planes, inside) if bounded else (np.full((1, 3), np.inf), np.arange(0))
    if np.abs(vertices).max() > 1e4:
        raise MaskError(
            f"The masks of {name} leave its volume open: the object could reach to infinity as seen from "
            f"{_listed(views)}.",
            "masks in 3 or 4 views from clearly different directions, clear of the image border in most",
            f"paint {name} in another view, from the side of those{_border_hint(views, masks)}",
            views,
        )
    vertices, faces = hull_mesh(vertices * scale + origin)
    kept = planes[active]
    halfspaces = np.c_[kept[:, :3], kept[:, 3] * scale - kept[:, :3] @ origin]
    return ReflectionVolume(name, halfspaces, vertices, faces)


def partly_hidden(masks: list[tuple[str, Camera, Bool[np.ndarray, "height width"]]]) -> list[str]:
    """Names of the views where something stands before the object: their masks show only part of it, and would cut the
    rest off its volume.

    Such a mask is smaller than the others' volume there, and takes away what two others show. Masks from nearby
    directions are no witnesses, as the same thing may stand before them; where there are too few, or the rest makes no
    volume, none is named. Found one by one, the smallest first.
    """
    found: list[str] = []
    masks = list(masks)
    while len(masks) > _WITNESSES:
        try:
            hidden = _most_hidden(masks, volume_from_masks("", masks))
        except MaskError:
            return found[:-1]
        if hidden is None:
            break
        found.append(masks.pop(hidden)[0])
    return found


def _most_hidden(masks: list[tuple[str, Camera, np.ndarray]], volume: ReflectionVolume) -> int | None:
    surface = volume.sample_surface(20_000, np.random.default_rng(0))[0]
    spread = 2 * np.cbrt(np.linspace(0, 1, len(surface)))[:, None]
    points = volume.center + spread * (surface - volume.center)  # stand for the volumes of some of the masks
    planes = [lift_halfplanes(camera, mask_halfplanes(mask)) for _, camera, mask in masks]
    outside = np.stack([(points @ p[:, :3].T + p[:, 3] > 0).any(1) for p in planes])
    rays = normalize(np.stack([camera.center - volume.center for _, camera, _ in masks]))
    apart = rays @ rays.T < np.cos(np.radians(_APART))
    shares, left = np.ones(len(masks)), {}
    for i in np.flatnonzero(apart.sum(1) >= _WITNESSES):
        left[i] = ~outside[apart[i]].any(0)
        whole = _picture_area(points[left[i]], masks[i][1])
        shares[i] = _picture_area(points[left[i]], *masks[i][1:]) / whole if whole else 1.0
    for i in np.argsort(shares):
        if shares[i] >= _SHOWN:
            return None
        rest = left[i]
        kept = points[rest & ~outside[i]]
        witnesses = [masks[j][1:] for j in np.flatnonzero(apart[i])]
        losses = sorted(1 - _picture_area(kept, *w) / max(_picture_area(points[rest], *w), 1.0) for w in witnesses)
        if losses[-2] > _LOSS:
            return int(i)
    return None


def _picture_area(points: np.ndarray, camera: Camera, mask: np.ndarray | None = None) -> float:
    """Pixels in the image, and in a mask's hull, that the convex hull of points covers; 0 where some are behind."""
    import cv2

    pixels, depth = camera.project(points)
    if len(points) < 3 or (depth <= 0).any():
        return 0.0
    corners = [[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]]
    frame = np.array(corners) if mask is None else mask_hull(mask)
    return cv2.intersectConvexConvex(cv2.convexHull(pixels.astype(np.float32)), frame.astype(np.float32))[0]


def _border_hint(views: list[str], masks: list[tuple[str, Camera, np.ndarray]]) -> str:
    touching = [v for v, (_, _, m) in zip(views, masks, strict=True) if m[[0, -1]].any() or m[:, [0, -1]].any()]
    return f"; the masks of {_listed(touching)} touch the image border and are open there" if touching else ""


def volume_views(capture: Capture, masked: Collection[str]) -> list[View]:
    """Of the views with these names, those whose masks make a volume: the training views, or all where fewer than 3
    training views are among them."""
    chosen = [v for v in capture.train if v.name in masked]
    return chosen if len(chosen) >= 3 else [v for v in capture.views if v.name in masked]


def build_volume(capture: Capture, reflector: str) -> ReflectionVolume:
    """The volume of one of a capture's reflectors, from its masks in `volume_views` but those that are
    `partly_hidden`, which it prints; raises as `volume_from_masks`."""
    if reflector not in capture.reflectors:
        raise UserError(
            f"The capture {capture.root} has no masks of a reflector {reflector}.",
            f"one of: {', '.join(capture.reflectors) or 'none yet'}",
            f"paint masks: `catacaustics mask {capture.root}`",
        )
    masks, hidden = _whole_masks(capture, reflector)
    if hidden:
        print(
            f"volume: {reflector}'s masks in {_listed(hidden)} show less of it than the others agree on (something "
            "stands before it?); left out"
        )
    return volume_from_masks(reflector, masks)


def volume_masks(capture: Capture, reflector: str) -> list[tuple[str, Camera, Bool[np.ndarray, "height width"]]]:
    """Names, cameras and masks that the volume of one of a capture's reflectors is made of: those of `volume_views`
    that show all of it."""
    return _whole_masks(capture, reflector)[0]


def _whole_masks(capture: Capture, reflector: str) -> tuple[list[tuple[str, Camera, np.ndarray]], list[str]]:
    """The masks that show all of a reflector, and the names of the others."""
    masked = {v.name for v in capture.views if capture.mask_path(v, reflector).is_file()}
    painted = [(v.name, v.camera, capture.mask(v, reflector)) for v in volume_views(capture, masked)]
    masks = [(name, camera, mask) for name, camera, mask in painted if mask is not None]
    hidden = partly_hidden(masks)
    return [m for m in masks if m[0] not in hidden], hidden


def write_volume(capture: Capture, volume: ReflectionVolume) -> None:
    """Write a volume beside the masks, for viewers and editors: volumes/NAME.json and .ply."""
    volume.save(capture.root / "volumes" / f"{volume.name}.json")
    volume.write_mesh(capture.root / "volumes" / f"{volume.name}.ply")
