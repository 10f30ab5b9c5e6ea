"""A drawn scene in Mitsuba: ray-cast buffers, direct lighting and path-traced references. `choose_variant` first.

Mitsuba's cameras look along +z with x to the left and y up; ours have x to the right and y down (OpenCV), so that
world_from_mitsuba = world_from_camera @ diag(-1, -1, 1, 1). Pixel centres are at +0.5 in both.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from catacaustics.cameras import Camera, pixel_centers
from catacaustics.errors import UserError
from catacaustics.geometry import look_at, normalize, rigid, rigid_inverse, sphere_directions
from catacaustics.refraction.scenes import Body, Scene, number
from catacaustics.refraction.trace import Hits, Media
from catacaustics.refraction.variants import perspective_sensor
from catacaustics.shapes import Float, Int, UInt8

MAX_DEPTH = 24
"""Bounces of a reference's paths; Russian roulette from RUSSIAN_ROULETTE on."""
RUSSIAN_ROULETTE = 4
DIRECT_SAMPLES = 16
"""Samples a pixel of the direct lighting."""
CAMERA_CLEARANCE = 0.05
"""Free space that a camera needs around it."""
NEAR, FAR = 0.01, 10.0
"""Of clip space; nothing is cut off."""


def camera_of(scene: Scene, resolution: int) -> Camera:
    """The camera of a drawn scene."""
    azimuth, elevation = np.radians(number(scene.eye.azimuth)), np.radians(number(scene.eye.elevation))
    level = np.cos(elevation)
    away = np.array([np.sin(azimuth) * level, -np.cos(azimuth) * level, np.sin(elevation)])
    target = np.array([number(c) for c in scene.eye.target])
    pose = look_at(target + number(scene.eye.distance) * away, target, np.array([0.0, 0.0, 1.0]))
    focal = resolution / 2 / np.tan(np.radians(number(scene.eye.fov)) / 2)
    return Camera(resolution, resolution, focal, focal, resolution / 2, resolution / 2, pose)


def world_to_clip(camera: Camera) -> Float[np.ndarray, "4 4"]:
    """Projection times view: ndc x to the right, y up, -1 and 1 at the edges; z from -1 (NEAR) to 1 (FAR)."""
    projection = np.array(
        [
            [2 * camera.fx / camera.width, 0, 0, 0],
            [0, -2 * camera.fy / camera.height, 0, 0],  # OpenCV's y runs down
            [0, 0, (FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)],
            [0, 0, 1, 0],
        ]
    )
    return projection @ camera.camera_from_world


def whole_samples(spp: int) -> int:
    """The next number of samples that fills a grid of strata, as Mitsuba's multi-jittered sampler does."""
    columns = int(np.sqrt(spp))
    return columns * -(-spp // columns)


def srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB encoding of linear light, clipped to [0, 1]."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


class Pose(NamedTuple):
    """x_world = size * rotation @ x_body + center."""

    center: tuple[float, float, float]
    rotation: tuple[tuple[float, ...], ...]
    size: float


def _pose(body: Body, bodies: Mapping[str, Body]) -> Pose:
    """Where a drawn body stands in the world."""
    turn, tilt = np.radians(number(body.turn)), np.radians(number(body.tilt))
    c, s = np.cos(tilt), np.sin(tilt)
    about_x = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ about_x
    center, size = np.array([number(c) for c in body.center]), number(body.size)
    if body.inside:
        outer = _pose(bodies[body.inside], bodies)
        turned = np.array(outer.rotation)
        center, rotation, size = outer.size * turned @ center + outer.center, turned @ rotation, outer.size * size
    return Pose(tuple(center.tolist()), tuple(map(tuple, rotation.tolist())), size)


def poses(scene: Scene) -> Float[np.ndarray, "k 3 4"]:
    """How every transparent body of a drawn scene stands: x_world = M @ (x_body, 1)."""
    named = {b.name: b for b in scene.bodies}
    found = [_pose(b, named) for b in scene.transparent]
    return np.array([np.column_stack([p.size * np.array(p.rotation), p.center]) for p in found]).reshape(-1, 3, 4)


@lru_cache(maxsize=32)
def _texture(body_texture: Any) -> UInt8[np.ndarray, "_ _ 3"]:
    return body_texture()


@lru_cache(maxsize=32)
def _paint(body_texture: Any) -> Any:
    import mitsuba as mi

    bitmap = mi.Bitmap(np.ascontiguousarray(_texture(body_texture)))
    return mi.load_dict({"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap, "wrap_mode": "repeat"}})


_last: dict[str, tuple[Any, Any]] = {}
"""The last shape of each body by name, and what it was made of."""


def _shape(body: Body, pose: Pose, around: float) -> Any:
    """The Mitsuba shape of a drawn body. What does not move is made once.

    Kernels hold the numbers that Mitsuba gives to shapes. The last shape is let go first, so that the next one takes
    its number and no kernel has to be compiled again.
    """
    made_of = (body, pose, around)
    if body.name in _last and _last[body.name][0] == made_of:
        return _last[body.name][1]
    _last.pop(body.name, None)
    _last[body.name] = (made_of, _made(body, pose, around))
    return _last[body.name][1]


def _made(body: Body, pose: Pose, around: float) -> Any:
    import mitsuba as mi

    if body.ior is None:
        bsdf = mi.load_dict({"type": "twosided", "bsdf": _paint(body.texture)})
    else:
        bsdf = mi.load_dict({"type": "dielectric", "int_ior": number(body.ior), "ext_ior": around})
    if body.mesh is None:
        turned = rigid(pose.size * np.array(pose.rotation), np.array(pose.center))
        return mi.load_dict({"type": "sphere", "to_world": mi.ScalarTransform4f(turned), "bsdf": bsdf})
    mesh = body.mesh().moved(np.array(pose.rotation), np.array(pose.center), pose.size)
    properties = mi.Properties()
    properties["bsdf"] = bsdf
    if number(body.radiance) > 0:
        properties["emitter"] = mi.load_dict(
            {"type": "area", "radiance": {"type": "rgb", "value": number(body.radiance)}}
        )
    made = mi.Mesh(
        body.name, len(mesh.vertices), len(mesh.faces), props=properties, has_vertex_normals=True,
        has_vertex_texcoords=True,
    )  # fmt: skip
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = mesh.vertices.astype(np.float32).ravel()
    parameters["vertex_normals"] = mesh.normals.astype(np.float32).ravel()
    parameters["vertex_texcoords"] = mesh.uv.astype(np.float32).ravel()
    parameters["faces"] = mesh.faces.astype(np.uint32).ravel()
    parameters.update()
    return made


class Stage:
    """A drawn scene, ready to be looked at.

    Args:
        scene: every number of it drawn.

    Raises:
        UserError: a body reaches out of [-1, 1]^3.
    """

    def __init__(self, scene: Scene):
        self.scene = scene
        iors = {b.name: number(b.ior) for b in scene.transparent}
        outer = [iors.get(b.inside, 1.0) for b in scene.bodies]
        self.media = Media(np.array([iors.get(b.name, np.nan) for b in scene.bodies]), np.array(outer))
        named = {b.name: b for b in scene.bodies}
        for name in _last.keys() - named.keys():  # of another scene
            del _last[name]
        self._shapes = [_shape(b, _pose(b, named), around) for b, around in zip(scene.bodies, outer, strict=True)]
        for body, shape in zip(scene.bodies, self._shapes, strict=True):
            box = shape.bbox()
            reach = float(max(*np.abs(np.array(box.min).ravel()), *np.abs(np.array(box.max).ravel())))
            if reach > 1 + 1e-4:
                raise UserError(
                    f"{body.name} of the scene {scene.name} reaches to {reach:.3f}.",
                    "every body within [-1, 1]^3",
                    "narrow the ranges of its centre and size",
                )
        self._registered = [_number(shape) for shape in self._shapes]
        self.full = _load(self._shapes)
        self.opaque = _load([s for s, b in zip(self._shapes, scene.bodies, strict=True) if b.ior is None])
        self._alone = [_load([s]) for s, b in zip(self._shapes, scene.bodies, strict=True) if b.ior is not None]

    def intersect(self, origins: np.ndarray, directions: np.ndarray, scene: Any = None) -> Hits:
        """Meet rays with all bodies, or with those of one of the stage's scenes."""
        import drjit as dr
        import mitsuba as mi

        # Gathered, because the alignment and the shape of NumPy's arrays would be compiled into the kernel.
        flat = mi.Float(np.concatenate([origins.T, directions.T]).astype(np.float32).ravel())
        count, index = dr.opaque(mi.UInt32, len(origins)), dr.arange(mi.UInt32, len(origins))
        columns = [dr.gather(mi.Float, flat, index + i * count) for i in range(6)]
        hit = (scene or self.full).ray_intersect(mi.Ray3f(mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:])))
        shape = dr.reinterpret_array(mi.UInt32, hit.shape)
        dr.eval(hit.t, hit.n, hit.sh_frame.n, hit.uv, shape)
        normal, shading, uv = (
            np.stack([np.array(c) for c in v], -1).astype(float) for v in (hit.n, hit.sh_frame.n, hit.uv)
        )
        return Hits(np.array(hit.t).astype(float), normal, shading, uv, self._bodies(np.array(shape)))

    def _bodies(self, registered: np.ndarray) -> Int[np.ndarray, "n"]:
        """Indices of bodies from Mitsuba's numbers of shapes."""
        body = np.full(registered.shape, -1)
        for k, its_number in enumerate(self._registered):
            body[registered == its_number] = k
        return body

    def problem(self, camera: Camera) -> str | None:
        """What is wrong with where a camera stands: in a thing, close to one, or outside."""
        around = sphere_directions(400)
        hits = self.intersect(np.broadcast_to(camera.center, around.shape), around)
        nearest = hits.distance.argmin()
        name = self.scene.bodies[hits.body[nearest]].name if hits.body[nearest] >= 0 else "nothing"
        backs = (hits.shading * around).sum(-1) > 0
        if (hits.body < 0).mean() > 0.02 or np.abs(camera.center).max() > 1:
            return "is outside the walls"
        if backs.mean() > 0.5:
            return f"is inside {name}"
        if hits.distance.min() < CAMERA_CLEARANCE:
            return f"is {hits.distance.min():.3f} from {name}"
        return None

    def reference(self, camera: Camera, spp: int, seed: int) -> Float[np.ndarray, "h w 3"]:
        """Path traced, box filter; linear radiance."""
        return self._rendered(
            self.full, camera, {"type": "path", "max_depth": MAX_DEPTH, "rr_depth": RUSSIAN_ROULETTE}, spp, seed
        )

    def direct(self, camera: Camera) -> Float[np.ndarray, "h w 3"]:
        """Direct lighting of the opaque bodies; linear radiance."""
        return self._rendered(self.opaque, camera, {"type": "direct"}, DIRECT_SAMPLES, 0)

    def _rendered(self, scene: Any, camera: Camera, integrator: Any, spp: int, seed: int) -> np.ndarray:
        import drjit as dr
        import mitsuba as mi

        sensor = perspective_sensor(camera, NEAR, FAR, "multijitter")
        made = mi.load_dict(integrator)
        # A seed that is no data would be compiled into the kernel. mi.render would hide an interrupt.
        image = made.render(scene, sensor=sensor, seed=dr.opaque(mi.UInt32, seed), spp=spp)
        return np.array(image)

    def gbuffer(self, camera: Camera) -> dict[str, np.ndarray]:
        """The opaque bodies at pixel centres: position, normal (towards the camera), albedo (sRGB) and depth, float32.

        Raises:
            UserError: a ray leaves the scene, which must be closed.
        """
        import drjit as dr
        import mitsuba as mi

        index = dr.arange(mi.UInt32, camera.width * camera.height)
        pose = rigid_inverse(camera.camera_from_world)
        axes: list[Any] = [mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in v)) for v in pose[:3].T]
        right, down, forward, center = axes
        x = (mi.Float(index % camera.width) + 0.5 - camera.cx) / dr.opaque(mi.Float, camera.fx)
        y = (mi.Float(index // camera.width) + 0.5 - camera.cy) / dr.opaque(mi.Float, camera.fy)
        ray = mi.Ray3f(mi.Point3f(center), dr.normalize(x * right + y * down + forward))
        hit = self.opaque.ray_intersect(ray)
        colour = hit.bsdf().eval_diffuse_reflectance(hit)
        found = {
            "position": hit.p,
            "normal": dr.select(dr.dot(hit.sh_frame.n, ray.d) > 0, -hit.sh_frame.n, hit.sh_frame.n),
            "albedo": mi.Color3f(*(_encoded(c) for c in colour)),
            "depth": hit.t * dr.dot(ray.d, forward),
        }
        dr.eval(found)
        arrays = {n: np.stack([np.array(c) for c in v]) if len(v) == 3 else np.array(v) for n, v in found.items()}
        if not np.isfinite(arrays["depth"]).all():
            raise UserError(
                f"The scene {self.scene.name} is open: a ray of the camera meets nothing.",
                "opaque bodies all around",
                "close the scene, or keep its camera inside",
            )
        size = (camera.height, camera.width)
        return {n: a.T.reshape(*size, 3) if a.ndim == 2 else a.reshape(size) for n, a in arrays.items()}

    def probe(self, rows: int) -> tuple[UInt8[np.ndarray, "v u 3"], Float[np.ndarray, "3"]]:
        """Texture colour of the opaque bodies all around the middle of the transparent ones, as `Frame.probe`, and
        where that is."""
        import drjit as dr
        import mitsuba as mi

        named = {b.name: b for b in self.scene.bodies}
        center = np.mean([_pose(b, named).center for b in self.scene.transparent], 0)
        index = dr.arange(mi.UInt32, 2 * rows * rows)
        step = dr.opaque(mi.Float, np.pi / rows)
        azimuth = (mi.Float(index % (2 * rows)) + 0.5) * step - dr.pi
        polar = (mi.Float(index // (2 * rows)) + 0.5) * step
        level = dr.sin(polar)
        directions = mi.Vector3f(level * dr.cos(azimuth), level * dr.sin(azimuth), dr.cos(polar))
        origin = mi.Point3f(*(dr.opaque(mi.Float, float(x)) for x in center))
        hit = self.opaque.ray_intersect(mi.Ray3f(origin, directions))
        colour = [_encoded(c) for c in hit.bsdf().eval_diffuse_reflectance(hit)]
        image = np.stack([np.array(c) for c in colour], -1).reshape(rows, 2 * rows, 3)
        return np.round(255 * np.clip(image, 0, 1)).astype(np.uint8), center.astype(np.float32)

    def object_to_world(self) -> Float[np.ndarray, "k 3 4"]:
        """How every transparent body stands: x_world = M @ (x_body, 1)."""
        return poses(self.scene)

    def alone(self, camera: Camera) -> dict[str, np.ndarray]:
        """Every transparent body as if it stood alone: object_mask, object_position, object_normal, object_depth."""
        directions = normalize(camera_rays(camera))
        origins = np.broadcast_to(camera.center, directions.shape)
        k, size = len(self._alone), (camera.height, camera.width)
        found = [self.intersect(origins, directions, scene) for scene in self._alone]
        mask = np.array([hits.body >= 0 for hits in found]).reshape(k, -1)
        distance = np.array([np.where(hits.body >= 0, hits.distance, 0) for hits in found]).reshape(k, -1)
        normal = np.array([hits.shading for hits in found]).reshape(k, -1, 3)
        forward = camera.camera_from_world[2, :3]
        return {
            "object_mask": mask.reshape(k, *size),
            "object_position": (mask[..., None] * (origins + distance[..., None] * directions)).reshape(k, *size, 3),
            "object_normal": (mask[..., None] * normal).reshape(k, *size, 3),
            "object_depth": (distance * (directions @ forward)).reshape(k, *size),
        }


def camera_rays(camera: Camera) -> Float[np.ndarray, "n 3"]:
    """World directions through the pixel centres, row by row; not of unit length."""
    return camera.ray_directions(pixel_centers(camera.viewport)).reshape(-1, 3)


def _encoded(linear: Any) -> Any:
    """sRGB encoding of Dr.Jit's numbers."""
    import drjit as dr

    return dr.select(linear <= 0.0031308, 12.92 * linear, 1.055 * dr.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def _number(shape: Any) -> int:
    """Mitsuba's number of a shape, as hits give it."""
    import drjit as dr
    import mitsuba as mi

    found: Any = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))
    return int(found[0])


def _load(shapes: list[Any]) -> Any:
    import drjit as dr
    import mitsuba as mi

    settings = {"type": "scene", "embree_use_robust_intersections": True}  # no cracks between triangles
    scene = mi.load_dict(settings | {f"body_{i}": s for i, s in enumerate(shapes)}, parallel=False)
    parameters = mi.traverse(scene)
    for name in parameters.keys():  # noqa: SIM118 numbers kept as data are not compiled into the kernels
        dr.make_opaque(parameters[name])
    return scene
