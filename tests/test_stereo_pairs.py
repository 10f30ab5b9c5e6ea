"""Stereo pairs: eyes where they should be, disparities in closed form, comfort without touching the scene."""

import copy
import json

import numpy as np
import pytest
import torch
from toy import BALL_CENTER, BALL_RADIUS, ball_mask, scene_of, write_run

from catacaustics import cli
from catacaustics.cameras import pixel_centers
from catacaustics.geometry import normalize
from catacaustics.images import read_image
from catacaustics.reflectors.fit import fit_revolution
from catacaustics.reflectors.warps import PlaneWarp, QuadricWarp, RevolutionWarp
from catacaustics.stereo import (
    Rig,
    anaglyph,
    reflection_disparity,
    render_pair,
    side_by_side,
    surface_depth,
    surface_disparity,
    usual_rig,
)


@pytest.fixture(scope="module")
def camera(capture):
    return capture.held_out[0].camera.resized(160, 120)


@pytest.fixture(scope="module")
def mirror_ball(capture):
    """The true ball, opaque and all mirror, that shows 4000 points all around."""
    scene = copy.deepcopy(scene_of(capture, "sphere"))
    scene.warps[0] = QuadricWarp(torch.tensor(BALL_CENTER).float(), BALL_RADIUS * torch.eye(3), sphere=True)
    return scene


def test_eyes_are_beside_each_other_and_the_screen_has_no_disparity(camera):
    rig = Rig(0.2, 2.0)
    left, right = rig.eyes(camera)
    across = camera.camera_from_world[:3, :3] @ (right.center - left.center)
    np.testing.assert_allclose(across, [0.2, 0, 0], atol=1e-12)
    for depth, expected in ((2.0, 0.0), (1.0, -camera.fx * 0.2 / 2), (4.0, camera.fx * 0.2 / 4)):
        point = camera.unproject(np.array([[50.0, 30.0]]), np.array([depth]))
        shift = right.project(point)[0] - left.project(point)[0]
        np.testing.assert_allclose(shift, [[expected, 0]], atol=1e-9)


def test_with_its_full_separation_a_pair_is_what_two_cameras_see(mirror_ball, camera):
    rig = usual_rig(mirror_ball, camera)
    for eye, output in zip(rig.eyes(camera), render_pair(mirror_ball, camera, rig), strict=True):
        assert torch.equal(output.rgb, mirror_ball.render(eye).rgb)


def test_comfort_changes_reflections_only(mirror_ball, camera):
    rig = usual_rig(mirror_ball, camera)
    for full, easy in zip(
        render_pair(mirror_ball, camera, rig), render_pair(mirror_ball, camera, rig._replace(warp=0.0)), strict=True
    ):
        assert torch.equal(full.primary_rgb, easy.primary_rgb)
        assert not torch.equal(full.reflection_rgb, easy.reflection_rgb)


def test_comfort_lowers_the_disparity_of_reflections_step_by_step_to_that_of_the_surface(mirror_ball, camera):
    rig = Rig(0.1, usual_rig(mirror_ball, camera).screen)
    steps = [reflection_disparity(mirror_ball, camera, rig._replace(warp=w)) for w in (1.0, 0.75, 0.5, 0.25, 0.0)]
    surface = surface_disparity(mirror_ball, camera, rig._replace(warp=0.0))
    high, vertical = [s.high for s in steps], [s.vertical for s in steps]
    assert (np.diff(high) < 0).all()
    assert (np.diff(vertical) < 0).all()
    assert high[0] > 1.4 * surface.high
    assert vertical[0] > 0.05
    assert steps[-1].pixels == surface.pixels
    np.testing.assert_allclose(steps[-1], surface, atol=1e-3)
    assert surface.vertical == pytest.approx(0, abs=1e-6)


def test_the_image_in_a_flat_mirror_has_the_disparity_of_its_depth(capture, camera):
    """Points on a wall behind the camera, mirrored in a plane in front of it: all are seen at one depth."""
    scene = copy.deepcopy(scene_of(capture, "sphere"))
    forward, rng = camera.camera_from_world[2, :3], np.random.default_rng(0)
    across = camera.camera_from_world[:2, :3]
    mirror = BALL_CENTER
    distance = forward @ (mirror - camera.center)
    wall = camera.center - 1.5 * forward + rng.uniform(-2, 2, (800, 2)) @ across
    scene.warps[0] = PlaneWarp(torch.tensor(mirror).float(), torch.tensor(-forward).float(), 1.0)
    with torch.no_grad():
        scene.reflections[0].positions.copy_(torch.from_numpy(wall))
        scene.reflections[0].log_footprints.fill_(2 * np.log(0.15))
        scene.reflections[0].opacity_logits.fill_(4.0)
    rig = Rig(0.1, 1.0)
    seen = reflection_disparity(scene, camera, rig)
    expected = camera.fx * 0.1 * (1 - 1 / (2 * distance + 1.5))
    np.testing.assert_allclose([seen.low, seen.median, seen.high], expected, rtol=1e-4)
    assert seen.vertical < 1e-3
    on_the_mirror = camera.fx * 0.1 * (1 - 1 / distance)
    comfortable = rig._replace(warp=0.0)
    assert reflection_disparity(scene, camera, comfortable).median == pytest.approx(on_the_mirror, rel=1e-5)
    assert surface_disparity(scene, camera, comfortable).median == pytest.approx(on_the_mirror, rel=1e-5)


def test_the_depth_of_a_balls_surface_is_the_closed_forms(mirror_ball, camera):
    depth = surface_depth(mirror_ball, 0, camera, pixel_centers(camera.viewport))
    assert np.array_equal(np.isfinite(depth), ball_mask(camera))
    rows, columns = np.nonzero(np.isfinite(depth))
    points = camera.unproject(np.stack([columns, rows], -1) + 0.5, depth[rows, columns])
    np.testing.assert_allclose(np.linalg.norm(points - BALL_CENTER, axis=1), BALL_RADIUS, rtol=1e-6)
    toward = np.einsum("ij,ij->i", points - BALL_CENTER, points - camera.center)
    assert (toward < 0).all()  # the side that faces the camera


def test_the_depth_of_a_turned_surface_is_that_of_the_ball_it_is(mirror_ball, camera):
    turned, ball = copy.deepcopy(mirror_ball), surface_depth(mirror_ball, 0, camera, pixel_centers(camera.viewport))
    points = BALL_CENTER + BALL_RADIUS * normalize(np.random.default_rng(0).normal(size=(2000, 3)))
    turned.warps[0] = RevolutionWarp(fit_revolution(points, BALL_CENTER, BALL_RADIUS * np.eye(3))[0]).float()
    depth = surface_depth(turned, 0, camera, pixel_centers(camera.viewport))
    both = np.isfinite(depth) & np.isfinite(ball)
    assert both.sum() > 0.95 * np.isfinite(ball).sum()
    np.testing.assert_allclose(depth[both], ball[both], atol=0.02 * BALL_RADIUS)


def test_where_a_rung_has_no_mirror_its_volume_is_the_surface(capture, camera):
    scene = scene_of(capture, "static")
    volume, depth = scene.volumes[0], surface_depth(scene, 0, camera, pixel_centers(camera.viewport))
    assert np.array_equal(np.isfinite(depth), volume.project_mask(camera))
    rows, columns = np.nonzero(np.isfinite(depth))
    points = camera.unproject(np.stack([columns, rows], -1) + 0.5, depth[rows, columns])
    gap = (points @ volume.halfspaces[:, :3].T + volume.halfspaces[:, 3]).max(1)
    np.testing.assert_allclose(gap, 0, atol=1e-9)


def test_an_anaglyph_hides_each_picture_from_the_other_eye():
    left, right = np.zeros((2, 2, 3), np.float32), np.full((2, 2, 3), 0.5, np.float32)
    left[0, 0] = 1
    joined = anaglyph(left, right)
    np.testing.assert_allclose(joined[..., 0], left[..., 0], atol=1e-6)
    np.testing.assert_allclose(joined[..., 1:], 0.5)
    assert side_by_side(left, right).shape == (2, 4, 3)


def test_the_command_writes_pairs_a_film_and_the_disparities(capture, mirror_ball, tmp_path, capsys):
    run = write_run(tmp_path / "run", capture, mirror_ball)
    command = ["stereo", str(run), str(tmp_path / "out"), "--width", "64", "--warp-separation", "0"]
    assert cli.main([*command, "--film", "anaglyph", "--seconds", "0.3", "--fps", "8"]) == 0
    pictures = {name: read_image(tmp_path / "out" / f"{name}.png") for name in ("left", "right", "side_by_side")}
    np.testing.assert_array_equal(side_by_side(pictures["left"], pictures["right"]), pictures["side_by_side"])
    told = json.loads((tmp_path / "out" / "stereo.json").read_text())
    assert told["disparity"]["full"]["high"] > told["disparity"]["chosen"]["high"]
    assert (tmp_path / "out" / "film.mp4").read_bytes()[4:8] == b"ftyp"
    assert "their surface" in capsys.readouterr().out
    for wrong, words in (
        (["--warp-separation", "2"], "0 to 1"),
        (["--separation", "-1"], "positive lengths"),
        (["--view", "nobody.jpg"], "no view nobody.jpg"),
    ):
        assert cli.main([*command, *wrong]) == 2
        assert words in capsys.readouterr().err


def test_a_scene_without_reflectors_has_pairs_but_no_disparities(capture, mirror_ball, tmp_path, capsys):
    bare = copy.deepcopy(mirror_ball)
    bare.volumes, bare.warps, bare.reflections = [], torch.nn.ModuleList(), torch.nn.ModuleList()
    run = write_run(tmp_path / "run", capture, bare)
    assert cli.main(["stereo", str(run), str(tmp_path / "out"), "--width", "32"]) == 0
    assert (tmp_path / "out" / "anaglyph.png").is_file()
    assert "no reflection is seen" in capsys.readouterr().out
