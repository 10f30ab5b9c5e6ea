"""Corrections of poses and exposures: what was disturbed is found again."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from toy import make_toy_capture

from catacaustics.capture.dataset import open_capture, write_capture
from catacaustics.config import EvaluateConfig, TrainConfig
from catacaustics.evaluation import evaluate
from catacaustics.geometry import rigid
from catacaustics.images import write_image
from catacaustics.scene import Motion
from catacaustics.training.corrections import Corrections, align_view
from catacaustics.training.initialize import scene_extent
from catacaustics.training.train import train

GAINS = np.array([1.25, 0.9, 0.75])


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    root = tmp_path_factory.mktemp("corrections")
    capture = open_capture(make_toy_capture(root / "capture"))
    config = TrainConfig(
        capture.root,
        root / "run",
        model=("sphere",),
        iterations=60,
        primary_points=2500,
        reflection_points=200,
        environment_width=20,
        image_size=64,
        patch=40,
    )
    return capture, train(config)


def turned(camera, degrees):
    a = np.radians(degrees)
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    return replace(camera, camera_from_world=rigid(turn, np.zeros(3)) @ camera.camera_from_world)


def test_a_motion_shows_what_the_moved_camera_sees(trained):
    capture, scene = trained
    camera = capture.held_out[0].camera
    # The corrected camera sees x as the calibrated one sees the moved world.
    angle, shift = 0.05, np.array([0.06, -0.03, 0.04])
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    world = rigid(rotation, camera.center + shift - rotation @ camera.center)
    moved = replace(camera, camera_from_world=camera.camera_from_world @ world)
    motion = Motion(torch.from_numpy(rotation).float(), torch.from_numpy(shift).float())
    with torch.no_grad():
        expected, got = scene.layers(moved), scene.layers(camera, motion=motion)
    for name in ("primary", "reflection", "rho", "transmittance", "directions"):
        difference = (getattr(expected, name) - getattr(got, name)).abs()
        assert float(difference.mean()) < 1e-3, name
    with torch.no_grad():
        still = scene.layers(camera)
    assert float((still.primary - expected.primary).abs().mean()) > 0.02


def test_a_turned_view_is_aligned_again(trained):
    capture, scene = trained
    view = capture.held_out[1]
    wrong, photo = turned(view.camera, 2.0), torch.from_numpy(capture.image(view)).float() / 255
    before = float(((scene.render(wrong).rgb - photo) ** 2).mean())
    aligned = align_view(scene, wrong, photo, True, False, scene_extent(capture), steps=60)
    after = float(((aligned.render(scene, wrong) - photo) ** 2).mean())
    own = float(((scene.render(view.camera).rgb - photo) ** 2).mean())
    assert after < 0.5 * before
    assert after < 1.1 * own
    assert all(p.requires_grad for p in scene.primary.parameters())  # thawed again


def test_gains_of_a_photograph_are_found_again(trained):
    capture, scene = trained
    view = capture.held_out[0]
    clean = scene.render(view.camera).rgb
    photo = (clean * torch.tensor(GAINS, dtype=torch.float32)).clamp(0, 1)
    aligned = align_view(scene, view.camera, photo, False, True, scene_extent(capture), steps=150)
    np.testing.assert_allclose(aligned.log_gains.detach().exp()[0], GAINS, atol=0.06)


def test_nothing_to_learn_changes_nothing(trained):
    capture, scene = trained
    view = capture.held_out[0]
    none = Corrections(3, False, False, 1.0)
    assert none.motion(1) is None
    image = torch.rand(4, 5, 3)
    assert none.expose(2, image) is image
    same = align_view(scene, view.camera, scene.render(view.camera).rgb, False, False, 1.0)
    torch.testing.assert_close(same.render(scene, view.camera), scene.render(view.camera).rgb)


def test_training_learns_the_exposures_of_its_photographs_and_both_scores_are_reported(tmp_path):
    capture = open_capture(make_toy_capture(tmp_path / "capture"))
    for i, view in enumerate(capture.train):
        gain = 1.3 if i % 2 else 0.75
        write_image(capture.root / "images" / view.name, np.clip(capture.image(view) / 255 * gain, 0, 1))
    split = {"train": [v.name for v in capture.train], "held_out": [v.name for v in capture.held_out]}
    write_capture(capture.root, capture.views, split)
    config = TrainConfig(
        capture.root,
        tmp_path / "run",
        model=("static",),
        iterations=120,
        primary_points=2500,
        reflection_points=200,
        environment_width=20,
        image_size=64,
        patch=64,
        exposure=True,
        refine_poses=True,
        lr_exposure=0.05,
    )
    train(config)
    rows = json.loads((tmp_path / "run" / "corrections.json").read_text())
    gains = np.array([row["gains"] for row in rows]).mean(1)
    assert gains[1::2].mean() / gains[::2].mean() > 1.25
    assert max(row["degrees"] for row in rows) < 3
    result = evaluate(EvaluateConfig(tmp_path / "run", device="cpu"))
    assert result["mean"]["whole_aligned"]["psnr"] > result["mean"]["whole"]["psnr"]
    assert "aligned" in result["protocol"]["metrics"]
    assert "view aligned" in (tmp_path / "run" / "report.html").read_text()
