"""Edits leave what they do not touch, and move what they do as they say."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from toy import BALL_CENTER, scene_of, write_run

from catacaustics import cli
from catacaustics.editing import (
    adjust_reflections,
    clone_reflector,
    decouple_reflections,
    reflector_index,
    replace_surroundings,
)
from catacaustics.errors import UserError
from catacaustics.geometry import sphere_directions
from catacaustics.reflectors.warps import PlaneWarp, QuadricWarp
from catacaustics.scene import Scene


@pytest.fixture(scope="module")
def ball(capture):
    return scene_of(capture, "sphere")


STILL = np.zeros(3), np.eye(3)


def test_a_warp_camera_at_no_offset_changes_nothing_and_elsewhere_only_reflections(capture, ball):
    camera = capture.held_out[0].camera
    plain = ball.render(camera)
    same = ball.render(camera, warp_camera=camera.displaced(np.zeros(3)))
    assert torch.equal(plain.rgb, same.rgb)
    moved = ball.render(camera, warp_camera=camera.displaced(np.array([0.5, 0, 0])))
    assert torch.equal(plain.primary_rgb, moved.primary_rgb)
    assert float((plain.reflection_rgb - moved.reflection_rgb).abs().max()) > 0.1


def test_a_moved_camera_moves_along_its_own_axes(capture):
    camera = capture.train[0].camera
    offset = np.array([0.1, -0.2, 0.3])
    moved = camera.displaced(offset)
    np.testing.assert_allclose(camera.camera_from_world[:3, :3] @ (moved.center - camera.center), offset, atol=1e-12)
    np.testing.assert_array_equal(moved.camera_from_world[:3, :3], camera.camera_from_world[:3, :3])


@pytest.mark.parametrize("model", ["sphere", "neural"])
def test_a_clone_moved_by_d_and_seen_from_c_is_the_original_seen_from_c_minus_d(capture, model):
    scene = scene_of(capture, model)
    camera = capture.held_out[0].camera.resized(128, 96)
    shift = np.array([1.6, 0.0, -0.4])
    cloned = clone_reflector(scene, 0, shift, np.eye(3))
    there = camera.camera_from_world.copy()
    there[:3, 3] -= there[:3, :3] @ shift  # the camera at c + d
    here, beyond = scene.render(camera), cloned.render(replace(camera, camera_from_world=there))
    middle = scene.volumes[0].scaled(0.8).project_mask(camera)
    assert middle.sum() > 300
    for layer in ("rgb", "reflection_rgb", "reflection_weight"):
        one, other = getattr(here, layer).numpy()[middle], getattr(beyond, layer).numpy()[middle]
        assert ((one - other) ** 2).mean() < 1e-4, layer  # 40 dB


@pytest.mark.parametrize("model", ["sphere", "plane", "neural"])
def test_a_clone_that_is_not_moved_changes_nothing(capture, model):
    scene = scene_of(capture, model)
    cloned = clone_reflector(scene, 0, *STILL)
    assert [v.name for v in cloned.volumes] == ["ball"]
    assert len(cloned.primary) == len(scene.primary)
    for view in (capture.held_out[0], capture.train[3]):
        before, after = scene.render(view.camera), cloned.render(view.camera)
        for layer in before._fields:
            torch.testing.assert_close(getattr(after, layer), getattr(before, layer), atol=1e-5, rtol=1e-5)


def test_what_was_where_a_clone_stands_gives_way(capture, ball):
    shift = np.array([0.9, 0.1, 0.2])
    cloned = clone_reflector(ball, 0, shift, np.eye(3))
    assert [v.name for v in cloned.volumes] == ["ball", "ball copy"]
    space = cloned.volumes[1].scaled(1.03)
    before = ball.primary.positions.detach().numpy().astype(np.float64)
    after = cloned.primary.positions.detach().numpy().astype(np.float64)
    own = ball.volumes[0].scaled(1.03).contains(before).sum()
    assert space.contains(before).sum() > 0
    assert space.contains(after).sum() == pytest.approx(own, abs=2)  # rounding at the volume's surface
    assert clone_reflector(cloned, 0, -shift, np.eye(3)).volumes[2].name == "ball copy 2"


def test_a_box_chooses_what_is_copied_along(capture, ball):
    low, high = np.array([-0.6, -0.8, -0.6]), np.array([0.6, 0.1, 0.6])
    points = ball.primary.positions.detach().numpy()
    inside = ((points >= low) & (points <= high)).all(1)
    cloned = clone_reflector(ball, 0, np.array([0, 0, 5.0]), np.eye(3), box=np.stack([high, low]))
    assert len(cloned.primary) == len(ball.primary) + inside.sum()
    copies = cloned.primary.positions.detach().numpy()[-inside.sum() :]
    np.testing.assert_allclose(copies, points[inside] + [0, 0, 5.0], atol=1e-5)
    with pytest.raises(UserError, match="no primary points in the box"):
        clone_reflector(ball, 0, *STILL, box=np.array([[50.0, 50, 50], [51, 51, 51]]))


@pytest.mark.parametrize("model", ["sphere", "ellipsoid", "plane"])
def test_a_clone_in_resting_surroundings_obeys_fermat_at_its_new_place(capture, model):
    """Where a point is displayed, the light's path from it over the mirror is the shortest, by brute force."""
    scene = copy.deepcopy(scene_of(capture, "sphere"))
    if model == "plane":
        toward = torch.from_numpy(capture.train[0].camera.center - BALL_CENTER).float()
        scene.warps[0] = PlaneWarp(torch.from_numpy(BALL_CENTER).float(), toward, 1.0)
    if model == "ellipsoid":
        middle, axes = (t.detach() for t in scene.warps[0].shape())
        scene.warps[0] = QuadricWarp(middle, axes * torch.tensor([1.2, 0.9, 0.8]), sphere=False)
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]])
    shift = np.array([0.4, -0.1, 0.2])
    cloned = clone_reflector(scene, 0, shift, turn, 0.7, resting=True)
    center = torch.from_numpy(capture.train[0].camera.center).float()
    points = cloned.reflections[1].positions
    shown = cloned.warps[1](points, center)
    # The surface: the original's, moved.
    old, move = scene.warps[0], scene.volumes[0].center + shift - 0.7 * turn @ scene.volumes[0].center
    if model == "plane":
        normal, distance = (t.detach().numpy() for t in old.plane())
        grid = np.stack([g.ravel() for g in np.meshgrid(*[np.linspace(-8, 8, 601)] * 2)], -1)
        across = np.linalg.svd(normal[None])[2][1:]
        surface = distance * normal + grid @ across
    else:
        middle, axes = (t.detach().numpy() for t in old.shape())
        surface = middle + sphere_directions(50_000) @ axes.T
    surface = 0.7 * surface @ turn.T + move
    eye = center.numpy()
    checked = torch.nonzero(shown.visible)[::80, 0].tolist()
    assert len(checked) > 2
    for i in checked:
        ray = shown.positions[i].detach().numpy() - eye
        touch = eye + ray / np.linalg.norm(ray) * float(shown.near[i])
        way = np.linalg.norm(surface - eye, axis=1) + np.linalg.norm(surface - points[i].detach().numpy(), axis=1)
        assert np.linalg.norm(surface[way.argmin()] - touch) < 0.03


def test_only_mirrors_can_stand_in_resting_surroundings(capture):
    with pytest.raises(UserError, match="NeuralWarp"):
        clone_reflector(scene_of(capture, "neural"), 0, *STILL, resting=True)


@pytest.mark.parametrize("model", ["sphere", "plane", "neural"])
def test_reflections_decoupled_by_nothing_are_the_same_bit_for_bit(capture, model):
    scene, camera = scene_of(capture, model), capture.held_out[0].camera
    before = scene.render(camera)
    for edited in (
        decouple_reflections(scene, 0, np.zeros(3)),
        decouple_reflections(scene, 0, np.array([1.0, 2, 3]), 3.0, np.ones(3), strength=0.0),
        decouple_reflections(scene, 0, np.zeros(3), 3.0, camera.center),  # at the pivot
    ):
        after = edited.render(camera)
        assert torch.equal(after.reflection_rgb, before.reflection_rgb) or edited.warps[0].gain == 3
        torch.testing.assert_close(after.rgb, before.rgb, atol=2e-3, rtol=0)
    assert torch.equal(decouple_reflections(scene, 0, np.zeros(3)).render(camera).rgb, before.rgb)


def test_a_decoupled_scene_shows_what_a_warp_camera_shows(capture, ball, tmp_path):
    camera = capture.held_out[0].camera
    offset = np.array([0.3, -0.1, 0.2])
    edited = decouple_reflections(ball, 0, offset, strength=0.5)
    aside = replace(camera, camera_from_world=camera.camera_from_world.copy())
    aside.camera_from_world[:3, 3] -= aside.camera_from_world[:3, :3] @ offset / 2
    expected = ball.render(camera, warp_camera=aside)
    torch.testing.assert_close(edited.render(camera).rgb, expected.rgb, atol=1e-3, rtol=0)
    assert float((expected.rgb - ball.render(camera).rgb).abs().max()) > 0.1
    edited.save(tmp_path / "scene.safetensors")
    assert torch.equal(Scene.load(tmp_path / "scene.safetensors").render(camera).rgb, edited.render(camera).rgb)


def test_frozen_reflections_are_painted_on_the_mirror(capture, ball):
    pivot = capture.train[0].camera.center
    frozen = decouple_reflections(ball, 0, np.zeros(3), 0.0, pivot)
    points = frozen.reflections[0].positions.detach()
    middle, axes = (t.detach() for t in ball.warps[0].shape())
    touched = []
    for view in capture.train[1:3]:
        eye = torch.from_numpy(view.camera.center).float()
        shown = frozen.warps[0](points, eye)
        rays = torch.nn.functional.normalize(shown.positions.detach() - eye, dim=1)
        # Where the ray meets the ball: on its far side for points that the eye should not see.
        along = rays @ (middle - eye)
        half = (axes[0, 0] ** 2 - (middle - eye).square().sum() + along**2).clamp_min(0).sqrt()
        touched.append([eye + (along + side * half)[:, None] * rays for side in (-1, 1)])
    gaps = torch.stack([(a - b).norm(dim=1) for a in touched[0] for b in touched[1]]).min(0).values
    assert float(gaps[shown.visible].quantile(0.99)) < 1e-3


def test_a_painted_reflection_looks_as_it_is_to_the_camera_that_it_follows(capture, ball):
    """A hair beside it nothing is different: points hide each other as before."""
    camera = capture.held_out[0].camera.resized(128, 96)
    painted = ball.render(camera, warp_camera=camera.displaced(np.array([1e-5, 0, 0])))
    assert float((painted.reflection_rgb - ball.render(camera).reflection_rgb).abs().mean()) < 1e-3


def test_each_reflector_can_follow_a_camera_of_its_own(capture, ball):
    camera = capture.held_out[0].camera.resized(128, 96)
    two = clone_reflector(ball, 0, 0.85 * camera.camera_from_world[0, :3], np.eye(3), 0.6)
    aside = camera.displaced(np.array([0.4, 0, 0]))
    plain, moved = two.render(camera), two.render(camera, warp_camera=[None, aside])
    changed = (plain.reflection_rgb - moved.reflection_rgb).abs().sum(-1) > 0.02
    first, second = (torch.from_numpy(v.project_mask(camera)) for v in two.volumes)
    assert changed.any()
    assert not changed[first & ~second].any()
    assert torch.equal(two.render(camera, warp_camera=[aside, aside]).rgb, two.render(camera, warp_camera=aside).rgb)


def test_painted_highlights_follow_no_camera(capture):
    with pytest.raises(UserError, match="whatever camera"):
        decouple_reflections(scene_of(capture, "static"), 0, np.ones(3))


def test_a_turned_and_scaled_clone_is_saved_and_loaded(capture, ball, tmp_path):
    turn = np.array([[0, -1.0, 0], [1.0, 0, 0], [0, 0, 1.0]])
    cloned = clone_reflector(ball, 0, np.array([1.0, 0.2, 0]), turn, 0.5)
    copy, original = cloned.volumes[1], ball.volumes[0]
    assert copy.radius == pytest.approx(original.radius / 2)
    np.testing.assert_allclose(copy.center, original.center + [1.0, 0.2, 0], atol=1e-9)
    assert copy.contains(copy.center[None]).all()
    cloned.save(tmp_path / "scene.safetensors")
    camera = capture.held_out[0].camera
    again = Scene.load(tmp_path / "scene.safetensors").render(camera)
    assert torch.equal(again.rgb, cloned.render(camera).rgb)


def test_the_scene_that_is_edited_stays_as_it_was(capture, ball):
    camera = capture.held_out[0].camera
    before = ball.render(camera).rgb
    clone_reflector(ball, 0, *STILL)
    decouple_reflections(ball, 0, np.ones(3))
    adjust_reflections(ball, 0, 0.0)
    replace_surroundings(ball, 0, np.zeros((4, 8, 3)))
    assert torch.equal(ball.render(camera).rgb, before)


def test_erased_reflections_leave_the_surface_and_dimmed_ones_are_darker(capture, ball):
    camera = capture.held_out[0].camera
    inside = torch.from_numpy(ball.volumes[0].scaled(0.8).project_mask(camera))
    gone = adjust_reflections(ball, 0, 0.0).render(camera)
    assert float(gone.reflection_weight.max()) < 1e-6
    torch.testing.assert_close(gone.rgb[inside], gone.primary_rgb[inside], atol=1e-4, rtol=0)
    half = adjust_reflections(ball, 0, 0.5).render(camera).reflection_rgb[inside].mean()
    assert float(half) == pytest.approx(0.5 * float(ball.render(camera).reflection_rgb[inside].mean()), rel=0.05)
    red = adjust_reflections(ball, 0, 1.0, (1.0, 0.0, 0.0)).render(camera).reflection_rgb[inside].mean(0)
    assert float(red[0]) > 0.2
    assert float(red[1:].max()) < 0.02


def test_other_surroundings_are_mirrored_from_their_direction(capture, ball):
    panorama = np.zeros((16, 32, 3), np.float32)
    panorama[:8] = [1.0, 0, 0]  # y < 0: up in this capture
    panorama[8:] = [0, 0, 1.0]
    camera = capture.held_out[0].camera
    image = replace_surroundings(ball, 0, panorama).render(camera).reflection_rgb
    rows, columns = np.nonzero(ball.volumes[0].scaled(0.8).project_mask(camera))
    top, bottom = rows.min(), rows.max()
    middle = int(columns.mean())
    assert image[top, middle, 0] > image[top, middle, 2]  # the upper rim mirrors the sky
    assert image[bottom, middle, 2] > image[bottom, middle, 0]


@pytest.mark.parametrize("up", [[0, 0, 1.0], [1.0, 1, 0], [0, 1.0, 0], [0, -2.0, 0]])
def test_a_panoramas_top_row_is_up_and_it_turns_about_that(capture, ball, up):
    panorama = np.zeros((16, 32, 3), np.float32)
    panorama[:8], panorama[8:, :16], panorama[8:, 16:] = [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]
    up = np.array(up)
    away = torch.from_numpy(ball.reflections[0].positions.detach().numpy() - ball.volumes[0].center)
    above = away @ torch.from_numpy(up) > 0
    plain, turned = (replace_surroundings(ball, 0, panorama, up, t).reflections[0].features for t in (0.0, 180.0))
    for colors in (plain, turned):
        assert torch.equal(colors[:, 0] == 1, above)
    assert torch.equal(plain[:, 1], turned[:, 2])


def test_the_surroundings_of_a_turned_clone_turned_along(capture, ball):
    """Half a turn about a level axis: what was up is down."""
    panorama = np.zeros((16, 32, 3), np.float32)
    panorama[:8], panorama[8:] = [1.0, 0, 0], [0, 0, 1.0]
    turned = clone_reflector(ball, 0, np.zeros(3), np.diag([1.0, -1, -1]))
    up = ball.reflections[0].positions[:, 1] < ball.volumes[0].center[1]
    colors = replace_surroundings(turned, 0, panorama).reflections[0].features.detach()
    assert float(colors[up, 2].mean()) > 0.9
    assert float(colors[~up, 0].mean()) > 0.9


def test_surroundings_of_a_network_cannot_be_replaced(capture):
    with pytest.raises(UserError, match="do not know what they mirror"):
        replace_surroundings(scene_of(capture, "neural"), 0, np.zeros((4, 8, 3)))


def test_a_reflector_is_found_by_name(ball):
    assert reflector_index(ball, None) == reflector_index(ball, "ball") == 0
    with pytest.raises(UserError, match="no reflector kettle"):
        reflector_index(ball, "kettle")


def test_the_commands_write_runs_that_can_be_rendered_and_never_overwrite_one(capture, ball, tmp_path, capsys):
    run = write_run(tmp_path / "run", capture, ball)
    commands = {
        "edit": ["--strength", "0.3", "--tint", "1", "0.5", "0.5", "--warp-gain", "2", "--warp-offset", "0", "0", "1"],
        "clone": ["--shift", "1.2", "0", "0", "--turn", "0", "90", "0", "--scale", "0.5", "--surroundings", "resting"],
    }
    for command, options in commands.items():
        assert cli.main([command, str(run), str(tmp_path / command), *options]) == 0
        film = ["render", str(tmp_path / command), str(tmp_path / f"{command}.mp4"), "--width", "32"]
        options_of_film = ["--warp-offset", "0.1", "0", "0", "--path", "still", "--warp-path", "held-out"]
        assert cli.main([*film, "--seconds", "0.3", "--fps", "8", *options_of_film]) == 0
        assert cli.main([command, str(run), str(tmp_path / command), *options]) == 2
        assert "already holds a run" in capsys.readouterr().err
    film = ["render", str(run), str(tmp_path / "a.mp4"), "--warp-reflector", "kettle"]
    assert cli.main(film) == 2
    assert "no reflector kettle" in capsys.readouterr().err
    assert [v.name for v in Scene.load(tmp_path / "clone" / "scene.safetensors").volumes] == ["ball", "ball copy"]
    assert cli.main(["clone", str(run), str(tmp_path / "other"), "--scale", "-1"]) == 2
