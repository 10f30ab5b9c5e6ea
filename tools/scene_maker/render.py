"""Mitsuba 3: a scene model as a Mitsuba scene, path-traced views, and the exact geometry behind every pixel.

Mitsuba's cameras look along +z with x to the left and y up; ours have x to the right and y down (OpenCV), so that
world_from_mitsuba = world_from_camera @ diag(-1, -1, 1, 1). Pixel centres are at +0.5 in both.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from catacaustics.cameras import Camera, pixel_centers
from catacaustics.capture.truth import Truth
from catacaustics.images import resize
from catacaustics.refraction.variants import perspective_sensor
from catacaustics.shapes import Bool, Float, Int
from scene_maker.model import Light, Reflector, SceneModel
from scene_maker.solids import DENSITY, Mesh, Surface, atlas, merged, sheet

MAX_BOUNCES = 12
LIGHT_CELL = 4
"""Side in texels of the cells for which light is path-traced: 1 to 2 cm."""
SAMPLES_AT_ONCE = 4
BLACK = {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": 0.0}}
"""What emits and reflects nothing: a mirror rather than a diffuse surface, so that no light is sampled in vain."""


def _scalar() -> bool:
    """Whether rays are traced one by one."""
    import mitsuba as mi

    return str(mi.variant()).startswith("scalar")


def _mesh(name: str, mesh: Mesh, bsdf: Any, emitter: Any = None) -> Any:
    import mitsuba as mi

    properties = mi.Properties()
    properties["mesh_bsdf"] = bsdf
    if emitter is not None:
        properties["mesh_emitter"] = emitter
    made = mi.Mesh(
        name,
        len(mesh.vertices),
        len(mesh.faces),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=True,
    )
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = mesh.vertices.astype(np.float32).ravel()
    parameters["vertex_normals"] = mesh.normals.astype(np.float32).ravel()
    parameters["vertex_texcoords"] = mesh.uv.astype(np.float32).ravel()
    parameters["faces"] = mesh.faces.astype(np.uint32).ravel()
    parameters.update()
    return made


def _linear(texture: np.ndarray) -> np.ndarray:
    """Linear reflectance of sRGB bytes."""
    x = np.arange(256) / 255
    return np.where(x < 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)[texture]


def _texture(image: np.ndarray) -> dict[str, Any]:
    import mitsuba as mi

    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(image)), "wrap_mode": "clamp"}


def _lamp(light: Light) -> Surface:
    """A light as a surface whose texture is the radiance it emits.

    Mitsuba picks points of a light by the brightness of texels: texels must be of one size on all lights.
    """
    width, height = (max(round(DENSITY * float(np.linalg.norm(v))), 8) for v in (light.right, light.down))
    view = np.ones((height, width, 3)) if light.view is None else resize(light.view, width, height)
    return Surface(sheet(light.top_left, light.right, light.down), (view * light.radiance).astype(np.float32))


def _glowing(name: str, surfaces: list[Surface], radiance: list[np.ndarray], atlas_width: int) -> Any:
    """Surfaces as one mesh that emits: one emitter, because the order of several differs from run to run."""
    import mitsuba as mi

    image = {"type": "bitmap", "bitmap": mi.Bitmap(atlas(surfaces, radiance, atlas_width)), "raw": True}
    emitter = mi.load_dict({"type": "area", "radiance": image | {"wrap_mode": "clamp"}})
    return _mesh(name, merged(surfaces, atlas_width), mi.load_dict(BLACK), emitter)


def _reflector(reflector: Reflector) -> Any:
    import mitsuba as mi

    tint = {"type": "rgb", "value": list(reflector.tint)}
    if reflector.paint is None:
        surface: dict[str, Any] = {"type": "conductor", "specular_reflectance": tint}
    else:
        surface = {
            "type": "plastic",
            "diffuse_reflectance": _texture(reflector.paint),
            "specular_reflectance": tint,
            "int_ior": 1.7,
            "nonlinear": True,
        }
    surface = {"type": "twosided", "bsdf": surface}
    if reflector.geometry["type"] == "sphere":
        center, radius = reflector.geometry["center"], reflector.geometry["radius"]
        return {"type": "sphere", "center": center, "radius": radius, "bsdf": surface}
    assert reflector.mesh is not None, f"the reflector {reflector.name} has no mesh"
    return _mesh(reflector.name, reflector.mesh, mi.load_dict(surface))


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays meet: distance (infinite for nothing), position, normal towards the ray's origin, which reflector
    (or -1), and whether the surface was met from its back."""

    distance: Float[np.ndarray, "n"]
    position: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    reflector: Int[np.ndarray, "n"]
    back: Bool[np.ndarray, "n"]


class Renderer:
    """A Mitsuba scene built from a model. `choose_variant` first.

    Light that leaves a diffuse surface is the same in every direction. It is therefore path-traced once for every
    point of the surfaces (`irradiance`, then `illuminate`) and not again for every view; the views trace what is left:
    mirrors, glazes and pixels.
    """

    def __init__(self, model: SceneModel):
        import mitsuba as mi

        self.model = model
        self._lamps = [_lamp(light) for light in model.lights]
        paint = _texture(atlas(model.surfaces, [s.texture for s in model.surfaces]))
        diffuse = mi.load_dict({"type": "diffuse", "reflectance": paint})
        parts = {"surroundings": _mesh("surroundings", merged(model.surfaces), diffuse)}
        if self._lamps:
            parts["lamps"] = _glowing("lamps", self._lamps, [lamp.texture for lamp in self._lamps], 512)
        self.scene = self._load(parts)
        self._lit = None
        by_name = {shape.id(): shape for shape in self.scene.shapes()}
        self._reflectors = [by_name[f"reflector_{i}"] for i in range(len(model.reflectors))]

    def _load(self, parts: dict[str, Any]) -> Any:
        import mitsuba as mi

        scene: dict[str, Any] = {"type": "scene"} | parts
        scene |= {f"reflector_{i}": _reflector(r) for i, r in enumerate(self.model.reflectors)}
        if self.model.sky is not None:
            turn = mi.ScalarTransform4f().rotate([1, 0, 0], 90)  # Mitsuba's maps have y up
            scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(self.model.sky), "to_world": turn}
        return mi.load_dict(scene, parallel=False)

    def irradiance(self, samples: int, seed: int) -> list[Float[np.ndarray, "rows columns 3"]]:
        """Radiance of each surface were it white, in cells of LIGHT_CELL x LIGHT_CELL texels (irradiance over pi)."""
        cells = [tuple(-(-n // LIGHT_CELL) for n in s.texture.shape[:2]) for s in self.model.surfaces]
        found = [s.points(*cell) for s, cell in zip(self.model.surfaces, cells, strict=True)]
        positions, normals = (np.concatenate([f[k].reshape(-1, 3) for f in found]) for k in (0, 1))
        light = self._outgoing(positions, normals, samples, seed)
        parts = np.split(light, np.cumsum([r * c for r, c in cells])[:-1])
        return [part.reshape(*cell, 3) for part, cell in zip(parts, cells, strict=True)]

    def _outgoing(self, positions: np.ndarray, normals: np.ndarray, samples: int, seed: int) -> np.ndarray:
        """Path-traced radiance over reflectance at surface points, seen from just in front of them."""
        import mitsuba as mi

        integrator = mi.load_dict({"type": "path", "max_depth": self.model.max_depth, "rr_depth": 4})
        sampler = mi.load_dict({"type": "independent"})
        total = np.zeros(positions.shape)
        for start in range(0, samples, SAMPLES_AT_ONCE):
            count = min(SAMPLES_AT_ONCE, samples - start)
            eyes, looks = np.repeat(positions + 1e-3 * normals, count, 0), np.repeat(-normals, count, 0)
            first = seed * 100003 + start
            if _scalar():
                light = np.empty(eyes.shape)
                for k in range(len(eyes)):
                    sampler.seed(first + samples * k, 1)
                    light[k] = self._radiance(integrator, sampler, eyes[k], looks[k])
            else:
                sampler.seed(first, len(eyes))
                light = np.array(self._radiance(integrator, sampler, eyes.T, looks.T)).T
            total += light.reshape(len(positions), count, 3).sum(1)
        return total / samples

    def _radiance(self, integrator: Any, sampler: Any, eye: np.ndarray, look: np.ndarray) -> Any:
        import drjit as dr
        import mitsuba as mi

        ray = mi.RayDifferential3f(mi.Point3f(eye.astype(np.float32)), mi.Vector3f(look.astype(np.float32)))
        hit = self.scene.ray_intersect(ray)
        if _scalar() and not hit.is_valid():
            return mi.Color3f(0)  # one ray that met nothing has no material to ask
        white = dr.maximum(hit.bsdf(ray).eval_diffuse_reflectance(hit), 1e-3)
        light = integrator.sample(self.scene, sampler, ray)[0] / white
        return dr.select(hit.is_valid() & (hit.t < 2e-3), light, 0)

    def illuminate(self, irradiance: list[Float[np.ndarray, "rows columns 3"]]) -> None:
        """Make every diffuse surface emit what it reflects."""
        import cv2

        glow = []
        for surface, light in zip(self.model.surfaces, irradiance, strict=True):
            height, width = surface.texture.shape[:2]
            smooth = cv2.GaussianBlur(light.astype(np.float32), (0, 0), 0.7, borderType=cv2.BORDER_REPLICATE)
            rows, columns = light.shape[:2]
            full = cv2.resize(smooth, (columns * LIGHT_CELL, rows * LIGHT_CELL), interpolation=cv2.INTER_LINEAR)
            full = cv2.resize(full, (width, height), interpolation=cv2.INTER_LINEAR)
            glow.append(full * _linear(surface.texture))
        surfaces, glow = [*self.model.surfaces, *self._lamps], [*glow, *(lamp.texture for lamp in self._lamps)]
        self._lit = self._load({"surroundings": _glowing("surroundings", surfaces, glow, 4096)})

    def photograph(self, camera: Camera, samples: int, seed: int) -> Float[np.ndarray, "height width 3"]:
        """A view as linear radiance times exposure, path-traced with a box filter. `illuminate` first."""
        import mitsuba as mi

        assert self._lit is not None, "illuminate the scene first"
        sensor = perspective_sensor(camera, 0.01, 1000.0, "independent")
        integrator = mi.load_dict({"type": "path", "max_depth": MAX_BOUNCES + 1, "rr_depth": MAX_BOUNCES})
        image = mi.render(self._lit, sensor=sensor, integrator=integrator, spp=samples, seed=mi.UInt32(seed))
        return np.array(image) * self.model.exposure

    def truth(self, camera: Camera) -> tuple[Truth, Int[np.ndarray, "height width"]]:
        """The exact geometry at every pixel centre, and the index of the reflector seen there (-1: none)."""
        height, width = camera.height, camera.width
        directions = camera.ray_directions(pixel_centers(camera.viewport)).reshape(-1, 3)
        first = self.trace(np.broadcast_to(camera.center, directions.shape), directions)
        # `directions` have z = 1 in the camera, so that distance along them in units of their length is depth.
        depth = first.distance / np.linalg.norm(directions, axis=-1)
        source = self._mirrored(directions, first)
        found = np.isfinite(depth)
        truth = Truth(
            np.where(found, depth, np.nan).reshape(height, width),
            np.where(found[:, None], first.normal, np.nan).reshape(height, width, 3),
            source.reshape(height, width, 3),
            (first.reflector >= 0).reshape(height, width),
        )
        return truth, first.reflector.reshape(height, width)

    def _mirrored(self, directions: np.ndarray, first: Hits) -> np.ndarray:
        """Where the mirrored path of each ray first meets something that is no reflector; nan where it does not."""
        source = np.full(directions.shape, np.nan)
        active = np.flatnonzero(first.reflector >= 0)
        direction, hits = directions[active], Hits(*(v[active] for v in vars(first).values()))
        for _ in range(MAX_BOUNCES):
            if not len(active):
                break
            direction = direction - 2 * (direction * hits.normal).sum(-1, keepdims=True) * hits.normal
            start = hits.position + 1e-5 * hits.normal
            hits = self.trace(start, direction)
            arrived = np.isfinite(hits.distance) & (hits.reflector < 0)
            source[active[arrived]] = hits.position[arrived]
            again = hits.reflector >= 0
            active, direction = active[again], direction[again]
            hits = Hits(*(v[again] for v in vars(hits).values()))
        return source

    def trace(self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]) -> Hits:
        """Meet rays with the scene; directions need not be unit vectors. Normals are the shading normals."""
        import mitsuba as mi

        directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        if _scalar():
            rows = [self._intersect(mi.Point3f(o), mi.Vector3f(d)) for o, d in zip(origins, directions, strict=True)]
            distance, normal, reflector = (np.array(column) for column in zip(*rows, strict=True))
            normal = normal.reshape(-1, 3)
        else:
            o, d = (np.ascontiguousarray(v.T, np.float32) for v in (origins, directions))
            distance, normal, reflector = (np.array(v) for v in self._intersect(mi.Point3f(o), mi.Vector3f(d)))
            normal = normal.T
        distance, normal = distance.astype(float), normal.astype(float)
        back = (normal * directions).sum(-1) > 0
        normal = np.where(back[:, None], -normal, normal)
        finite = np.where(np.isfinite(distance), distance, 0)
        return Hits(distance, origins + finite[:, None] * directions, normal, reflector.astype(int), back)

    def _intersect(self, origin: Any, direction: Any) -> tuple[Any, Any, Any]:
        import drjit as dr
        import mitsuba as mi

        hit = self.scene.ray_intersect(mi.Ray3f(origin, direction))
        scalar = _scalar()  # scalar variants have the shapes themselves
        reflector = mi.Int32(-1)
        for i, shape in enumerate(self._reflectors):
            same = hit.shape == (shape if scalar else mi.ShapePtr(shape))
            reflector = dr.select(hit.is_valid() & same, i, reflector)
        return hit.t, hit.sh_frame.n, reflector
