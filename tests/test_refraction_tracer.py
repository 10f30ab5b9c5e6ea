"""Bodies baked from what cameras on one side see of them, and the paths through them against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from refraction_toy import interrupt_parts, make_toy_frames, toy_frame, view

from catacaustics.config import RefractTrainConfig
from catacaustics.errors import UserError
from catacaustics.geometry import normalize
from catacaustics.refraction import meshes
from catacaustics.refraction import train as training
from catacaustics.refraction.bodies import Cloud, Sight, Surface, bake_bodies, bake_body, joined, make_sight
from catacaustics.refraction.buffers import frame_buffers, frame_screen
from catacaustics.refraction.evaluate import render_frame
from catacaustics.refraction.follow import (
    Mesh,
    Placed,
    Stand,
    Tracer,
    bake_tracer,
    camera_position,
    seen_mesh,
    tracer_like,
)
from catacaustics.refraction.frames import open_frames
from catacaustics.refraction.measures import landing_regions
from catacaustics.refraction.models import load_model, load_part
from catacaustics.refraction.networks import SIZES
from catacaustics.refraction.scenes import ripple_glass
from catacaustics.refraction.trace import land
from catacaustics.refraction.train import train

EYES = [np.array([x, y, 2.4]) for x in (-0.8, 0.0, 0.8) for y in (-0.5, 0.5)]
"""All of them look from z > 0: nobody sees the backs."""
IOR = 1.5


def mesh_of(made: meshes.Mesh) -> Mesh:
    """A mesh of the scenes as something that rays are cast at."""
    return Mesh(Surface(made.vertices, made.faces, made.normals[made.faces]))


def seen_from(mesh: Mesh, eye: np.ndarray, side: int = 160) -> tuple[Cloud, Sight]:
    """What a camera at `eye`, which looks along -z, sees of a mesh."""
    to_clip, rays = view(eye, side)
    flat = rays.reshape(-1, 3)
    distance, _, normal = mesh.meet(np.broadcast_to(eye, flat.shape), flat)
    hit = np.isfinite(distance)
    points = eye + np.where(hit, distance, 0)[:, None] * flat
    depth = (eye[2] - points[:, 2]).reshape(side, side)
    return Cloud(points[hit], normal[hit]), make_sight(to_clip, hit.reshape(side, side), depth)


def baked(made: meshes.Mesh) -> Surface:
    clouds, sights = zip(*(seen_from(mesh_of(made), eye) for eye in EYES), strict=True)
    surface = bake_body(joined(clouds), sights)
    assert surface is not None
    return surface


def ball(rows: int = 200) -> meshes.Mesh:
    t = np.linspace(0, np.pi, rows)
    profile = np.stack([np.sin(t), np.cos(t)], -1)
    return meshes.lathe(profile, profile, 400)


def scaled(made: meshes.Mesh, size: float, rotation=None) -> meshes.Mesh:
    return made.moved(np.eye(3) if rotation is None else np.array(rotation, float), np.zeros(3), size)


def leaving(surfaces, iors, origins, directions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where rays leave bodies, which way, and how many events they had."""
    bodies = [
        Placed(s if isinstance(s, Mesh) else Mesh(s), np.eye(3), np.zeros(3), 1.0, ior)
        for s, ior in zip(surfaces, iors, strict=True)
    ]
    stand = Stand(bodies, None)
    found = land(stand.intersect, stand.media, origins, normalize(directions))
    assert (found.body == stand.beyond).mean() > 0.99
    return found.position + found.normal, -found.normal, found.events


def degrees_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((normalize(a) * normalize(b)).sum(-1), -1, 1)))


def beam(heights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays along -z at distances from the z axis, from z = 2, and unit vectors from the axis to them."""
    turn = np.linspace(0, 20, len(heights))
    aside = np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
    return heights[:, None] * aside + [0, 0, 2.0], np.broadcast_to([0.0, 0.0, -1.0], aside.shape), aside


def bent(aside: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """The direction -z, turned towards the axis."""
    return -np.sin(angle)[:, None] * aside - np.cos(angle)[:, None] * [0, 0, 1.0]


# Bodies ----------------------------------------------------------------------------------------------------------


def test_a_ball_of_which_only_the_front_was_seen_bends_rays_as_a_ball_lens():
    surface, radius = baked(scaled(ball(), 0.4)), 0.4
    heights = np.linspace(0.01, 0.36, 200)
    origins, directions, aside = beam(heights)
    _, found, events = leaving([surface], [IOR], origins, directions)
    angle = 2 * (np.arcsin(heights / radius) - np.arcsin(heights / radius / IOR))
    assert (events == 2).all()
    assert np.quantile(degrees_between(found, bent(aside, angle)), 0.95) < 0.3


def test_a_slab_whose_back_nobody_saw_shifts_rays_and_keeps_their_direction():
    surface, half = baked(meshes.box(0.8, 0.8, 0.5)), 0.25
    slope = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 2))
    directions = normalize(np.insert(slope, 2, -1.0, axis=1))
    start, found, events = leaving([surface], [IOR], np.array([[0.0, 0.0, 0.5]]) - 0.1 * directions, directions)
    sine = np.linalg.norm(directions[:, :2], axis=-1)
    inside = directions[:, :2] / sine[:, None] * np.tan(np.arcsin(sine / IOR))[:, None]
    entry = np.array([0.0, 0.0, 0.5]) + directions * ((0.5 - half) / -directions[:, 2:])
    assert (events == 2).all()
    assert degrees_between(found, directions).max() < 0.5
    assert np.abs(start[:, :2] - (entry[:, :2] + 2 * half * inside)).max() < 2e-3
    assert surface.vertices[:, 2].min() == pytest.approx(-half, abs=5e-3)


def test_light_is_totally_reflected_at_the_side_of_a_baked_box():
    surface = baked(scaled(meshes.box(1.0, 1.0, 1.0), 0.6))
    incidence = np.radians(np.linspace(50, 75, 40))
    directions = np.stack([np.sin(incidence), 0.05 + 0 * incidence, -np.cos(incidence)], -1)
    directions = normalize(directions)
    _, found, events = leaving([surface], [IOR], np.array([0.1, 0.0, 0.3]) - 0.2 * directions, directions)
    assert (events == 3).all()
    assert degrees_between(found, directions * [-1, 1, 1]).max() < 0.5


def test_the_dome_of_half_a_ball_goes_on_from_the_crescent_that_was_seen_beside_its_flat_side():
    radius = 0.5
    surface = baked(scaled(meshes.hemisphere(), radius, np.diag([1.0, -1, -1])))
    assert surface.vertices[:, 2].max() < 0.01
    heights = np.linspace(0.01, 0.28, 100)
    origins, directions, aside = beam(heights)
    _, found, events = leaving([surface], [IOR], origins, directions)
    angle = np.arcsin(IOR * heights / radius) - np.arcsin(heights / radius)
    assert (events == 2).all()
    assert np.quantile(degrees_between(found, bent(aside, angle)), 0.95) < 0.5


def test_a_ball_within_a_ball_bends_rays_at_both_by_bouguers_law():
    (outer, inner), (first, second) = (0.5, 0.25), (1.4, 1.8)
    surfaces = [baked(scaled(ball(), radius)) for radius in (outer, inner)]
    heights = np.linspace(0.01, 0.22, 100)
    origins, directions, aside = beam(heights)
    _, found, events = leaving(surfaces, [first, second], origins, directions)
    steps = [heights / outer, heights / outer / first, heights / inner / first, heights / inner / second]
    a, b, c, d = (np.arcsin(step) for step in steps)
    assert (events == 4).all()
    assert np.quantile(degrees_between(found, bent(aside, 2 * (a - b + c - d))), 0.95) < 0.5


def test_a_wavy_plate_is_baked_with_its_unseen_back_nearly_as_it_is():
    made = scaled(ripple_glass(), 1.0, [[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    rng = np.random.default_rng(0)
    origins = np.concatenate([rng.uniform(-0.15, 0.15, (300, 2)), np.full((300, 1), 1.0)], -1)
    directions = normalize(np.insert(rng.uniform(-0.1, 0.1, (300, 2)), 2, -1.0, axis=1))
    truth = leaving([mesh_of(made)], [IOR], origins, directions)
    found = leaving([baked(made)], [IOR], origins, directions)
    same = truth[2] == found[2]
    assert same.mean() > 0.97
    assert np.median(degrees_between(found[1], truth[1])[same]) < 0.3


def test_a_body_of_which_a_few_points_were_seen_is_not_baked():
    cloud, sight = seen_from(mesh_of(scaled(ball(), 0.4)), EYES[0], side=24)
    assert bake_body(cloud, [sight]) is None


def test_a_body_of_which_one_flat_face_was_seen_is_not_baked():
    places = np.random.default_rng(0).uniform(-0.4, 0.4, (3000, 2))
    face = Cloud(np.insert(places, 2, 0.0, axis=1), np.broadcast_to([0.0, 0.0, 1.0], (3000, 3)))
    assert bake_body(face, []) is None


# Frames ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def balls():
    rng = np.random.default_rng(4)
    return [toy_frame(rng, 48, 128, balls=1, twice=True) for _ in range(12)]


@pytest.fixture(scope="module")
def tracer(balls):
    made, told = bake_tracer(balls[:10], SIZES["small"])
    assert made is not None, told
    return made.eval()


def test_paths_through_bodies_baked_from_frames_lead_to_the_landing_points_of_others(tracer, balls):
    for frame in balls[10:]:
        aimed = np.degrees(tracer.aim(frame_buffers(frame)))
        assert np.median(aimed) < 0.5
        with torch.no_grad():
            normal, place, light, seen = tracer(frame_buffers(frame))[0, :8].split([3, 3, 1, 1])
        shown = seen[0].numpy() > 0
        assert shown.sum() > 50
        error = np.linalg.norm(place.movedim(0, -1).numpy() - frame.landing, axis=-1)
        assert np.median(error[shown]) < 0.02
        facing = (normal.movedim(0, -1).numpy() * frame.landing_normal).sum(-1)
        assert np.median(facing[shown]) > 0.99
        ior = float(frame.object_ior[0])
        head_on = 4 * ior / (1 + ior) ** 2  # what is not reflected, by Fresnel
        assert light[0].numpy()[shown].max() == pytest.approx(head_on**2, abs=1e-3)


def test_where_paths_do_not_lead_to_the_landing_points_a_network_is_to_learn_them():
    rng = np.random.default_rng(4)  # the toy's own balls bend light only once
    made, told = bake_tracer([toy_frame(rng, 48, 64, balls=1) for _ in range(10)], SIZES["small"])
    assert made is None
    assert "a network learns the paths" in told
    made, told = bake_tracer([toy_frame(rng, 16, 32, balls=0)], SIZES["small"])
    assert made is None
    assert "too few frames" in told


def test_a_tracer_is_the_same_after_its_weights_were_stored(tracer, balls):
    weights = {name: value.clone() for name, value in tracer.state_dict().items()}
    again = tracer_like(weights, SIZES["small"])
    assert again is not None
    again.load_state_dict(weights)
    buffers = frame_buffers(balls[0])
    with torch.no_grad():
        assert torch.equal(again.eval()(buffers), tracer(buffers))
    assert tracer_like({"first.weight": torch.zeros(1)}, SIZES["small"]) is None


def test_a_body_that_was_not_baked_is_no_obstacle_and_lands_nowhere(balls):
    tracer = Tracer([None], SIZES["small"]).eval()
    with torch.no_grad():
        assert not tracer(frame_buffers(balls[0])).any()


def test_bodies_are_known_by_number_in_whatever_order_they_come():
    frames = [toy_frame(np.random.default_rng(i), 48, 64, balls=2) for i in range(8)]
    tracer = Tracer(bake_bodies(frames), SIZES["small"]).eval()
    buffers = frame_buffers(frames[0])
    turned = buffers._replace(**{n: getattr(buffers, n).flip(1) for n in ("objects", "poses", "bodies")})
    with torch.no_grad():
        torch.testing.assert_close(tracer(turned), tracer(buffers), atol=1e-5, rtol=0)


def test_the_camera_stands_where_its_projection_says():
    eye = np.array([0.3, -0.2, 2.4])
    np.testing.assert_allclose(camera_position(view(eye, 8)[0]), eye, atol=1e-12)


def test_the_seen_scene_is_torn_where_a_near_wall_ends_before_a_far_one():
    x, y = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-1, 1, 40))
    z = np.where(x < 0, 0.0, -1.0)
    mesh = seen_mesh(np.stack([x, y, z], -1), np.broadcast_to([0.0, 0.0, 1.0], (40, 40, 3)))
    origins = np.array([[-0.5, 0, 1], [0.5, 0, 1], [0.0, 0, 1]])
    distance, _, normal = mesh.meet(origins, np.broadcast_to([0.0, 0.0, -1.0], (3, 3)))
    assert distance == pytest.approx([1, 2, np.inf])
    assert normal[:2] == pytest.approx(np.array([[0, 0, 1]] * 2), abs=1e-6)


# Training --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return make_toy_frames(tmp_path_factory.mktemp("glass"), 48, balls=1, twice=True, train=8)


def test_hybrid_trains_a_tracer_that_is_the_same_when_loaded_and_no_other_model_takes(data, tmp_path, capsys):
    config = RefractTrainConfig(data, tmp_path / "run", steps=20, batch=2, crop=16)
    model = train(config)
    assert isinstance(model.generator, Tracer)
    assert "paths through 1 of 1 bodies" in capsys.readouterr().out
    frames = open_frames(data)
    loaded = load_model(config.run, frames)
    frame = frames.split("test")[0]
    with torch.no_grad():
        images = [one(frame_buffers(frame), frame_screen(frame)) for one in (model, loaded)]
    assert torch.equal(*images)
    view = render_frame(loaded, frame)
    shown = landing_regions(frame)["seen"]
    assert np.abs(view.looked_up - view.true_color)[shown].mean() < 0.1  # 20 texels a checker, a pixel covers many
    ssnrb = replace(config, run=tmp_path / "b", model="ssnrb", generator=config.run / "generator.safetensors")
    with pytest.raises(UserError, match="generator of hybrid"):
        train(ssnrb)


def test_what_baking_and_learning_leave_of_the_minutes_goes_to_the_renderer(data, tmp_path, monkeypatch):
    parts = {}

    def stopped(state, part, *rest):
        state.seconds = 60 * part.minutes
        parts[part.name] = part

    monkeypatch.setattr(training, "_loop", stopped)
    train(RefractTrainConfig(data, tmp_path / "run", minutes=10.0, generator_share=0.4))
    assert 0 < parts["generator"].spent < 60
    assert parts["generator"].minutes == pytest.approx(parts["generator"].spent / 60 + 0.25 * 4)
    assert sum(part.minutes for part in parts.values()) == pytest.approx(10)


def test_an_interrupted_training_of_a_tracer_goes_on_to_the_same_weights(data, tmp_path, monkeypatch):
    config = RefractTrainConfig(data, tmp_path / "whole", steps=8, batch=2, crop=16, checkpoint_minutes=1e-9)
    train(config)
    interrupt_parts(monkeypatch, {"generator": 5, "renderer": 3})
    cut = replace(config, run=tmp_path / "cut", resume=True)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            train(cut)
    train(cut)
    for part in ("generator", "renderer"):
        whole, again = (load_part(run / f"{part}.safetensors")[0] for run in (config.run, cut.run))
        assert all(torch.equal(whole[k], again[k]) for k in whole)
