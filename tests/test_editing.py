"""Edits leave what they do not touch, and move what they do as they say."""

import numpy as np
import pytest
import torch
from toy import make_toy_capture

from catacaustics import cli
from catacaustics.capture.dataset import open_capture
from catacaustics.config import TrainConfig
from catacaustics.editing import (
    adjust_reflections,
    clone_reflector,
    reflector_index,
    replace_surroundings,
)
from catacaustics.errors import UserError
from catacaustics.files import write_json
from catacaustics.reflectors.volume import build_volume
from catacaustics.scene import Scene
from catacaustics.training.initialize import initial_scene, named_reflectors, primary_seeds, reflection_seeds


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return open_capture(make_toy_capture(tmp_path_factory.mktemp("editing")))


def scene_of(capture, model):
    config = TrainConfig(
        capture.root,
        capture.root / "run",
        model=(model,),
        primary_points=6000,
        reflection_points=800,
        environment_width=20,
        warp_width=16,
    )
    reflectors = named_reflectors([build_volume(capture, "ball")], config.model)
    rng = np.random.default_rng(0)
    seeds = [primary_seeds(capture, reflectors, config, rng), reflection_seeds(capture, reflectors[0], config, rng)]
    scene = initial_scene(capture, reflectors, seeds, 1.0, config)
    with torch.no_grad():
        scene.primary.opacity_logits.fill_(8.0)  # opaque, so that nothing shines through
        scene.reflections[0].features[:, :3] = torch.rand(800, 3, generator=torch.Generator().manual_seed(0))
    return scene


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
    from dataclasses import replace

    there = camera.camera_from_world.copy()
    there[:3, 3] -= there[:3, :3] @ shift  # the camera at c + d
    here, beyond = scene.render(camera), cloned.render(replace(camera, camera_from_world=there))
    middle = scene.volumes[0].scaled(0.8).project_mask(camera)
    assert middle.sum() > 300
    for layer in ("rgb", "reflection_rgb", "reflection_weight"):
        one, other = getattr(here, layer).numpy()[middle], getattr(beyond, layer).numpy()[middle]
        assert ((one - other) ** 2).mean() < 1e-4, layer  # 40 dB


def test_a_clone_at_the_same_place_looks_like_the_original(capture, ball):
    camera = capture.held_out[0].camera
    cloned = clone_reflector(ball, 0, *STILL)
    assert [v.name for v in cloned.volumes] == ["ball", "ball copy"]
    assert len(cloned.primary) > len(ball.primary)
    difference = (cloned.render(camera).reflection_rgb - ball.render(camera).reflection_rgb).abs()
    inside = torch.from_numpy(ball.volumes[0].scaled(0.8).project_mask(camera))
    assert float(difference[inside].mean()) < 0.05


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


def test_surroundings_of_a_network_cannot_be_replaced(capture):
    with pytest.raises(UserError, match="do not know what they mirror"):
        replace_surroundings(scene_of(capture, "neural"), 0, np.zeros((4, 8, 3)))


def test_a_reflector_is_found_by_name(ball):
    assert reflector_index(ball, None) == reflector_index(ball, "ball") == 0
    with pytest.raises(UserError, match="no reflector kettle"):
        reflector_index(ball, "kettle")


def test_the_commands_write_runs_that_can_be_rendered_and_never_overwrite_one(capture, ball, tmp_path, capsys):
    run = tmp_path / "run"
    ball.save(run / "scene.safetensors")
    write_json(run / "config.json", {"capture": str(capture.root), "image_size": 64})
    commands = {
        "edit": ["--strength", "0.3", "--tint", "1", "0.5", "0.5"],
        "clone": ["--shift", "1.2", "0", "0", "--turn", "0", "90", "0", "--scale", "0.5"],
    }
    for command, options in commands.items():
        assert cli.main([command, str(run), str(tmp_path / command), *options]) == 0
        film = ["render", str(tmp_path / command), str(tmp_path / f"{command}.mp4"), "--width", "32"]
        assert cli.main([*film, "--seconds", "0.3", "--fps", "8", "--warp-offset", "0.1", "0", "0"]) == 0
        assert cli.main([command, str(run), str(tmp_path / command), *options]) == 2
        assert "already holds a run" in capsys.readouterr().err
    assert [v.name for v in Scene.load(tmp_path / "clone" / "scene.safetensors").volumes] == ["ball", "ball copy"]
    assert cli.main(["clone", str(run), str(tmp_path / "other"), "--scale", "-1"]) == 2
