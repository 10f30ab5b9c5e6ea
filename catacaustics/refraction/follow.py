"""Specular paths through baked bodies, where poses place them: the tracer of hybrid. No network bends a ray."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from catacaustics.geometry import normalize
from catacaustics.refraction.bodies import Surface, bake_bodies
from catacaustics.refraction.buffers import Buffers, frame_buffers
from catacaustics.refraction.frames import Frame
from catacaustics.refraction.networks import TURNS, Size, encode, flat, layers, precise
from catacaustics.refraction.optics import fresnel
from catacaustics.refraction.trace import Hits, Landings, Media, land
from catacaustics.shapes import Bool, Float

_ASTRAY = 0.01
"""Where the baked surface is farther than this from what the G-buffer shows first, that counts (scene units)."""
_AWAY = 1e-4
"""How far off the first surface its reflections start (scene units): a G-buffer rounds places to 2e-5."""
_STEP = 0.02
"""Neighbouring pixels whose points are farther than this from each other's tangent planes do not show one surface."""
_TRIED, _OFF = 16, np.radians(5)
"""Frames whose landing points are compared with paths, and how far a path may be off to count as right."""
_CORNERS = 16
"""Vertices of a body that are asked for, to tell whether another encloses it."""
TRACED_CHANNELS = 12
"""Of a tracer's output: normal and place where paths land, the share of light on them, whether the screen shows that
place; place where the reflection off the first surface lands, and the share of light on it."""


def _open3d() -> Any:
    import open3d

    return open3d


def _tensor(values: np.ndarray) -> Any:
    return _open3d().core.Tensor(np.ascontiguousarray(values))


class Mesh:
    """A triangle mesh that rays are cast at, by open3d (Embree)."""

    def __init__(self, surface: Surface):
        self.surface = surface
        self.scene = _open3d().t.geometry.RaycastingScene(nthreads=1)
        self.scene.add_triangles(_tensor(surface.vertices.astype(np.float32)), _tensor(surface.faces.astype(np.uint32)))
        some = np.linspace(0, len(surface.vertices) - 1, _CORNERS).astype(int)
        self.corners = surface.vertices[some]

    def meet(
        self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Distance (infinite: nothing), normal of the face and for shading; in the mesh's coordinates."""
        rays = np.concatenate([origins, directions], -1, dtype=np.float32)
        found = self.scene.cast_rays(_tensor(rays), nthreads=1)
        distance = found["t_hit"].numpy().astype(float)
        hit = np.isfinite(distance)
        normal, shading = np.zeros((2, len(rays), 3))
        u, v = found["primitive_uvs"].numpy()[hit].astype(float).T
        shares = np.stack([1 - u - v, u, v], -1)
        own = self.surface.normals[found["primitive_ids"].numpy()[hit]]
        shading[hit] = normalize((shares[..., None] * own).sum(1))
        face = normalize(found["primitive_normals"].numpy()[hit].astype(float))
        normal[hit] = np.where(((face * shading[hit]).sum(-1) < 0)[:, None], -face, face)
        return distance, normal, shading

    def encloses(self, points: Float[np.ndarray, "n 3"]) -> bool:
        """Whether points all lie inside the closed mesh."""
        inside = self.scene.compute_occupancy(_tensor(points.astype(np.float32)), nthreads=1)
        return bool((inside.numpy() > 0.5).all())


class Placed(NamedTuple):
    """A body where it stands: x_world = size * rotation @ x_body + place."""

    mesh: Mesh
    rotation: Float[np.ndarray, "3 3"]
    place: Float[np.ndarray, "3"]
    size: float
    ior: float

    def to_body(self, points: np.ndarray) -> np.ndarray:
        return (points - self.place) @ self.rotation / self.size


class Stand:
    """One frame's bodies, and what its screen shows of the opaque scene, for `trace.land`.

    Bodies come first, then the opaque scene as seen, then all that lies beyond, which every ray meets at distance 1.

    Args:
        seen: the opaque scene as the camera sees it; None: all of it is beyond.
    """

    def __init__(self, bodies: Sequence[Placed], seen: Mesh | None):
        self.bodies, self.seen = bodies, seen
        inner = np.array([*(body.ior for body in bodies), np.nan, np.nan])
        self.media = Media(inner, np.array([*(self._around(i) for i in range(len(bodies))), 1.0, 1.0]))
        self.opaque, self.beyond = len(bodies), len(bodies) + 1

    def _around(self, number: int) -> float:
        """Index of refraction of the smallest body that encloses one; 1 where none does."""
        own = self.bodies[number]
        corners = own.size * own.mesh.corners @ own.rotation.T + own.place
        around = [b for b in self.bodies if b is not own and b.mesh.encloses(b.to_body(corners))]
        return min(around, key=lambda b: b.size).ior if around else 1.0

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        n = len(origins)
        hits = Hits(np.ones(n), -directions, -directions, np.zeros((n, 2)), np.full(n, self.beyond))
        nearest = np.full(n, np.inf)
        for number, body in enumerate(self.bodies):
            found = body.mesh.meet(body.to_body(origins), directions @ body.rotation)
            turned = [vectors @ body.rotation.T for vectors in found[1:]]
            _take(hits, nearest, number, body.size * found[0], turned[0], turned[1])
        if self.seen is not None:
            _take(hits, nearest, self.opaque, *self.seen.meet(origins, directions))
        return hits


def _take(
    hits: Hits, nearest: np.ndarray, number: int, distance: np.ndarray, normal: np.ndarray, shading: np.ndarray
) -> None:
    """Enter what is nearer than all before."""
    better = distance < nearest
    nearest[better] = hits.distance[better] = distance[better]
    hits.normal[better], hits.shading[better], hits.body[better] = normal[better], shading[better], number


def seen_mesh(position: Float[np.ndarray, "h w 3"], normal: Float[np.ndarray, "h w 3"]) -> Mesh:
    """The opaque scene as an image of positions shows it, torn where one thing ends before another."""
    height, width = position.shape[:2]
    number = np.arange(height * width).reshape(height, width)
    corners = [c.ravel() for c in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:])]
    points, normals = position.reshape(-1, 3), normal.reshape(-1, 3)
    faces = np.concatenate([np.stack([corners[0], b, c], -1) for b, c in (corners[1:3], corners[2:4])])
    whole = np.ones(len(faces), bool)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        way = points[faces[:, a]] - points[faces[:, b]]
        for end in (a, b):
            whole &= np.abs((way * normals[faces[:, end]]).sum(-1)) < _STEP
    return Mesh(Surface(points, faces[whole], normals[faces[whole]]))


class Ends(NamedTuple):
    """Where paths leave the glass and which way, the share of light on them (0: they land nowhere), whether the screen
    shows where they land; and if so, normal and place."""

    start: Float[np.ndarray, "n 3"]
    direction: Float[np.ndarray, "n 3"]
    light: Float[np.ndarray, "n"]
    seen: Bool[np.ndarray, "n"]
    normal: Float[np.ndarray, "n 3"]
    place: Float[np.ndarray, "n 3"]


class Tracer(nn.Module):
    """hybrid's R-buffer generator: paths are followed through baked bodies; learned is only how far it is from where
    they leave the glass to what the screen does not show, and the normal there.

    Args:
        surfaces: of the scene's transparent bodies; None: not baked, rays pass through it.
    """

    def __init__(self, surfaces: Sequence[Surface | None], size: Size):
        super().__init__()
        self.octaves = size.octaves
        self.count = len(surfaces)
        for number, surface in enumerate(surfaces):
            for name, values in (surface._asdict() if surface else {}).items():
                kind = torch.int32 if name == "faces" else torch.float32
                self.register_buffer(f"body_{number}_{name}", torch.as_tensor(values.copy(), dtype=kind))
        inside = 4 * size.width
        self.reach = layers(3 * (1 + 2 * size.octaves) + 3 * (1 + 2 * TURNS), inside, inside)
        self.leave = flat(inside, [0.5, 0.0, 0.0, 0.0])
        self._meshes: list[Mesh | None] | None = None

    @property
    def meshes(self) -> list[Mesh | None]:
        """Made from the weights when they are first needed."""
        if self._meshes is None:
            stored = {name: value.cpu().numpy() for name, value in self.named_buffers()}
            parts = [[stored.get(f"body_{i}_{name}") for name in Surface._fields] for i in range(self.count)]
            self._meshes = [None if p[0] is None else Mesh(Surface(*p)) for p in parts]  # pyright: ignore[reportArgumentType]
        return self._meshes

    def forward(self, buffers: Buffers) -> Float[Tensor, "b 12 h w"]:
        """TRACED_CHANNELS; zero where there is no glass, and where a path lands nowhere. In training the screen is not
        looked at: what lies beyond is learned everywhere."""
        covered = buffers.covered[:, 0]
        frames = [Buffers(*(v[i : i + 1].cpu() for v in buffers)) for i in range(len(covered))]
        parts = [self._follow(one, look=not self.training) for one in frames]
        through, mirrored = (
            Ends(*(np.concatenate(v) for v in zip(*ends, strict=True))) for ends in zip(*parts, strict=True)
        )
        found = self._landed(through, buffers.rays)
        seen = found.new_tensor(through.seen)[:, None]
        found = torch.cat([found, seen, self._landed(mirrored, buffers.rays)[:, 3:]], -1)
        whole = found.new_zeros(*covered.shape, TRACED_CHANNELS)
        whole[covered] = found
        return whole.movedim(-1, 1)

    def _landed(self, ends: Ends, like: Tensor) -> Float[Tensor, "n 7"]:
        """Normal, place and share of light."""
        start, direction, light, seen, normal, place = (like.new_tensor(values) for values in ends)
        x = torch.cat([encode(start, self.octaves), encode(direction, TURNS)], -1)
        distance, beyond = precise(self.leave, self.reach(x)).split([1, 3], -1)
        seen, lands = seen[:, None] > 0, light[:, None] > 0
        normal = torch.where(seen, normal, beyond)
        place = torch.where(seen, place, start + softplus(distance) * direction)
        return torch.cat([normal * lands, place * lands, light[:, None]], -1)

    def _follow(self, one: Buffers, look: bool) -> tuple[Ends, Ends]:
        """The ends of one frame's paths, and of the reflections off the first surface; `look` at what the screen shows
        of the opaque scene."""
        pixels = one.covered[0, 0].numpy()
        stand, slots = self._stand(one, look)
        rays = normalize(_pixels(one.rays)[pixels].astype(float))
        camera = np.broadcast_to(camera_position(one.world_to_clip[0].double().numpy()), rays.shape)
        shown = _first_hits(one, pixels, camera, slots)
        met = stand.intersect(camera, rays)
        near = (met.body == shown.body) & (np.abs(met.distance - shown.distance) < _ASTRAY)
        first = shown._replace(distance=np.where(near, met.distance, shown.distance))
        through = land(stand.intersect, stand.media, camera, rays, first=first)
        return _ends(stand, through), _mirrored(stand, camera, rays, first)

    def aim(self, one: Buffers) -> Float[np.ndarray, "n"]:
        """Angles, in radians, between where one frame's paths leave the glass and where they land in truth; pi for
        those that do not leave it."""
        ends, _ = self._follow(one, look=False)
        pixels = one.covered[0, 0].numpy()
        lands = one.landing_object[0].numpy()[pixels] >= 0
        way = normalize(_pixels(one.landing)[pixels] - ends.start + 1e-12)
        angle = np.arccos(np.clip((way * ends.direction).sum(-1), -1, 1))
        return np.where(ends.light > 0, angle, np.pi)[lands]

    def _stand(self, one: Buffers, look: bool) -> tuple[Stand, list[int]]:
        """The frame's bodies as they stand, and each object's place among them (-1: not baked or not seen)."""
        bodies, slots = [], []
        for pose, number in zip(one.poses[0].double().numpy(), one.bodies[0].tolist(), strict=True):
            mesh = self.meshes[number] if 0 <= number < self.count else None
            if mesh is None or pose[12] == 0:
                slots.append(-1)
                continue
            slots.append(len(bodies))
            bodies.append(Placed(mesh, pose[:9].reshape(3, 3), pose[9:12], pose[12], pose[13]))
        seen = seen_mesh(_pixels(one.position), _pixels(one.normal)) if look else None
        return Stand(bodies, seen), slots


def _mirrored(stand: Stand, origins: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 3"], first: Hits) -> Ends:
    """Reflections off the first surface, no farther than to the next one; those that are the path itself, because they
    carry more than half of the light, are left out."""
    cosine = -(rays * first.shading).sum(-1)
    share, _ = fresnel(np.maximum(cosine, 0), stand.media.inner[first.body] / stand.media.outer[first.body])
    directions = normalize(rays + 2 * cosine[:, None] * first.shading)
    start = origins + first.distance[:, None] * rays + _AWAY * first.shading
    hits = stand.intersect(start, directions)
    seen = hits.body == stand.opaque
    light = np.where((seen | (hits.body == stand.beyond)) & (share < 0.5), share, 0)
    return Ends(start, directions, light, seen, hits.shading, start + hits.distance[:, None] * directions)


def _ends(stand: Stand, found: Landings) -> Ends:
    """The ends of paths: `Stand` lets those that land beyond do so at distance 1, with the normal against them."""
    beyond = (found.body == stand.beyond)[:, None]
    direction = np.where(beyond, -found.normal, 0)
    start = np.where(beyond, found.position - direction, 0)
    return Ends(
        start, direction, found.light * (found.body >= 0), found.body == stand.opaque, found.normal, found.position
    )


def _first_hits(
    one: Buffers, pixels: Bool[np.ndarray, "h w"], camera: Float[np.ndarray, "n 3"], slots: list[int]
) -> Hits:
    """What G-buffers show of the nearest object."""
    objects = one.objects[0].movedim(1, -1).double().numpy()[:, pixels]
    nearest = np.where(objects[..., 0] > 0, objects[..., 7], np.inf).argmin(0)
    own = np.take_along_axis(objects, nearest[None, :, None], 0)[0]
    distance = np.linalg.norm(own[:, 1:4] - camera, axis=-1)
    normal = normalize(own[:, 4:7])
    return Hits(distance, normal, normal, np.zeros((len(own), 2)), np.array(slots)[nearest])


def camera_position(world_to_clip: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3"]:
    """Where x, y and w of clip space vanish."""
    rows = world_to_clip[[0, 1, 3]]
    return np.linalg.solve(rows[:, :3], -rows[:, 3])


def _pixels(image: Float[Tensor, "1 c h w"]) -> Float[np.ndarray, "h w c"]:
    return image[0].movedim(0, -1).numpy()


def tracer_like(weights: Mapping[str, Tensor], size: Size) -> Tracer | None:
    """A tracer with room for these weights; None where they are not those of one."""
    count = 1 + max((int(name.split("_")[1]) for name in weights if name.startswith("body_")), default=-1)
    if not count:
        return None
    stored = [[weights.get(f"body_{i}_{name}") for name in Surface._fields] for i in range(count)]
    surfaces = [
        Surface(*(p.numpy() for p in parts if p is not None)) if parts[0] is not None else None for parts in stored
    ]
    return Tracer(surfaces, size)


def bake_tracer(frames: Sequence[Frame], size: Size) -> tuple[Tracer | None, str]:
    """A tracer through the bodies that frames show, or None where paths through them do not lead to the landing points
    of these frames; and a line on which it is."""
    surfaces = bake_bodies(frames)
    if not any(surfaces):
        return None, "no body can be baked: too few frames show one; a network learns the paths instead"
    tracer = Tracer(surfaces, size)
    right = total = 0
    for frame in frames[:: max(1, len(frames) // _TRIED)]:
        aimed = tracer.aim(frame_buffers(frame))
        right, total = right + int((aimed < _OFF).sum()), total + len(aimed)
    baked = sum(surface is not None for surface in surfaces)
    said = f"paths through {baked} of {len(surfaces)} bodies, baked from G-buffers, lead to {right / max(total, 1):.0%}"
    if right < 0.5 * total:
        return None, f"{said} of the landing points (50 % are asked for); a network learns the paths instead"
    return tracer, f"{said} of the landing points"
