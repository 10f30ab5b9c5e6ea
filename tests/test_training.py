"""Training on a tiny capture: it learns, stops, resumes and refuses."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from toy import BALL_COLOR, ball_mask, make_toy_capture

from catacaustics.capture.dataset import open_capture
from catacaustics.config import TrainConfig
from catacaustics.errors import UserError
from catacaustics.reflectors.volume import ReflectionVolume, build_volume
from catacaustics.scene import Scene
from catacaustics.training import loop
from catacaustics.training.densification import GradientStatistics, densify
from catacaustics.training.initialize import (
    INITIAL_OPACITY,
    Seeds,
    grow_cloud,
    neighbor_footprints,
    start_cloud,
)
from catacaustics.training.optimizer import RowAdam, make_optimizer
from catacaustics.training.photographs import PhotographCache, choose_patch, scaled_camera
from catacaustics.training.train import train


@pytest.fixture(scope="module")
def capture_path(tmp_path_factory):
    return make_toy_capture(tmp_path_factory.mktemp("toy"))


def small(capture_path, run, **options):
    settings = {
        "model": ("neural",),
        "iterations": 60,
        "primary_points": 2500,
        "reflection_points": 300,
        "environment_width": 20,
        "warp_width": 32,
        "densifications": 2,
        "image_size": 64,
        "patch": 40,
    }
    return TrainConfig(capture_path, run, **(settings | options))


def test_training_learns_the_scene_and_writes_its_files(capture_path, tmp_path):
    scene = train(small(capture_path, tmp_path / "run", iterations=150))
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [r["step"] for r in rows] == list(range(10, 151, 10))
    assert rows[0]["scale"] < 1.0
    assert rows[-1]["scale"] == 1.0
    assert rows[-1]["primary_points"] > 2500  # densified
    capture = open_capture(capture_path)
    camera = capture.held_out[0].camera
    image = torch.from_numpy(capture.image(capture.held_out[0])).float() / 255
    output = scene.render(camera)
    assert float(((output.rgb - image) ** 2).mean()) < 0.01
    mask = ball_mask(camera)
    inner = output.rgb.numpy()[mask].mean(0)
    np.testing.assert_allclose(inner, BALL_COLOR, atol=0.08)
    assert output.reflection_weight.numpy()[mask].mean() > 0.7
    loaded = Scene.load(tmp_path / "run" / "scene.safetensors")
    assert torch.equal(loaded.render(camera).rgb, output.rgb)


def test_resuming_continues_exactly_as_if_never_interrupted(capture_path, tmp_path, monkeypatch, capsys):
    whole = train(small(capture_path, tmp_path / "whole"))
    real_step, calls = loop._step, []

    def interrupted(*arguments):
        calls.append(1)
        if len(calls) == 38:
            raise KeyboardInterrupt
        return real_step(*arguments)

    config = small(capture_path, tmp_path / "parts")
    monkeypatch.setattr(loop, "_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(config)
    assert "interrupted at step 37" in capsys.readouterr().out
    monkeypatch.setattr(loop, "_step", real_step)
    parts = train(replace(config, resume=True))
    for (name, a), (_, b) in zip(whole.named_parameters(), parts.named_parameters(), strict=True):
        assert torch.equal(a, b), name
    rows = (tmp_path / "parts" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(r)["step"] for r in rows] == list(range(10, 61, 10))
    capsys.readouterr()
    train(replace(config, resume=True))
    assert "finished already" in capsys.readouterr().out


def test_a_run_is_never_overwritten_by_accident(capture_path, tmp_path):
    config = small(capture_path, tmp_path / "run", iterations=3)
    train(config)
    before = (tmp_path / "run" / "scene.safetensors").read_bytes()
    with pytest.raises(UserError, match="already holds a run"):
        train(config)
    assert (tmp_path / "run" / "scene.safetensors").read_bytes() == before


def test_without_masks_the_primary_cloud_is_trained_alone_and_this_is_said(tmp_path, capsys):
    capture = make_toy_capture(tmp_path / "capture", masks=False)
    scene = train(small(capture, tmp_path / "run", iterations=5))
    assert "no reflector" in capsys.readouterr().out
    assert len(scene.reflections) == 0


def test_a_loss_that_is_not_finite_stops_training_and_keeps_the_last_checkpoint(capture_path, tmp_path, monkeypatch):
    config = small(capture_path, tmp_path / "run", checkpoint_minutes=0.0)
    real = loop.dssim
    calls = []

    def poisoned(*arguments):
        calls.append(1)
        return real(*arguments) * (float("nan") if len(calls) > 6 else 1)

    monkeypatch.setattr(loop, "dssim", poisoned)
    with pytest.raises(UserError, match="loss is not finite at step 6"):
        train(config)
    _, _, notes = Scene.load_with_extras(tmp_path / "run" / "checkpoint.safetensors")
    assert notes["step"] == 6


def test_a_time_budget_ends_training_and_drives_its_stages(capture_path, tmp_path, monkeypatch):
    ticks = itertools.count()
    monkeypatch.setattr(loop, "clock_of", lambda name: lambda: 0.5 * next(ticks))  # half a second a step
    train(small(capture_path, tmp_path / "run", iterations=10**6, minutes=1.0))
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert 55 < rows[-1]["seconds"] <= 61
    # The first row is written after 5 of 60 seconds, past the end of the first stage but not of the second.
    assert [r["stage"] for r in rows] == [1] + [2] * (len(rows) - 1)


def test_footprints_follow_the_spacing_of_the_points():
    grid = np.stack(np.meshgrid(*[np.arange(10.0)] * 2, [0.0]), -1).reshape(-1, 3)
    np.testing.assert_allclose(neighbor_footprints(grid)[55], 0.5)
    np.testing.assert_allclose(neighbor_footprints(3 * grid)[55], 4.5)
    assert neighbor_footprints(np.zeros((1, 3))).shape == (1,)
    with_stray = np.concatenate([grid, [[1000.0, 0, 0]]])
    assert neighbor_footprints(with_stray)[-1] <= 16 * 0.5 * 1.5


def test_a_new_point_takes_what_its_nearest_point_has_learned():
    rng = np.random.default_rng(0)
    positions = rng.random((40, 3)).astype(np.float32)
    seeds = Seeds(positions, positions, rng.random((40, 3)).astype(np.float32), np.full(40, 0.3, np.float32))
    cloud = start_cloud(seeds, 10, primary=True)
    with torch.no_grad():
        cloud.features[4, 5] = 7.0
        cloud.opacity_logits[4] += 2.0
    grown = grow_cloud(cloud, seeds, 40)
    assert len(grown) == 40
    nearest = np.argmin(np.linalg.norm(positions[10:, None] - positions[None, :10], axis=-1), axis=1)
    for new, old in enumerate(nearest, 10):
        assert grown.features[new, 5].item() == (7.0 if old == 4 else 0.0)
        gained = grown.opacity_logits[new].item() - np.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY))
        assert gained == pytest.approx(2.0 if old == 4 else 0.0, abs=1e-6)
        np.testing.assert_allclose(grown.features.detach()[new, :3], seeds.colors[new], rtol=1e-6)


def test_rows_follow_adam_and_stand_still_while_they_have_no_gradient():
    rng = torch.Generator().manual_seed(0)
    start = torch.randn(6, 3, generator=rng)
    ours, theirs = torch.nn.Parameter(start.clone()), torch.nn.Parameter(start[:3].clone())
    settings = {"lr": 0.1, "weight_decay": 0.2}
    rows = RowAdam([{"params": [ours], "name": "primary.features", "rows": True, **settings}])
    dense = torch.optim.AdamW([theirs], eps=1e-15, **settings)
    for step in range(5):
        gradient = torch.randn(6, 3, generator=rng)
        gradient[3:5] = 0
        gradient[5] *= step == 3  # seen once: its first step, whatever the others have counted
        ours.grad, theirs.grad = gradient, gradient[:3].clone()
        rows.step()
        dense.step()
    torch.testing.assert_close(ours[:3], theirs, rtol=1e-5, atol=1e-6)
    assert torch.equal(ours[3:5], start[3:5])
    torch.testing.assert_close((ours[5] - start[5] * (1 - 0.1 * 0.2)).abs(), torch.full((3,), 0.1), rtol=1e-4, atol=0)


def test_masks_are_made_once_for_a_photograph_and_size_and_patches_lie_on_them(capture, monkeypatch):
    volume, view = build_volume(capture, "ball"), capture.train[0]
    cache, camera = PhotographCache(capture), scaled_camera(view.camera, 64, 1.0)
    masks = cache.masks(view, camera, [volume, volume.scaled(0.5)])
    np.testing.assert_array_equal(masks[0], volume.project_mask(camera))
    assert 0 < masks[1].sum() < masks[0].sum()
    rng = np.random.default_rng(0)
    for _ in range(20):
        window = choose_patch(camera, masks[1:], 2, 1.0, rng)
        assert masks[1, window.y0 + 1, window.x0 + 1]
    assert cache.masks(view, scaled_camera(view.camera, 32, 1.0), [volume]).shape[2] == 32
    monkeypatch.setattr(ReflectionVolume, "project_mask", None)
    assert cache.masks(view, camera, [volume]) is masks
    assert cache.masks(capture.train[1], camera, []).shape == (0, camera.height, camera.width)


def test_densification_spawns_downhill_keeps_moments_and_respects_the_cap(capture_path, tmp_path):
    scene = train(small(capture_path, tmp_path / "run", iterations=4, densifications=0))
    optimizer = make_optimizer(scene, small(capture_path, tmp_path))
    n = len(scene.primary)
    for group in optimizer.param_groups:
        p = group["params"][0]
        optimizer.state[p] = {
            "step": torch.full((len(p) if group["rows"] else 1,), 3.0),
            "exp_avg": torch.ones_like(p),
            "exp_avg_sq": torch.ones_like(p),
        }
    statistics = GradientStatistics(n, scene.device)
    statistics.length[7] = statistics.seen[7] = 1.0
    statistics.direction[7] = torch.tensor([0.0, 2.0, 0.0])
    before = scene.primary.positions.detach().clone()
    assert densify(scene, optimizer, statistics, 0.5, n) == 0
    assert densify(scene, optimizer, statistics, 0.5, n + 10) == 1
    step = scene.primary.positions[n] - before[7]
    radius = scene.primary.log_footprints[7].exp().sqrt()
    torch.testing.assert_close(step.detach(), torch.stack([0 * radius, -radius, 0 * radius]).detach())
    state = optimizer.state[scene.primary.positions]
    assert state["exp_avg"][:n].min() == 1
    assert state["exp_avg"][n:].max() == 0
    assert all(len(p) == n + 1 for p in scene.primary.parameters())
