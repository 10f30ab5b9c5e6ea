"""Meshes of the scenes, all generated: rooms, solids of revolution, prisms, bodies from distance functions, an atlas.

World z is up. Texture coordinates have (0, 0) at the texture's top left corner and v running down. Faces run
counter-clockwise seen from where the normal points.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from catacaustics.geometry import normalize
from catacaustics.shapes import Float, Int

Vector = Sequence[float | int] | np.ndarray


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with vertex normals and texture coordinates."""

    vertices: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    faces: Int[np.ndarray, "m 3"]

    def moved(self, rotation: Float[np.ndarray, "3 3"], center: Float[np.ndarray, "3"], size: float) -> "Mesh":
        """Scaled, turned, then moved."""
        return replace(self, vertices=size * self.vertices @ rotation.T + center, normals=self.normals @ rotation.T)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.uv for m in meshes]),
        np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)]),
    )


def _outward(mesh: Mesh) -> Mesh:
    """With faces that run counter-clockwise about their normals; triangles without area are dropped."""
    corner = mesh.vertices[mesh.faces]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    turned = (across * mesh.normals[mesh.faces].mean(1)).sum(-1) < 0
    faces = np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)
    return replace(mesh, faces=faces[(across**2).sum(-1) > 1e-20])


def lattice(points: Float[np.ndarray, "r c 3"], normals: Float[np.ndarray, "r c 3"]) -> Mesh:
    """A sheet of rows x columns vertices, its texture stretched evenly over it."""
    rows, columns = points.shape[:2]
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return _outward(Mesh(points.reshape(-1, 3), normals.reshape(-1, 3), uv, faces))


def sheet(
    top_left: Vector,
    right: Vector,
    down: Vector,
    window: Vector = (0, 0, 1, 1),
) -> Mesh:
    """A flat rectangle seen from its front, with a window (u0, v0, u1, v1) of its texture."""
    o, r, d = (np.asarray(v, float) for v in (top_left, right, down))
    points = np.stack([np.stack([o, o + r]), np.stack([o + d, o + r + d])])
    mesh = lattice(points, np.broadcast_to(normalize(np.cross(d, r)), points.shape))
    low, high = np.array(window[:2]), np.array(window[2:])
    return replace(mesh, uv=low + (high - low) * mesh.uv)


def floor(half: float = 1.0) -> Mesh:
    return sheet([-half, half, 0], [2 * half, 0, 0], [0, -2 * half, 0])


def ceiling(half: float = 1.0) -> Mesh:
    return sheet([-half, -half, 0], [2 * half, 0, 0], [0, 2 * half, 0])


def walls(half: float = 1.0, height: float = 2.0) -> Mesh:
    """The four walls of a room seen from inside: one strip, from the front (-y) corner at -x clockwise: left, back,
    right, front. It stands on z = 0."""
    corners = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1], [-1, -1]]) * half
    parts = []
    for k in range(4):
        a, b = corners[k], corners[k + 1]
        parts.append(sheet([*a, height], [*(b - a), 0], [0, 0, -height], (k / 4, 0, (k + 1) / 4, 1)))
    return joined(parts)


def round_wall(radius: float = 1.0, height: float = 2.0, columns: int = 256) -> Mesh:
    """The wall of a round room seen from inside, standing on z = 0; u runs clockwise from -y."""
    angle = -np.pi / 2 - np.linspace(0, 2 * np.pi, columns + 1)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
    points = radius * np.stack([ring, ring]) + np.array([0, 0, height])[None, None] * np.array([1, 0])[:, None, None]
    return lattice(points, np.stack([-ring, -ring]))


def lathe(profile: Float[np.ndarray, "n 2"], normals: Float[np.ndarray, "n 2"], columns: int = 192) -> Mesh:
    """A solid of revolution about z: rows (radius, z) from top to bottom with their outward normals."""
    angle = np.linspace(0, 2 * np.pi, columns + 1)
    angle[-1] = 0.0  # the seam closes exactly
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    points, directions = (
        np.concatenate([v[:, None, :1] * ring, np.broadcast_to(v[:, None, 1:], (len(v), columns + 1, 1))], -1)
        for v in (profile, normals)
    )
    return lattice(points, directions)


def egg(rows: int = 128) -> Mesh:
    """An egg of height 2 about the origin: an ellipsoid whose upper part is drawn out."""
    t = np.linspace(0, np.pi, rows)
    z, taper = np.cos(t), 0.74 - 0.12 * np.cos(t)
    radius = taper * np.sin(t)
    slope = np.stack([0.12 * np.sin(t) ** 2 + taper * np.cos(t), -np.sin(t)], -1)
    return lathe(np.stack([radius, z], -1), normalize(np.stack([-slope[:, 1], slope[:, 0]], -1)))


def hemisphere(rows: int = 96) -> Mesh:
    """The half z >= 0 of the unit sphere, closed by a flat disk that faces down."""
    t = np.linspace(0, np.pi / 2, rows)
    dome = np.stack([np.sin(t), np.cos(t)], -1)
    dome[-1, 1] = 0.0
    base = np.array([[1.0, 0.0], [0.0, 0.0]])
    return joined([lathe(dome, dome), lathe(base, np.array([[0.0, -1.0], [0.0, -1.0]]))])


def drum(columns: int = 128, height: float = 2.0) -> Mesh:
    """A closed cylinder of radius 1 about the origin. The texture's upper three quarters go around it, its lowest
    quarter holds the caps."""
    half = height / 2
    side = lathe(np.array([[1.0, half], [1.0, -half]]), np.array([[1.0, 0.0], [1.0, 0.0]]), columns)
    side = replace(side, uv=side.uv * [1, 0.75])
    caps = []
    for sign, u in ((1.0, 0.125), (-1.0, 0.375)):
        rows = np.array([[0.0, sign * half], [1.0, sign * half]])
        cap = lathe(rows, np.array([[0.0, sign], [0.0, sign]]), columns)
        caps.append(replace(cap, uv=np.array([u, 0.875]) + 0.12 * cap.vertices[:, :2]))
    return joined([side, *caps])


def prism(polygon: Float[np.ndarray, "n 2"], depth: float) -> Mesh:
    """A right prism over a convex polygon (x, z), counter-clockwise, which runs along y from -depth/2 to depth/2."""
    n, half = len(polygon), depth / 2
    front = np.insert(polygon, 1, -half, axis=1)
    back = np.insert(polygon, 1, half, axis=1)
    parts = []
    for ring, y in ((front, -1.0), (back, 1.0)):
        fan = np.array([[0, i, i + 1] for i in range(1, n - 1)])
        normals = np.broadcast_to([0, y, 0], (n, 3))
        parts.append(_outward(Mesh(ring, normals.astype(float), np.zeros((n, 2)), fan)))
    for k in range(n):
        a, b = front[k], front[(k + 1) % n]
        points = np.stack([np.stack([a, b]), np.stack([a, b]) + [0, depth, 0]])
        normal = normalize(np.array([b[2] - a[2], 0, a[0] - b[0]]))
        parts.append(lattice(points, np.broadcast_to(normal, points.shape)))
    return joined(parts)


def box(width: float, depth: float, height: float) -> Mesh:
    """A box about the origin."""
    x, z = width / 2, height / 2
    return prism(np.array([[-x, -z], [x, -z], [x, z], [-x, z]]), depth)


Distance = Callable[[np.ndarray], np.ndarray]
"""Signed distance (or nearly so), negative inside, of points (n, 3)."""


def smooth_union(blend: float, *parts: np.ndarray) -> np.ndarray:
    """Union of signed distances with rounded seams: a polynomial minimum over `blend`."""
    total = parts[0]
    for part in parts[1:]:
        h = np.clip(0.5 + 0.5 * (part - total) / blend, 0, 1)
        total = part + (total - part) * h - blend * h * (1 - h)
    return total


def ellipsoid(points: np.ndarray, center: Vector, radii: Vector) -> np.ndarray:
    """Nearly the signed distance of an ellipsoid."""
    p = points - np.asarray(center)
    scaled, steep = p / np.asarray(radii), p / np.square(radii)
    k0, k1 = np.linalg.norm(scaled, axis=-1), np.linalg.norm(steep, axis=-1)
    return k0 * (k0 - 1) / np.maximum(k1, 1e-9)


def capsule(points: np.ndarray, a: Vector, b: Vector, thick: float, thin: float) -> np.ndarray:
    """Distance of a rod from a to b whose radius goes from `thick` to `thin`."""
    start, along = np.asarray(a, float), np.asarray(b, float) - np.asarray(a, float)
    t = np.clip((points - start) @ along / (along @ along), 0, 1)
    return np.linalg.norm(points - start - t[:, None] * along, axis=-1) - (thick + (thin - thick) * t)


def body(distance: Distance, low: Vector, high: Vector, cells: int = 64) -> Mesh:
    """The surface of a distance function: surface nets (Gibson, MICCAI 1998), then moved onto the zero level.

    Args:
        low, high: corners of a box that holds the body.
        cells: along the longest side of the box. Normals are the function's gradient.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    step = (high - low).max() / cells
    count = np.ceil((high - low) / step).astype(int) + 1
    grid = np.stack(np.meshgrid(*[low[i] + step * np.arange(count[i]) for i in range(3)], indexing="ij"), -1)
    value = distance(grid.reshape(-1, 3)).reshape(count)
    corners = np.array([[i >> 2, i >> 1 & 1, i & 1] for i in range(8)])
    inside = np.stack([_window(value < 0, c) for c in corners], -1)
    crossed = inside.any(-1) & ~inside.all(-1)
    index = np.full(crossed.shape, -1)
    index[crossed] = np.arange(crossed.sum())
    vertices = low + step * (np.argwhere(crossed) + 0.5)
    for _ in range(8):  # Newton's method along the gradient
        gradient = _gradient(distance, vertices, 0.1 * step)
        square = np.maximum((gradient**2).sum(-1), 1e-12)
        vertices = vertices - np.clip(distance(vertices) / square, -step, step)[:, None] * gradient
    normals = normalize(_gradient(distance, vertices, 0.1 * step))
    return Mesh(vertices, normals, np.zeros((len(vertices), 2)), _net_faces(value < 0, index))


def _window(values: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Values at one corner of every cell."""
    return values[tuple(slice(c, s - 1 + c) for c, s in zip(corner, values.shape, strict=True))]


def _gradient(distance: Distance, points: np.ndarray, step: float) -> np.ndarray:
    moves = step * np.eye(3)
    return np.stack([distance(points + m) - distance(points - m) for m in moves], -1) / (2 * step)


def _net_faces(inside: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Two triangles for every grid edge that crosses the surface, between the four cells around it."""
    faces = []
    for axis in range(3):
        swapped, cells = np.moveaxis(inside, axis, 0), np.moveaxis(index, axis, 0)
        edges = np.argwhere(swapped[:-1, 1:-1, 1:-1] != swapped[1:, 1:-1, 1:-1])
        i, j, k = edges.T
        quad = np.stack([cells[i, j, k], cells[i, j + 1, k], cells[i, j + 1, k + 1], cells[i, j, k + 1]], -1)
        leaves = swapped[:-1, 1:-1, 1:-1][i, j, k] != (axis == 1)  # x, z, the axes left of y, are left-handed about it
        quad = np.where(leaves[:, None], quad, quad[:, ::-1])
        faces += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return np.concatenate(faces)


def charted(mesh: Mesh, charts: int, seed: int) -> tuple[Mesh, int]:
    """The mesh with a deliberately discontinuous atlas: patches of it, turned at random, in cells of random order.

    Faces go to the nearest of `charts` scattered seeds on the same side of the body and are projected flat; all
    charts have one scale, and no two neighbours in space are neighbours in the texture unless by chance. The patches
    fill cells of a square grid. Returns the mesh and the number of cells along a side of the texture.
    """
    rng = np.random.default_rng(seed)
    centers, normals = mesh.vertices[mesh.faces].mean(1), normalize(mesh.normals[mesh.faces].mean(1))
    size = np.ptp(mesh.vertices, axis=0).max()
    features = np.concatenate([centers / size, 0.5 * normals], -1)
    seeds = features[_scattered(features, charts, rng)]
    chart = np.argmin(((features[:, None] - seeds[None]) ** 2).sum(-1), 1)
    side = int(np.ceil(np.sqrt(charts)))
    cells = rng.permutation(side * side)
    flats, reach = [], 0.0
    for c in range(charts):
        faces = mesh.faces[chart == c]
        used, faces = np.unique(faces, return_inverse=True)
        flat = _projected(mesh.vertices[used], normalize(normals[chart == c].mean(0)), rng.uniform(0, 2 * np.pi))
        reach = max(reach, float(np.abs(flat).max(initial=0)))
        flats.append((used, flat, faces.reshape(-1, 3)))
    parts = []
    for c, (used, flat, faces) in enumerate(flats):
        cell = np.array([cells[c] % side, cells[c] // side])
        uv = (cell + 0.5 + 0.48 * flat / reach) / side
        parts.append(Mesh(mesh.vertices[used], mesh.normals[used], uv, faces))
    return joined(parts), side


def _scattered(features: np.ndarray, count: int, rng: np.random.Generator) -> list[int]:
    """Farthest-point sampling."""
    chosen = [int(rng.integers(len(features)))]
    nearest = np.full(len(features), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, ((features - features[chosen[-1]]) ** 2).sum(-1))
        chosen.append(int(nearest.argmax()))
    return chosen


def _projected(points: np.ndarray, normal: np.ndarray, turn: float) -> np.ndarray:
    """Points on the plane across `normal`, turned, about the middle of their bounding box."""
    helper = np.eye(3)[np.abs(normal).argmin()]
    x = normalize(np.cross(normal, helper))
    axes = np.stack([x, np.cross(normal, x)])
    flat = points @ axes.T @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return flat - (flat.min(0) + flat.max(0)) / 2
