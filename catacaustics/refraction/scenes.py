"""Declarative scenes: what there is, and between which values it is drawn. World z is up, all of it in [-1, 1]^3."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from catacaustics.errors import UserError
from catacaustics.refraction import meshes, textures
from catacaustics.refraction.meshes import Mesh
from catacaustics.shapes import Float


class Range(NamedTuple):
    """A number drawn evenly between two."""

    low: float
    high: float


Value = float | Range
Point = tuple[Value, Value, Value]


def number(value: Value | None) -> float:
    """A value of a drawn scene."""
    assert isinstance(value, float | int), "draw the scene first"
    return float(value)


@dataclass(frozen=True)
class Body:
    """A thing: textured, shining or transparent.

    Args:
        mesh: makes its surface; None is a true sphere of radius 1.
        texture: draws its texture.
        center, size: where it is; it is scaled about its origin.
        turn, tilt: degrees about its z axis, after degrees about its x axis.
        ior: index of refraction; given, the body is transparent.
        inside: name of the transparent body that encloses this one and moves it along: centre, size, turn and tilt
            are then in that body's coordinates.
        radiance: what it emits; above 0, it is a lamp.
    """

    name: str
    mesh: Callable[[], Mesh] | None
    texture: Callable[[], textures.Image] = textures.plain
    center: Point = (0.0, 0.0, 0.0)
    size: Value = 1.0
    turn: Value = 0.0
    tilt: Value = 0.0
    ior: Value | None = None
    inside: str = ""
    radiance: Value = 0.0


@dataclass(frozen=True)
class Eye:
    """A camera that looks at a target: azimuth 0 looks along +y, positive azimuths stand to the right; degrees."""

    target: Point
    azimuth: Value
    elevation: Value
    distance: Value
    fov: Value = 45.0


@dataclass(frozen=True)
class Scene:
    """Bodies and a camera. `about` says what the scene is there to show."""

    name: str
    about: str
    bodies: tuple[Body, ...]
    eye: Eye

    @property
    def opaque(self) -> list[Body]:
        """In the order of `Frame.landing_object`."""
        return [b for b in self.bodies if b.ior is None]

    @property
    def transparent(self) -> list[Body]:
        """In the order of `Frame.object_mask`."""
        return [b for b in self.bodies if b.ior is not None]


def values(scene: Any, prefix: str = "") -> Iterator[tuple[str, Value]]:
    """Every number of a scene with its name, such as ("egg.center.x", 0.5) or ("eye.azimuth", Range(-40, 40))."""
    if isinstance(scene, Range | float | int):
        yield prefix, scene
    elif is_dataclass(scene):
        for field in fields(scene):
            part = getattr(scene, field.name)
            own = [("", b) for b in part] if field.name == "bodies" else [(field.name, part)]
            for name, value in own:
                name = value.name if isinstance(value, Body) else name
                yield from values(value, f"{prefix}.{name}" if prefix else name)
    elif isinstance(scene, tuple):
        for axis, value in zip("xyz", scene, strict=True):
            yield from values(value, f"{prefix}.{axis}")


def with_values(scene: Any, chosen: Mapping[str, Value], prefix: str = "") -> Any:
    """The same scene with other numbers, by the names of `values`."""
    if isinstance(scene, Range | float | int):
        return chosen.get(prefix, scene)
    if is_dataclass(scene) and not isinstance(scene, type):
        new = {}
        for field in fields(scene):
            part = getattr(scene, field.name)
            if field.name == "bodies":
                new[field.name] = tuple(with_values(b, chosen, b.name) for b in part)
            else:
                new[field.name] = with_values(part, chosen, f"{prefix}.{field.name}" if prefix else field.name)
        return replace(scene, **new)
    if isinstance(scene, tuple):
        return tuple(with_values(v, chosen, f"{prefix}.{a}") for a, v in zip("xyz", scene, strict=True))
    return scene


def ranges(scene: Scene) -> dict[str, Range]:
    """What is drawn, in order."""
    return {name: value for name, value in values(scene) if isinstance(value, Range)}


def draw(scene: Scene, rng: np.random.Generator) -> tuple[Scene, Float[np.ndarray, "p"]]:
    """The scene with a number for every range, and those numbers scaled to [0, 1] over their ranges."""
    share = rng.random(len(ranges(scene)))
    return at_shares(scene, share), share


def at_shares(scene: Scene, share: Float[np.ndarray, "p"]) -> Scene:
    """The scene with a number for every range, at that share of it."""
    drawn = ranges(scene)
    numbers = {n: r.low + s * (r.high - r.low) for (n, r), s in zip(drawn.items(), share, strict=True)}
    return with_values(scene, numbers)


def with_ranges(scene: Scene, settings: Sequence[str]) -> Scene:
    """The scene with other ranges: NAME=LOW:HIGH or NAME=VALUE.

    Raises:
        UserError: a setting cannot be read, or there is no such number.
    """
    known, chosen = dict(values(scene)), {}
    for setting in settings:
        number = r"([-+]?[0-9.]+(?:e[-+]?[0-9]+)?)"
        match = re.fullmatch(rf"([\w.]+)={number}(?::{number})?", setting)
        if not match or match[1] not in known:
            found = f"The scene {scene.name} has no number {match[1]}." if match else f"{setting!r} is no range."
            raise UserError(found, f"NAME=LOW:HIGH with one of {', '.join(known)}", "correct --ranges")
        low, high = float(match[2]), float(match[3] or match[2])
        if low > high:
            raise UserError(f"The range {setting} runs backwards.", "NAME=LOW:HIGH, LOW first", "correct --ranges")
        chosen[match[1]] = Range(low, high) if match[3] else low
    return with_values(scene, chosen)


def find_scene(name: str) -> Scene:
    """One of the scenes that come with the program.

    Raises:
        UserError: unknown name.
    """
    if name not in SCENES:
        raise UserError(f"There is no scene {name}.", f"one of {', '.join(SCENES)}", "name one of them")
    return SCENES[name]


# Meshes and textures are made once a process; every scene names functions without arguments, so that it stays data.


@cache
def teapot() -> Mesh:
    """A solid teapot-like body: belly, lid, knob, spout and handle in one surface."""

    def distance(p: np.ndarray) -> np.ndarray:
        belly = meshes.ellipsoid(p, (0, 0, 0.36), (0.42, 0.42, 0.34))
        lid = meshes.ellipsoid(p, (0, 0, 0.68), (0.22, 0.22, 0.09))
        knob = np.linalg.norm(p - [0, 0, 0.80], axis=-1) - 0.07
        spout = meshes.smooth_union(
            0.05,
            meshes.capsule(p, (0.34, 0, 0.30), (0.58, 0, 0.46), 0.11, 0.075),
            meshes.capsule(p, (0.58, 0, 0.46), (0.72, 0, 0.68), 0.075, 0.05),
        )
        ring = np.hypot(np.hypot(p[:, 0] + 0.46, p[:, 2] - 0.40) - 0.21, p[:, 1]) - 0.05
        solid = meshes.smooth_union(0.06, meshes.smooth_union(0.05, belly, lid, knob), spout, ring)
        return np.maximum(solid, 0.06 - p[:, 2])  # it stands flat

    return meshes.body(distance, (-0.8, -0.5, -0.05), (0.85, 0.5, 0.95), 96)


@cache
def rabbit() -> tuple[Mesh, int]:
    """A sitting rabbit with an atlas of 36 charts; the mesh and the cells along a side of its texture."""

    def distance(p: np.ndarray) -> np.ndarray:
        p = np.stack([p[:, 0], np.abs(p[:, 1]), p[:, 2]], -1)  # two of everything
        trunk = meshes.ellipsoid(p, (-0.08, 0, 0.34), (0.40, 0.30, 0.33))
        chest = meshes.ellipsoid(p, (0.20, 0, 0.40), (0.20, 0.21, 0.27))
        head = meshes.ellipsoid(p, (0.36, 0, 0.72), (0.23, 0.18, 0.18))
        cheek = np.linalg.norm(p - [0.46, 0.08, 0.66], axis=-1) - 0.10
        ear = meshes.capsule(p, (0.26, 0.09, 0.84), (0.02, 0.17, 1.30), 0.075, 0.05)
        haunch = meshes.ellipsoid(p, (-0.18, 0.22, 0.24), (0.26, 0.14, 0.23))
        foot = meshes.capsule(p, (-0.10, 0.27, 0.06), (0.18, 0.27, 0.055), 0.075, 0.06)
        paw = meshes.capsule(p, (0.28, 0.11, 0.26), (0.36, 0.12, 0.05), 0.075, 0.06)
        tail = np.linalg.norm(p - [-0.48, 0, 0.24], axis=-1) - 0.12
        return meshes.smooth_union(0.08, trunk, chest, head, cheek, ear, haunch, foot, paw, tail)

    bare = meshes.body(distance, (-0.65, -0.45, -0.05), (0.65, 0.45, 1.40), 72)
    return meshes.charted(bare, 36, seed=3)


@cache
def ripple_glass() -> Mesh:
    """An upright plate, 0.5 wide and 0.7 high, whose faces undulate; its edges are rounded."""

    def distance(p: np.ndarray) -> np.ndarray:
        wave = 0.010 * np.sin(22 * p[:, 0] + 6 * p[:, 2]) + 0.008 * np.sin(17 * p[:, 2] - 5 * p[:, 0])
        q = np.abs(np.stack([p[:, 0], p[:, 1] - wave * np.sign(p[:, 1]), p[:, 2]], -1)) - [0.22, 0.02, 0.32]
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - 0.03

    return meshes.body(distance, (-0.3, -0.12, -0.4), (0.3, 0.12, 0.4), 120)


@cache
def triangle_prism() -> Mesh:
    """Equilateral, with sides of 1, lying on one of them."""
    return meshes.prism(np.array([[-0.5, 0], [0.5, 0], [0, np.sqrt(0.75)]]), 1.0)


@cache
def right_prism() -> Mesh:
    """A right angle on top of its longest side, which is 1 long."""
    return meshes.prism(np.array([[-0.5, 0], [0.5, 0], [0, 0.5]]), 0.7)


@cache
def cornell_walls() -> textures.Image:
    """Left, back, right, front."""
    t = textures
    warm, cool = (t.RED, t.OCHRE, t.CREAM, (150, 44, 40)), (t.TEAL, t.LEAF, t.CREAM, (30, 92, 96))
    sides = [t.tiles(9, 9, 28, 1, warm), t.tiles(9, 9, 28, 2), t.tiles(9, 9, 28, 3, cool)]
    return np.concatenate([*sides, t.tiles(9, 9, 28, 4, (t.CREAM, (214, 206, 190), (196, 190, 180)))], 1)


CUBE = partial(meshes.box, 1.0, 1.0, 1.0)
SHEET_DOWN = meshes.ceiling
RABBIT, RABBIT_TEXTURE = (lambda: rabbit()[0]), (lambda: textures.patchwork(rabbit()[1], 14, 6, seed=5))
FLOOR_BOARDS = partial(textures.planks, 20, 20, 40, 6)
FLOOR_CHECKS = partial(textures.checkerboard, 24, 24, 16, textures.CREAM, (120, 126, 134))
FLOOR_TILES = partial(textures.tiles, 18, 18, 28, 8)
ROUND_TILES = partial(textures.tiles, 36, 9, 28, 9)
ROUND_LETTERS = partial(textures.lettered, 36, 9, 28, 10)
DRUM_LETTERS = partial(textures.lettered, 16, 9, 28, 11)
PLASTER = partial(textures.plain, (226, 222, 214))
OAK = partial(textures.plain, (150, 108, 72))


def _round_room(wall: Callable[[], textures.Image], ground: Callable[[], textures.Image]) -> tuple[Body, ...]:
    """A round room of radius 1 from z = -0.75 to 0.85, lit from a lamp that moves below its ceiling."""
    return (
        Body("wall", partial(meshes.round_wall, 1.0, 1.62), wall, (0.0, 0.0, -0.76)),
        Body("floor", meshes.floor, ground, (0.0, 0.0, -0.75)),
        Body("ceiling", meshes.ceiling, PLASTER, (0.0, 0.0, 0.85)),
        Body(
            "lamp",
            meshes.ceiling,
            center=(Range(-0.08, 0.08), Range(-0.08, 0.08), 0.84),
            size=0.9,
            radiance=Range(1.5, 2.3),
        ),
    )


CORNELL = Scene(
    "cornell",
    "A glass teapot and a glass sphere before textured walls: curved glass whose refractions fold and invert.",
    (
        Body("walls", meshes.walls, cornell_walls, (0.0, 0.0, -1.0)),
        Body("floor", meshes.floor, FLOOR_BOARDS, (0.0, 0.0, -0.99)),
        Body("ceiling", meshes.ceiling, PLASTER, (0.0, 0.0, 0.99)),
        Body(
            "lamp",
            meshes.ceiling,
            center=(Range(-0.1, 0.1), Range(-0.1, 0.1), 0.97),
            size=0.85,
            radiance=Range(2.2, 3.2),
        ),
        Body(
            "teapot",
            teapot,
            center=(Range(-0.32, -0.2), Range(0.1, 0.4), -1.015),
            size=0.5,
            turn=Range(0, 360),
            ior=Range(1.3, 1.7),
        ),
        Body("sphere", None, center=(Range(0.3, 0.42), Range(-0.05, 0.3), -0.765), size=0.22, ior=Range(1.3, 1.7)),
    ),
    Eye((0.0, 0.2, -0.7), Range(-30, 30), Range(2, 22), Range(1.0, 1.12), 54.0),
)

HEMISPHERE = Scene(
    "hemisphere",
    "A large glass hemisphere with an egg of denser glass in it, flat side towards a turning drum: many refracted rays "
    "land beside, behind or above the picture.",
    (
        *_round_room(ROUND_TILES, FLOOR_CHECKS),
        Body("drum", meshes.drum, DRUM_LETTERS, (Range(-0.15, 0.15), 0.62, -0.1), 0.25, Range(0, 360)),
        Body("stand", partial(meshes.drum, 128, 1.5), OAK, (0.0, 0.0, -0.56), 0.24),
        Body(
            "hemisphere",
            meshes.hemisphere,
            center=(0.0, 0.0, 0.0),
            size=0.36,
            turn=Range(130, 230),
            tilt=90.0,
            ior=Range(1.45, 1.65),
        ),
        Body(
            "egg",
            meshes.egg,
            center=(Range(-0.14, 0.14), Range(-0.1, 0.1), 0.46),
            size=0.32,
            turn=Range(0, 180),
            tilt=Range(40, 110),
            ior=Range(1.8, 2.1),
            inside="hemisphere",
        ),
    ),
    Eye((0.0, -0.06, 0.0), Range(-45, 45), Range(-8, 28), Range(0.8, 0.88), 50.0),
)

CHECKER = Scene(
    "checker",
    "A finely checkered rabbit, its texture cut into 36 turned and shuffled charts, behind a glass sphere and a plate "
    "of rippled glass: texture coordinates jump everywhere, world coordinates do not.",
    (
        *_round_room(ROUND_LETTERS, FLOOR_BOARDS),
        Body("rabbit", RABBIT, RABBIT_TEXTURE, (0.0, Range(0.42, 0.48), -0.75), 0.7, Range(-130, -50)),
        Body(
            "sphere",
            None,
            center=(Range(-0.13, -0.01), Range(-0.54, -0.5), Range(-0.32, -0.14)),
            size=0.1,
            ior=Range(1.3, 1.7),
        ),
        Body(
            "plate",
            ripple_glass,
            center=(Range(0.1, 0.22), Range(-0.22, -0.16), -0.39),
            turn=Range(-20, 20),
            ior=Range(1.3, 1.7),
        ),
    ),
    Eye((0.0, 0.1, -0.35), Range(-30, 30), Range(2, 22), Range(0.98, 1.03), 54.0),
)

TIR = Scene(
    "tir",
    "A glass cube and two prisms seen past the critical angle: whole faces are mirrors.",
    (
        *_round_room(ROUND_TILES, FLOOR_CHECKS),
        Body(
            "cube",
            CUBE,
            center=(Range(-0.3, -0.24), Range(-0.05, 0.15), -0.563),
            size=0.36,
            turn=Range(0, 90),
            ior=Range(1.4, 1.7),
        ),
        Body(
            "prism",
            triangle_prism,
            center=(Range(0.22, 0.3), Range(-0.3, -0.15), -0.745),
            size=0.34,
            turn=Range(0, 180),
            ior=Range(1.4, 1.7),
        ),
        Body(
            "roof",
            right_prism,
            center=(Range(0.16, 0.26), Range(0.4, 0.5), -0.745),
            size=0.5,
            turn=Range(-40, 40),
            ior=Range(1.4, 1.7),
        ),
    ),
    Eye((0.0, 0.1, -0.62), Range(-40, 40), Range(12, 40), Range(0.92, 1.0), 54.0),
)

SCENES = {scene.name: scene for scene in (CORNELL, HEMISPHERE, CHECKER, TIR)}
