"""The scenes that can be made, by name."""

import zlib

import numpy as np

from catacaustics.errors import UserError
from scene_maker import textures as tx
from scene_maker.model import Arcs, Reflector, SceneModel
from scene_maker.rooms import Brush, garden, room, table, tableware
from scene_maker.solids import Surface, bent_sheet, box, ellipsoid, joined, revolved, sheet, tube, with_texture

TOP = 0.72
"""Height of the table top."""


def _foot(brush: Brush, height: float, inner: float = 0.075, x: float = 0.0) -> Surface:
    """A ring on the table that carries a round thing."""
    ring = revolved(np.array([[inner, height], [inner + 0.02, height], [inner + 0.035, 0.0]]))
    return with_texture(ring, brush(tx.shapes, tx.WARM), 0.06, 0.6, 600).moved((x, 0, TOP + 0.002))


def ball(brush: Brush) -> SceneModel:
    """A silver ball on a table in a living room."""
    center = (0.0, 0.0, TOP + 0.246)
    surfaces, lights = room(brush)
    surfaces += [*table(brush), *tableware(brush), _foot(brush, 0.03)]
    sphere = Reflector("ball", {"type": "sphere", "center": list(center), "radius": 0.22})
    return SceneModel(surfaces, lights, [sphere], [Arcs(center, 1.1)])


def vase(brush: Brush) -> SceneModel:
    """A glazed, painted vase: a clear coat over colour."""
    from scipy.interpolate import CubicSpline

    # Radius and height from inside the neck over the lip to the foot.
    knots = np.array([[0.045, 0.40], [0.055, 0.45], [0.075, 0.478], [0.092, 0.475], [0.082, 0.452], [0.064, 0.41],
                      [0.085, 0.36], [0.135, 0.28], [0.152, 0.2], [0.132, 0.11], [0.094, 0.04], [0.09, 0]])  # fmt: skip
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    profile = CubicSpline(along, knots)(np.linspace(0, along[-1], 160))
    foot = (0.0, 0.0, TOP + 0.004)
    surfaces, lights = room(brush)
    surfaces += [*table(brush), *tableware(brush)]
    palette = [(16, 30, 66), (22, 52, 104), (38, 84, 128), (20, 60, 84), (176, 140, 70), (150, 60, 50)]
    paint = brush(tx.shapes, palette, 0.25)(512, 1024)
    geometry = {"type": "revolution", "center": list(foot), "axis": [0, 0, 1], "profile": profile.round(6).tolist()}
    glazed = Reflector("vase", geometry, revolved(profile, 192).moved(foot), (1.0, 1.0, 1.0), paint)
    return SceneModel(surfaces, lights, [glazed], [Arcs((0, 0, TOP + 0.22), 0.95, held_out=(40, 270, 14, 38))])


def bowl(brush: Brush) -> SceneModel:
    """A silver bowl, a thin spherical cap that opens upwards: concave inside, convex outside."""
    radius, half_angle = 0.27, np.radians(68)
    center = (0.0, 0.0, TOP + 0.035 + radius)
    surfaces, lights = room(brush)
    surfaces += [*table(brush), *tableware(brush), _foot(brush, 0.04)]
    geometry = {"type": "spherical_cap", "center": list(center), "radius": radius, "axis": [0, 0, -1],
                "half_angle_degrees": 68.0}  # fmt: skip
    shell = ellipsoid((radius,) * 3, 160, 384, (np.pi - half_angle, np.pi)).moved(center)
    arcs = Arcs((0, 0, TOP + 0.1), 0.98, (24, 42, 60), held_out=(60, 290, 32, 52))
    return SceneModel(surfaces, lights, [Reflector("bowl", geometry, shell)], [arcs])


def blade(brush: Brush) -> SceneModel:
    """A bent steel sheet standing upright: a convex and a concave side."""
    radius, arc, height = 0.34, np.radians(95), 0.4
    axis = (-0.28, 0.0, TOP + 0.012)
    surfaces, lights = room(brush)
    surfaces += [*table(brush), *tableware(brush)]
    geometry = {"type": "cylinder_patch", "center": list(axis), "radius": radius, "axis": [0, 0, 1],
                "middle": [1, 0, 0], "arc_degrees": 95.0, "height": height}  # fmt: skip
    steel = Reflector("blade", geometry, bent_sheet(radius, arc, height).moved(axis))
    return SceneModel(surfaces, lights, [steel], [Arcs((-0.03, 0, TOP + 0.2), 1.05, (7, 24, 44))])


def kettle(brush: Brush) -> SceneModel:
    """A polished kettle with handle, lid and spout, outdoors below the sky."""
    center, radii = np.array([0.0, 0.0, TOP + 0.17]), (0.19, 0.19, 0.155)
    turn = np.linspace(0, np.pi, 48)
    handle = np.stack([0.14 * np.cos(turn), 0 * turn, 0.1 + 0.15 * np.sin(turn)], -1)
    t = 1 - np.linspace(1, 0, 96) ** 1.5
    spout = np.stack([0.13 + 0.17 * t, 0 * t, -0.05 + 0.2 * t**1.7], -1)
    spout_radius = (0.045 - 0.024 * t) * np.sqrt(np.clip((1.0001 - t) / 0.04, 0, 1))  # rounded off at its end
    knob = ellipsoid((0.03, 0.03, 0.026), 32, 64).moved((0, 0, 0.172))
    lid = ellipsoid((0.085, 0.085, 0.022), 32, 96).moved((0, 0, 0.142))
    parts = [ellipsoid(radii, 160, 320), tube(handle, np.full(48, 0.014)), tube(spout, spout_radius), knob, lid]
    geometry = {"type": "ellipsoid", "center": center.tolist(), "radii": list(radii), "rotation": np.eye(3).tolist(),
                "note": "the body; handle, lid and spout are in the mesh"}  # fmt: skip
    surfaces = [*garden(brush), *table(brush), *tableware(brush), _foot(brush, 0.03)]
    steel = Reflector("kettle", geometry, joined(parts).moved(center))
    sky = tx.sky(brush.rng, 512, 1024, (0.31, 0.27))
    arcs = Arcs((0, 0, TOP + 0.19), 1.0, (8, 26, 46))
    return SceneModel(surfaces, [], [steel], [arcs], sky, 1.25)


def mirror(brush: Brush) -> SceneModel:
    """A flat mirror that stands on a table; it is seen from its front only."""
    width, height, y = 0.64, 0.48, 0.2
    left, base = -width / 2, TOP + 0.045
    surfaces, lights = room(brush)
    frame = brush(tx.planks, tx.WOOD)
    surfaces += [*table(brush), *tableware(brush, reach=0.36)]
    surfaces += box((0, y + 0.014, TOP + 0.003), (width + 0.08, 0.024, height + 0.08), frame, density=500)
    surfaces += box((0, y + 0.09, TOP + 0.003), (0.3, 0.12, 0.06), frame, density=500)
    corner, right, down = (left, y, base + height), (width, 0, 0), (0, 0, -height)
    corners = [corner, (left + width, y, base + height), (left + width, y, base), (left, y, base)]
    glass = Reflector("mirror", {"type": "plane", "corners": [list(c) for c in corners]}, sheet(corner, right, down))
    arcs = Arcs((0, y, base + height / 2), 1.15, (4, 18, 36), (208, 332), (218, 322, 10, 28))
    return SceneModel(surfaces, lights, [glass], [arcs])


def pair(brush: Brush) -> SceneModel:
    """Two reflectors far apart on a long table: a silver ball and a golden egg."""
    surfaces, lights = room(brush, 3.3, 2.6)
    surfaces += [*table(brush, (2.4, 1.0)), *tableware(brush, center=-0.8), *tableware(brush, center=0.8)]
    surfaces += [_foot(brush, 0.03, x=-0.8), _foot(brush, 0.03, 0.06, x=0.8)]
    ball_center, egg_center, egg_radii = (-0.8, 0.0, TOP + 0.226), (0.8, 0.0, TOP + 0.262), (0.16, 0.16, 0.24)
    sphere = Reflector("ball", {"type": "sphere", "center": list(ball_center), "radius": 0.2})
    geometry = {
        "type": "ellipsoid",
        "center": list(egg_center),
        "radii": list(egg_radii),
        "rotation": np.eye(3).tolist(),
    }
    egg = Reflector("egg", geometry, ellipsoid(egg_radii, 160, 320).moved(egg_center), (0.95, 0.78, 0.45))
    arcs = [Arcs(c, 1.1, (14, 38), held_out=(190, 350, 18, 36)) for c in (ball_center, egg_center)]
    return SceneModel(surfaces, lights, [sphere, egg], arcs)


SCENES = {"ball": ball, "vase": vase, "bowl": bowl, "blade": blade, "kettle": kettle, "mirror": mirror, "pair": pair}


def build(name: str, seed: int = 0, detail: float = 1.0) -> SceneModel:
    """A scene by name. The same seed gives the same scene; `detail` below 1 draws smaller textures, for tests.

    Raises:
        UserError: there is no such scene.
    """
    if name not in SCENES:
        raise UserError(f"There is no scene {name}.", f"one of {', '.join(SCENES)}", "name one of them")
    return SCENES[name](Brush(np.random.default_rng([seed, zlib.crc32(name.encode())]), detail))
