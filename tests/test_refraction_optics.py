"""R-buffer truth against closed forms: slab, ball, prism, total internal reflection; every path landed by hand."""

import numpy as np
import pytest

from catacaustics.errors import UserError
from catacaustics.geometry import normalize
from catacaustics.refraction import meshes
from catacaustics.refraction.optics import dominant_event, fresnel
from catacaustics.refraction.scenes import Body, Eye, Scene
from catacaustics.refraction.stage import Stage
from catacaustics.refraction.trace import land
from catacaustics.refraction.variants import VECTORISED, choose_variant

pytest.importorskip("mitsuba")

SIZE = 2.0
"""Of the scenes: they fill [-1, 1]^3."""
EYE = Eye((0.0, 0.0, 0.0), 0.0, 0.0, 0.5)


@pytest.fixture(autouse=True, scope="module")
def _mitsuba():
    try:
        choose_variant("auto", VECTORISED)
    except UserError as error:
        pytest.skip(str(error))


def room(*bodies: Body, half: float = 1.0) -> Stage:
    """Bodies in a closed box with walls at -half and half."""
    shell = (
        Body("walls", meshes.walls, center=(0.0, 0.0, -half), size=half),
        Body("floor", meshes.floor, center=(0.0, 0.0, -half), size=half),
        Body("ceiling", meshes.ceiling, center=(0.0, 0.0, half), size=half),
    )
    return Stage(Scene("test", "", (*shell, *bodies), EYE))


def landings(stage: Stage, origins, directions):
    return land(stage.intersect, stage.media, np.asarray(origins, float), normalize(np.asarray(directions, float)))


def assert_near(found: np.ndarray, expected: np.ndarray) -> None:
    assert np.linalg.norm(found - expected, axis=-1).max() < 1e-4 * SIZE


def test_a_flat_slab_shifts_a_ray_sideways_by_what_snells_law_says():
    n, thick, rng = 1.52, 0.3, np.random.default_rng(0)
    stage = room(Body("slab", lambda: meshes.box(1.9, thick, 1.9), ior=n))
    side = rng.uniform(-0.5, 0.5, (500, 2))
    directions = normalize(np.insert(side, 1, 1.0, axis=1))
    origins = np.stack([rng.uniform(-0.1, 0.1, 500), np.full(500, -0.7), rng.uniform(-0.1, 0.1, 500)], -1)
    sine = np.linalg.norm(directions[:, [0, 2]], axis=-1)  # of the angle of incidence
    inside = np.tan(np.arcsin(sine / n)) / np.tan(np.arcsin(sine))  # slope in glass over slope in air
    shift = side * (1.7 - thick + thick * inside[:, None])  # 1.7: from the origins to the wall at y = 1
    expected = np.stack([origins[:, 0] + shift[:, 0], np.ones(500), origins[:, 2] + shift[:, 1]], -1)
    found = landings(stage, origins, directions)
    assert found.refractive.all()
    assert (found.events == 2).all()
    assert not found.internal.any()
    assert_near(found.position, expected)


def to_walls(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Where rays from inside the room [-1, 1]^3 meet its walls."""
    still = directions == 0
    way = np.where(still, np.inf, (np.sign(directions) - points) / np.where(still, 1, directions))
    return points + way.min(-1, keepdims=True) * directions


def turned(angle: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The direction +y, turned by an angle away from a unit vector across it."""
    return np.cos(angle)[:, None] * [0.0, 1.0, 0.0] - np.sin(angle)[:, None] * axis


def test_a_ball_lens_bends_a_ray_twice_by_the_difference_of_its_angles():
    n, radius = 1.5, 0.4
    stage = room(Body("ball", None, size=radius, ior=n))
    height, azimuth = np.linspace(0.002, 0.39, 300), np.linspace(0, 20, 300)
    axis = np.stack([np.cos(azimuth), np.zeros(300), np.sin(azimuth)], -1)  # the ray's plane holds y and this
    outer, inner = np.arcsin(height / radius), np.arcsin(height / radius / n)
    entry = height[:, None] * axis - np.sqrt(radius**2 - height**2)[:, None] * [0.0, 1.0, 0.0]
    leaves = entry + 2 * radius * np.cos(inner)[:, None] * turned(outer - inner, axis)
    expected = to_walls(leaves, turned(2 * (outer - inner), axis))
    found = landings(stage, height[:, None] * axis - [0, 0.8, 0], np.broadcast_to([0.0, 1.0, 0.0], (300, 3)))
    assert (found.events == 2).all()
    assert_near(found.position, expected)


def test_rays_near_the_axis_of_a_ball_lens_meet_at_its_focal_length():
    n, radius = 1.7, 0.5
    focus = n * radius / (2 * (n - 1))  # from the centre
    stage = room(Body("ball", None, size=radius, ior=n))
    height = np.array([0.005, 0.01])
    found = landings(stage, [[h, -0.8, 0] for h in height], [[0, 1, 0]] * 2)
    meets = height / (height - found.position[:, 0]) * 1.0  # the line from (h, ~0) at the lens to the wall at y = 1
    assert meets == pytest.approx(focus, rel=2e-3)


PRISM = meshes.prism(np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, np.sqrt(0.75)]]), 1.0)
APEX = np.radians(60)


def prism_directions(n: float, incidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions of rays behind an equilateral prism, by where they land in rooms of two sizes; and before it."""
    normal = np.array([-np.cos(np.radians(30)), 0.0, np.sin(np.radians(30))])  # of the left face
    up = np.array([np.sin(np.radians(30)), 0.0, np.cos(np.radians(30))])  # along it
    middle = np.array([-0.25 * 0.6, 0.0, np.sqrt(0.75) / 2 * 0.6]) - [0, 0, 0.15]
    directions = -np.cos(incidence)[:, None] * normal + np.sin(incidence)[:, None] * up
    origins = middle - 0.3 * directions
    places = []
    for half in (0.7, 1.0):
        stage = room(Body("prism", lambda: PRISM, center=(0.0, 0.0, -0.15), size=0.6, ior=n), half=half)
        found = landings(stage, origins, directions)
        assert (found.events == 2).all()
        places.append(found.position)
    return normalize(places[1] - places[0]), directions


def test_a_prism_deviates_rays_by_the_closed_form_and_never_less_than_its_minimum():
    n = 1.5
    incidence = np.radians(np.linspace(35, 75, 81))
    after, before = prism_directions(n, incidence)
    deviation = np.arccos((after * before).sum(-1))
    sine = np.sin(incidence)
    expected = incidence - APEX + np.arcsin(np.sin(APEX) * np.sqrt(n**2 - sine**2) - np.cos(APEX) * sine)
    assert np.abs(deviation - expected).max() < 1e-4
    minimum = 2 * np.arcsin(n * np.sin(APEX / 2)) - APEX
    assert deviation.min() == pytest.approx(minimum, abs=1e-4)
    assert np.degrees(incidence[deviation.argmin()]) == pytest.approx(np.degrees((minimum + APEX) / 2), abs=0.5)


def test_at_minimum_deviation_the_ray_crosses_the_prism_level_and_lands_by_symmetry():
    n = 1.6
    half_turn = np.arcsin(n * np.sin(APEX / 2)) - APEX / 2  # half of the minimum deviation
    direction = np.array([np.cos(half_turn), 0.0, np.sin(half_turn)])
    entry = np.array([-0.25 * 0.6, 0.0, np.sqrt(0.75) / 2 * 0.6 - 0.15])  # the middle of the left face
    stage = room(Body("prism", lambda: PRISM, center=(0.0, 0.0, -0.15), size=0.6, ior=n))
    found = landings(stage, [entry - 0.4 * direction], [direction])
    expected = to_walls((entry * [-1, 1, 1])[None], (direction * [1, 1, -1])[None])
    assert_near(found.position, expected)


def cube_path(n: float, incidence: np.ndarray, x: float):
    """Rays into the top face of a cube of half-side 0.3, at `x` on it, which meet its right face from inside.

    Returns what is found, and for each ray where it would land unhindered in an endless slab of the cube's height.
    """
    stage = room(Body("cube", lambda: meshes.box(0.6, 0.6, 0.6), ior=n))
    directions = np.stack([np.sin(incidence), np.full(len(incidence), 0.05), -np.cos(incidence)], -1)
    directions = normalize(directions)
    entry = np.array([x, 0.0, 0.3])
    found = landings(stage, entry - 0.2 * directions, directions)
    sine = np.linalg.norm(directions[:, :2], axis=-1)
    inside = np.concatenate([directions[:, :2] / n, -np.sqrt(1 - (sine / n) ** 2)[:, None]], -1)
    bottom = entry + inside * (0.6 / -inside[:, 2:])
    return found, bottom, directions, inside


def test_a_totally_reflected_path_lands_at_the_mirror_image_of_the_unfolded_path():
    n = 1.5  # above the square root of 2: every ray that enters the top is reflected by the side
    found, bottom, directions, _ = cube_path(n, np.radians(np.linspace(50, 80, 61)), 0.1)
    assert (bottom[:, 0] > 0.3).all()  # they meet the side before the bottom
    mirrored, back = bottom * [-1, 1, 1] + [0.6, 0, 0], directions * [-1, 1, 1]
    assert found.internal.all()
    assert (found.events == 3).all()
    assert_near(found.position, to_walls(mirrored, back))


def test_at_the_critical_angle_total_reflection_begins_and_the_landing_point_follows_the_brighter_branch():
    n = 1.3
    critical = np.arcsin(np.sqrt(n**2 - 1))  # incidence on top for which the side is met at its critical angle
    around = np.array([-0.1, -0.01, -1e-3, 1e-3, 0.01, 0.1])
    stage = room(Body("cube", lambda: meshes.box(0.6, 0.6, 0.6), ior=n))
    incidence = critical + around
    directions = np.stack([np.sin(incidence), 0 * around, -np.cos(incidence)], -1)
    entry = np.array([0.2, 0.0, 0.3])
    found = landings(stage, entry - 0.2 * directions, directions)
    np.testing.assert_array_equal(found.internal, around < 0)
    # Inside, the cosine at the side is sin(incidence) / n.
    reflectance, _ = fresnel(np.sin(incidence) / n, np.full(6, 1 / n))
    np.testing.assert_allclose(reflectance[:3], 1)
    reflected = reflectance > 0.5
    assert 3 < reflected.sum() < 6  # just below the critical angle reflection still carries more light
    inside = np.stack([np.sin(incidence) / n, 0 * around, -np.sqrt(1 - (np.sin(incidence) / n) ** 2)], -1)
    side = entry + inside * (0.1 / inside[:, :1])
    mirrored = entry + inside * (0.6 / -inside[:, 2:])
    by_reflection = to_walls(mirrored * [-1, 1, 1] + [0.6, 0, 0], directions * [-1, 1, 1])
    outside = np.stack([np.sqrt(np.maximum(1 - (n * inside[:, 2]) ** 2, 0)), 0 * around, n * inside[:, 2]], -1)
    by_refraction = to_walls(side, outside)
    assert_near(found.position, np.where(reflected[:, None], by_reflection, by_refraction))


@pytest.mark.parametrize("n", [1.3, 1.5, 2.4])
def test_total_reflection_sets_in_exactly_at_the_critical_angle(n):
    critical = np.arcsin(1 / n)
    angle = critical + np.array([-1e-7, 1e-7])
    directions = np.stack([np.sin(angle), [0, 0], np.cos(angle)], -1)  # from within, towards the outward normal
    event = dominant_event(directions, np.array([[0.0, 0.0, 1.0]] * 2), np.full(2, n), np.ones(2))
    np.testing.assert_array_equal(event.total, [False, True])
    np.testing.assert_allclose(event.direction[1], directions[1] * [1, 1, -1], atol=1e-12)


def test_fresnel_reflects_4_percent_head_on_nothing_of_one_polarisation_at_brewsters_angle_and_all_at_grazing():
    n = np.array([1.5])
    assert fresnel(np.ones(1), n)[0] == pytest.approx(0.04)
    brewster = np.arctan(n)
    refracted = np.pi / 2 - brewster
    across = (np.sin(brewster - refracted) / np.sin(brewster + refracted)) ** 2
    assert fresnel(np.cos(brewster), n)[0] == pytest.approx(across / 2)
    assert fresnel(np.array([1e-6]), n)[0] == pytest.approx(1, abs=1e-4)


def test_an_egg_of_the_same_glass_as_what_encloses_it_is_invisible():
    ball = Body("ball", None, size=0.5, ior=1.5)
    egg = Body("egg", meshes.egg, center=(0.1, 0.05, -0.1), size=0.4, tilt=40.0, ior=1.5, inside="ball")
    x, z = np.meshgrid(np.linspace(-0.3, 0.3, 20), np.linspace(-0.3, 0.3, 20))
    origins = np.stack([x.ravel(), np.full(400, -0.9), z.ravel()], -1)
    directions = np.broadcast_to([0.0, 1.0, 0.0], (400, 3))
    plain, nested = landings(room(ball), origins, directions), landings(room(ball, egg), origins, directions)
    assert (nested.events == 4).sum() > 50
    assert_near(nested.position, plain.position)


def test_a_path_that_never_leaves_the_glass_lands_nowhere():
    stage = room(Body("cube", lambda: meshes.box(0.6, 0.6, 0.6), ior=2.5))
    found = land(stage.intersect, stage.media, np.array([[0.0, -0.9, 0.0]]), np.array([[0.0, 1.0, 0.0]]), 1)
    assert found.refractive.all()
    assert found.events[0] == 1
    assert found.body[0] == -1
    np.testing.assert_array_equal(found.position, 0)


def test_a_ray_that_meets_an_opaque_surface_first_has_no_landing():
    stage = room(Body("ball", None, size=0.3, ior=1.5))
    found = landings(stage, [[0.0, -0.9, 0.8]], [[0, 1, 0]])
    assert not found.refractive.any()
    assert found.body[0] == -1
    assert found.events[0] == 0
