"""The surfaces of transparent bodies, baked from what G-buffers show of them. Bodies are rigid: all frames add to one.

Cameras see few bodies all around. What no frame shows is completed: by the mirror image about planes through the body's
origin, where no frame speaks against it; by going on with a sphere that a part of the surface lies on; by flat lids.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import ConvexHull, KDTree, QhullError

from catacaustics.geometry import normalize, sphere_directions
from catacaustics.refraction.frames import Frame
from catacaustics.shapes import Bool, Float, Int

CELLS = 128
"""Points are thinned to one a cell and side; cells along the longest side of what is seen."""
FEWEST = 200
"""A body of which fewer cells were seen is not baked."""
_WITNESSES = 24
"""Frames, spread evenly, that may speak against a completion."""
_NEAR = 1.5
"""In cells: points nearer than this show the same place."""
_ASIDE = 0.01
"""How far a completed point may lie before what a frame shows, over the body's extent."""
_REFUTED = 0.02
"""A completion is refused where more of its points than this contradict a frame."""
_CONVEX = 5e-4
"""Points of a convex body lie no deeper than this below its hull (99 % of them), over its extent."""
_SMOOTH = np.cos(np.radians(25))
"""A corner whose normal is farther from its face's is on an edge: there the face counts."""
_FLAT = 0.05
"""Normals that more points than this have in common (within 3 degrees) are those of a flat face."""
_FEWEST_CURVED = 12
"""Points that tell a sphere: they and their normals are exact to 1e-4 of the extent."""
_POISSON_DEPTH = 7
_FRAMES = 240
"""Frames that are looked at, spread evenly: more of them show nothing new."""


class Cloud(NamedTuple):
    """Points of a body's surface with their outward unit normals, in the body's coordinates."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]

    def at(self, index: np.ndarray) -> "Cloud":
        return Cloud(self.points[index], self.normals[index])


class Surface(NamedTuple):
    """A closed triangle mesh in the body's coordinates, with a unit normal for shading at every face's corners."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "f 3 3"]


class Sight(NamedTuple):
    """What one frame shows of one body; `to_clip` takes (x_body, 1)."""

    to_clip: Float[np.ndarray, "4 4"]
    mask: Bool[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]


def spread(count: int) -> list[int]:
    """Numbers of the frames that bodies are baked from."""
    return [i * count // min(count, _FRAMES) for i in range(min(count, _FRAMES))]


def bake_bodies(frames: Sequence[Frame]) -> list[Surface | None]:
    """The surfaces of a scene's transparent bodies, None for one of which frames show too little."""
    clouds: list[list[Cloud]] = []
    sights: list[list[Sight]] = []
    for number, frame in enumerate(frames):
        witness = number * _WITNESSES % len(frames) < _WITNESSES
        for body in range(len(frame.object_mask)):
            if body == len(clouds):
                clouds.append([])
                sights.append([])
            mask = frame.object_mask[body]
            if mask.any():
                clouds[body].append(_seen(frame, body))
                if witness:
                    sights[body].append(_sight(frame, body))
    return [bake_body(joined(parts), views) if parts else None for parts, views in zip(clouds, sights, strict=True)]


def bake_body(seen: Cloud, sights: Sequence[Sight]) -> Surface | None:
    """The surface of a body from its seen points, which `sights` may refuse to have completed in some way; None where
    few are seen, or one flat face alone."""
    extent = np.ptp(seen.points, axis=0).max()
    cell = extent / CELLS
    seen = thinned(seen, cell)
    if len(seen.points) < FEWEST:
        return None
    known = mirrored(seen, cell, sights)
    known = with_sphere(known, cell, sights)
    try:
        hull = ConvexHull(known.points)
    except QhullError:
        return None
    if convex(known, hull, extent):
        return _hull_surface(known, hull)
    return _poisson_surface(known, cell)


def _seen(frame: Frame, body: int) -> Cloud:
    """A body's points in one frame, thinned a little."""
    mask, matrix = frame.object_mask[body], frame.object_to_world[body].astype(float)
    size = np.linalg.norm(matrix[:, 0])
    points = (frame.object_position[body][mask] - matrix[:, 3]) @ matrix[:, :3] / size**2
    return Cloud(points, normalize(frame.object_normal[body][mask] @ matrix[:, :3]))


def _sight(frame: Frame, body: int) -> Sight:
    pose = np.vstack([frame.object_to_world[body], [0, 0, 0, 1]]).astype(float)
    clip = frame.world_to_clip.astype(float)
    depth = frame.object_position[body] @ clip[3, :3] + clip[3, 3]
    return make_sight(clip @ pose, frame.object_mask[body], depth)


def make_sight(
    to_clip: Float[np.ndarray, "4 4"], mask: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"]
) -> Sight:
    """The mask grows by a pixel, depths become the nearest neighbour's: a point between pixels belongs to both."""
    return Sight(to_clip, maximum_filter(mask, 3), minimum_filter(np.where(mask, depth, np.inf), 3))


def joined(parts: Sequence[Cloud]) -> Cloud:
    return Cloud(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def thinned(cloud: Cloud, cell: float) -> Cloud:
    """One point for each cell and side that it faces."""
    sides = np.round(cloud.normals).astype(np.int64) + 1
    places = np.floor(cloud.points / cell).astype(np.int64)
    places -= places.min(0)
    key = np.ravel_multi_index((*places.T, *sides.T), (*(places.max(0) + 1), 3, 3, 3))
    return cloud.at(np.unique(key, return_index=True)[1])


# Completion ------------------------------------------------------------------------------------------------------


def refuted(points: Float[np.ndarray, "n 3"], sights: Sequence[Sight], tolerance: float) -> Bool[np.ndarray, "n"]:
    """Points that a frame would have seen beside the body, or in front of it by more than `tolerance` (body units)."""
    wrong = np.zeros(len(points), bool)
    for sight in sights:
        clip = points @ sight.to_clip[:, :3].T + sight.to_clip[:, 3]
        height, width = sight.mask.shape
        depth = np.maximum(clip[:, 3], 1e-6)
        column = np.floor((clip[:, 0] / depth + 1) / 2 * width).astype(int)
        row = np.floor((1 - clip[:, 1] / depth) / 2 * height).astype(int)
        inside = (clip[:, 3] > 1e-6) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        slack = tolerance * np.linalg.norm(sight.to_clip[3, :3])
        wrong |= inside & (~sight.mask[row, column] | (clip[:, 3] < sight.depth[row, column] - slack))
    return wrong


def _additions(known: Cloud, more: Cloud, cell: float, sights: Sequence[Sight]) -> Cloud | None:
    """What `more` tells of places that are not known yet; None where it contradicts what is known or seen."""
    distance, nearest = KDTree(known.points).query(more.points)
    same = distance < _NEAR * cell
    against = (known.normals[nearest] * more.normals).sum(-1) < -0.5
    new = more.at(~same)
    if (same & against).sum() > 0.05 * same.sum():
        return None
    if len(new.points) and refuted(new.points, sights, _ASIDE * CELLS * cell).mean() > _REFUTED:
        return None
    return new


def mirrored(seen: Cloud, cell: float, sights: Sequence[Sight]) -> Cloud:
    """With the mirror images about the planes x = 0, y = 0 and z = 0 that nothing seen contradicts."""
    known = seen
    for axis in range(3):
        flip = np.where(np.arange(3) == axis, -1.0, 1.0)
        new = _additions(known, Cloud(known.points * flip, known.normals * flip), cell, sights)
        known = known if new is None else joined([known, new])
    return known


def with_sphere(known: Cloud, cell: float, sights: Sequence[Sight]) -> Cloud:
    """With the rest of a sphere that a part of the known surface lies on, as far as all that is known lies on the inner
    side of it and of the known surface's tangent planes."""
    found = _find_sphere(known, CELLS * cell)
    if found is None:
        return known
    center, radius = found
    normals = sphere_directions(int(2 * np.pi * (radius / cell) ** 2))
    points = center + radius * normals
    tolerance = 2 * _CONVEX * CELLS * cell
    some = known.at(np.random.default_rng(0).permutation(len(known.points))[:1000])
    within = (points @ some.normals.T - (some.points * some.normals).sum(-1) < tolerance).all(-1)
    more = Cloud(points, normals).at(within)
    outside = np.linalg.norm(known.points - center, axis=-1) > radius + tolerance
    new = _additions(known, more, cell, sights) if len(more.points) and outside.mean() < _REFUTED else None
    return known if new is None else joined([known, new])


def _find_sphere(cloud: Cloud, extent: float) -> tuple[np.ndarray, float] | None:
    """Centre and radius of the sphere that most points beside flat faces lie on, by pairs of points (RANSAC); None
    where no sphere holds half of them."""
    rng = np.random.default_rng(0)
    _, side, count = np.unique(np.round(20 * cloud.normals), axis=0, return_inverse=True, return_counts=True)
    curved = cloud.at(count[side.ravel()] < _FLAT * len(cloud.points))
    if len(curved.points) < _FEWEST_CURVED:
        return None
    i, j = rng.integers(0, len(curved.points), (2, 4000))
    apart = curved.normals[i] - curved.normals[j]
    square = (apart**2).sum(-1)
    radius = ((curved.points[i] - curved.points[j]) * apart).sum(-1) / np.maximum(square, 1e-9)
    centers = curved.points[i] - radius[:, None] * curved.normals[i]
    miss = np.linalg.norm(curved.points[j] - radius[:, None] * curved.normals[j] - centers, axis=-1)
    near = _CONVEX * extent
    fits = np.flatnonzero((square > 0.1) & (miss < near) & (radius > 0.05 * extent) & (radius < 2 * extent))
    some = curved.at(rng.permutation(len(curved.points))[:1000])
    best, most = None, len(some.points) // 2
    for k in fits[:50]:
        way = some.points - centers[k]
        distance = np.linalg.norm(way, axis=-1)
        on = (np.abs(distance - radius[k]) < near) & ((way * some.normals).sum(-1) > 0.999 * distance)
        if on.sum() > most:
            best, most = (centers[k], float(radius[k])), on.sum()
    return best


def convex(known: Cloud, hull: ConvexHull, extent: float) -> bool:
    """Whether the known points lie on their convex hull."""
    some = known.points[np.random.default_rng(0).permutation(len(known.points))[:1000]]
    depth = np.full(len(some), np.inf)
    for plane in np.array_split(hull.equations, max(1, len(hull.equations) // 2000)):
        depth = np.minimum(depth, -(some @ plane[:, :3].T + plane[:, 3]).max(-1))
    return bool(np.quantile(depth, 0.99) < _CONVEX * extent)


# Meshes ----------------------------------------------------------------------------------------------------------


def _hull_surface(known: Cloud, hull: ConvexHull) -> Surface:
    used, faces = np.unique(hull.simplices, return_inverse=True)
    faces, cloud = faces.reshape(-1, 3), known.at(used)
    outward = hull.equations[:, :3]
    faces = np.where(((_face_normals(cloud.points, faces) * outward).sum(-1) < 0)[:, None], faces[:, ::-1], faces)
    return Surface(cloud.points, faces, _corner_normals(cloud.normals[faces], outward))


def _poisson_surface(known: Cloud, cell: float) -> Surface:
    """Screened Poisson reconstruction (Kazhdan and Hoppe 2013), moved onto the tangent planes of the points."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(known.points))
    cloud.normals = o3d.utility.Vector3dVector(known.normals)
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=_POISSON_DEPTH, n_threads=1)
    mesh.compute_vertex_normals()
    vertices, normals = np.array(mesh.vertices), np.array(mesh.vertex_normals)
    faces: np.ndarray = np.array(mesh.triangles)
    found: tuple[np.ndarray, np.ndarray] = KDTree(known.points).query(vertices, k=4)  # pyright: ignore[reportAssignmentType]
    distance, nearest = found
    offset = ((vertices[:, None] - known.points[nearest]) * known.normals[nearest]).sum(-1)
    alike = (known.normals[nearest] * known.normals[nearest[:, :1]]).sum(-1) > _SMOOTH
    weight = alike / np.maximum(distance, 0.1 * cell) ** 2
    weight /= weight.sum(-1, keepdims=True)
    own = distance[:, 0] < 2 * cell
    mean = normalize((weight[..., None] * known.normals[nearest]).sum(1))
    vertices = vertices - np.where(own, (weight * offset).sum(-1), 0)[:, None] * mean
    normals = np.where(own[:, None], mean, normals)
    return Surface(vertices, faces, _corner_normals(normals[faces], _face_normals(vertices, faces)))


def _face_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Unit normals of triangles, to the side from which their corners are seen counter-clockwise."""
    a, b, c = (vertices[corner] for corner in faces.T)
    return normalize(np.cross(b - a, c - a) + 1e-30)


def _corner_normals(normals: Float[np.ndarray, "f 3 3"], faces: Float[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3 3"]:
    """The corners' own normals, or the face's at an edge."""
    smooth = (normals * faces[:, None]).sum(-1) > _SMOOTH
    return np.where(smooth.all(-1)[:, None, None], normals, faces[:, None])
