"""Textured surfaces as triangle meshes, and their merging into one mesh with one texture atlas.

One mesh with one atlas renders much faster than hundreds of shapes with a texture each.
World units are metres, z is up.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from catacaustics.geometry import normalize
from catacaustics.shapes import Float, Int, UInt8

Vector = Sequence[float] | np.ndarray
Texture = Callable[[int, int], np.ndarray]
"""Draws a texture of (height, width) pixels."""

DENSITY = 240.0
"""Texels a metre of furniture; walls and floors pass their own."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with vertex normals and texture coordinates; v runs down the texture, (0, 0) is its top left.

    `lattice` is the number of rows and columns where the vertices are a lattice, evenly spread over the texture.
    """

    vertices: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    faces: Int[np.ndarray, "m 3"]
    lattice: tuple[int, int] | None = None

    def moved(self, center: Vector, yaw: float = 0.0, tilt: float = 0.0) -> "Mesh":
        """Tilted about x, turned about z (radians), then moved."""
        ct, st, cy, sy = np.cos(tilt), np.sin(tilt), np.cos(yaw), np.sin(yaw)
        rotation = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
        return replace(
            self, vertices=self.vertices @ rotation.T + np.asarray(center), normals=self.normals @ rotation.T
        )

    def turned_over(self) -> "Mesh":
        """The same surface with its front where its back was."""
        return replace(self, normals=-self.normals, faces=self.faces[:, ::-1])


@dataclass(frozen=True, eq=False)
class Surface:
    """A diffuse mesh and its sRGB texture."""

    mesh: Mesh
    texture: UInt8[np.ndarray, "height width 3"]

    def points(
        self, rows: int, columns: int
    ) -> tuple[Float[np.ndarray, "rows columns 3"], Float[np.ndarray, "rows columns 3"]]:
        """Positions and unit normals at the centres of rows x columns equal cells of the texture."""
        assert self.mesh.lattice is not None, "a textured surface is one lattice"
        r, c = self.mesh.lattice
        v, u = (np.arange(rows) + 0.5) / rows * (r - 1), (np.arange(columns) + 0.5) / columns * (c - 1)
        i, j = v.astype(int), u.astype(int)
        a, b = (v - i)[:, None, None], (u - j)[None, :, None]
        found = []
        for values in (self.mesh.vertices, self.mesh.normals):
            grid = values.reshape(r, c, 3)
            upper = (1 - b) * grid[i][:, j] + b * grid[i][:, j + 1]
            lower = (1 - b) * grid[i + 1][:, j] + b * grid[i + 1][:, j + 1]
            found.append((1 - a) * upper + a * lower)
        return found[0], normalize(found[1])

    def moved(self, center: Vector, yaw: float = 0.0, tilt: float = 0.0) -> "Surface":
        return Surface(self.mesh.moved(center, yaw, tilt), self.texture)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.uv for m in meshes]),
        np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)]),
    )


def _lattice(points: np.ndarray, normals: np.ndarray, rows: int, columns: int) -> Mesh:
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    corner = points.reshape(-1, 3)[faces]
    geometric = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    turned = (geometric * normals.reshape(-1, 3)[faces].mean(1)).sum(-1) < 0
    faces[turned] = faces[turned][:, ::-1]
    keep = (geometric**2).sum(-1) > 1e-24  # triangles at a pole have no area
    return Mesh(
        points.reshape(-1, 3), normals.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2), faces[keep], (rows, columns)
    )


def sheet(top_left: Vector, right: Vector, down: Vector) -> Mesh:
    """A flat rectangle seen from its front: its top left corner and the vectors along its top and left edges."""
    o, r, d = (np.asarray(v, float) for v in (top_left, right, down))
    normal = np.broadcast_to(normalize(np.cross(d, r)), (4, 3))
    uv = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    return Mesh(np.stack([o, o + r, o + d, o + r + d]), normal.copy(), uv, np.array([[0, 2, 1], [1, 2, 3]]), (2, 2))


def panel(
    top_left: Vector,
    right: Vector,
    down: Vector,
    texture: Texture,
    density: float = DENSITY,
) -> Surface:
    """A flat rectangle with a texture drawn at `density` texels a metre."""
    height, width = (max(int(density * np.linalg.norm(v)), 8) for v in (down, right))
    return Surface(sheet(top_left, right, down), texture(height, width))


def box(
    center: Vector,
    size: Vector,
    texture: Texture,
    yaw: float = 0.0,
    density: float = DENSITY,
    front: Texture | None = None,
) -> list[Surface]:
    """A box standing on `center` (middle of its underside). Every face has its own texture; `front` is the -y face."""
    x, y, z = np.asarray(size, float) / (2, 2, 1)
    faces = [
        ([-x, -y, z], [2 * x, 0, 0], [0, 0, -z], front or texture),
        ([x, y, z], [-2 * x, 0, 0], [0, 0, -z], texture),
        ([x, -y, z], [0, 2 * y, 0], [0, 0, -z], texture),
        ([-x, y, z], [0, -2 * y, 0], [0, 0, -z], texture),
        ([-x, y, z], [2 * x, 0, 0], [0, -2 * y, 0], texture),
        ([-x, -y, 0], [2 * x, 0, 0], [0, 2 * y, 0], texture),
    ]
    return [panel(corner, right, down, draw, density).moved(center, yaw) for corner, right, down, draw in faces]


def revolved(profile: Float[np.ndarray, "k 2"], segments: int = 64) -> Mesh:
    """A surface of revolution about z through (radius, height) points; the outside is on the right of the profile's
    direction (a profile that runs downwards at positive radius faces outwards)."""
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    radius, height = np.asarray(profile, float).T
    tangent = np.gradient(np.stack([radius, height], -1), axis=0, edge_order=2 if len(radius) > 2 else 1)
    across = normalize(np.stack([-tangent[:, 1], tangent[:, 0]], -1))
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    shape = (len(radius), segments + 1)
    points = np.concatenate([radius[:, None, None] * ring, np.broadcast_to(height[:, None, None], (*shape, 1))], -1)
    normals = np.concatenate([across[:, :1, None] * ring, np.broadcast_to(across[:, 1:, None], (*shape, 1))], -1)
    return _lattice(points, normalize(normals), *shape)


def ellipsoid(radii: Vector, rows: int = 48, segments: int = 96, polar: tuple[float, float] = (0.0, np.pi)) -> Mesh:
    """An ellipsoid about the origin with exact normals, or the zone of it between two angles from the z axis."""
    p, a = np.meshgrid(np.linspace(*polar, rows + 1), np.linspace(0, 2 * np.pi, segments + 1), indexing="ij")
    unit = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], -1)
    return _lattice(unit * radii, normalize(unit / np.asarray(radii)), rows + 1, segments + 1)


def bent_sheet(radius: float, arc: float, height: float, segments: int = 256) -> Mesh:
    """Part of an upright cylinder about the z axis, its middle at +x, `arc` radians long; the front is convex."""
    angle = np.linspace(-arc / 2, arc / 2, segments + 1)
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], -1)
    rows = np.stack([radius * normals + np.array([0, 0, h]) for h in np.linspace(height, 0, 9)])
    return _lattice(rows, np.broadcast_to(normals, rows.shape), *rows.shape[:2])


def tube(path: Float[np.ndarray, "k 3"], radius: Float[np.ndarray, "k"], segments: int = 32) -> Mesh:
    """A round tube along a curve that stays in a plane through the z axis."""
    tangent = normalize(np.gradient(path, axis=0, edge_order=2))
    side = normalize(np.cross(tangent[len(path) // 2], path[-1] - path[0] + np.array([1e-6, 2e-6, 3e-6])))
    side = normalize(side - tangent * (tangent @ side)[:, None])
    other = np.cross(tangent, side)
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    spokes = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * other[:, None]
    points = path[:, None] + spokes * radius[:, None, None]
    slope = np.gradient(radius) / np.linalg.norm(np.gradient(path, axis=0), axis=1)
    normals = normalize(spokes - (slope[:, None] * tangent)[:, None])
    return _lattice(points, normals, len(path), segments + 1)


def with_texture(mesh: Mesh, texture: Texture, height: float, width: float, density: float = DENSITY) -> Surface:
    """A mesh with a texture for a surface of about height x width metres."""
    return Surface(mesh, texture(max(int(density * height), 8), max(int(density * width), 8)))


def packed(surfaces: Sequence[Surface], atlas_width: int = 4096) -> tuple[list[tuple[int, int]], int]:
    """Places (left, top) of the surfaces' textures in one atlas and its height: on shelves, tallest first, with a
    border of one texel around each."""
    x = y = shelf = 0
    places = [(0, 0)] * len(surfaces)
    for i in sorted(range(len(surfaces)), key=lambda i: -surfaces[i].texture.shape[0]):
        h, w = surfaces[i].texture.shape[:2]
        if w + 2 > atlas_width:
            raise ValueError(f"A texture is {w} texels wide; the atlas has {atlas_width}")
        if x + w + 2 > atlas_width:
            x, y, shelf = 0, y + shelf, 0
        places[i] = (x + 1, y + 1)
        x, shelf = x + w + 2, max(shelf, h + 2)
    return places, y + shelf


def merged(surfaces: Sequence[Surface], atlas_width: int = 4096) -> Mesh:
    """The surfaces as one mesh whose texture coordinates point into the atlas of `packed`."""
    places, height = packed(surfaces, atlas_width)
    moved = []
    for surface, place in zip(surfaces, places, strict=True):
        h, w = surface.texture.shape[:2]
        moved.append(replace(surface.mesh, uv=(surface.mesh.uv * (w, h) + place) / (atlas_width, height)))
    return joined(moved)


def atlas(surfaces: Sequence[Surface], textures: Sequence[np.ndarray], atlas_width: int = 4096) -> np.ndarray:
    """One image (height, atlas_width, 3) with a texture for each surface in its place, edges repeated by a texel."""
    places, height = packed(surfaces, atlas_width)
    image = np.zeros((height, atlas_width, 3), textures[0].dtype)
    for (left, top), texture in zip(places, textures, strict=True):
        h, w = texture.shape[:2]
        image[top - 1 : top + h + 1, left - 1 : left + w + 1] = np.pad(texture, ((1, 1), (1, 1), (0, 0)), "edge")
    return image


def ply_bytes(mesh: Mesh) -> bytes:
    """A mesh as binary PLY: x y z nx ny nz and triangles."""
    import io

    from plyfile import PlyData, PlyElement

    vertices = np.concatenate([mesh.vertices, mesh.normals], -1).astype("<f4")
    names = ("x", "y", "z", "nx", "ny", "nz")
    table = vertices.view([(n, "<f4") for n in names])[:, 0]
    faces = np.empty(len(mesh.faces), [("vertex_indices", "<i4", (3,))])
    faces["vertex_indices"] = mesh.faces
    buffer = io.BytesIO()
    PlyData([PlyElement.describe(table, "vertex"), PlyElement.describe(faces, "face")]).write(buffer)
    return buffer.getvalue()
