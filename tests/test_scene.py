"""The scene: layers add up, files round trip, bad files are refused."""

from unittest import mock

import numpy as np
import pytest
import torch
from toy import BALL_CENTER, ball_mask, toy_cameras

from catacaustics.cameras import Viewport
from catacaustics.config import TrainConfig
from catacaustics.errors import UserError
from catacaustics.reflectors.fit import fit_revolution
from catacaustics.reflectors.volume import build_volume
from catacaustics.reflectors.warps import RevolutionWarp
from catacaustics.scene import Scene
from catacaustics.training import mirrors
from catacaustics.training.initialize import (
    initial_scene,
    named_reflectors,
    primary_seeds,
    reflection_seeds,
    seen_through,
    start_warps,
)
from catacaustics.training.selection import LADDER


def build(capture, **options):
    settings = {"model": ("neural",), "primary_points": 3000, "reflection_points": 500, "environment_width": 20}
    config = TrainConfig(capture.root, capture.root / "run", **(settings | options))
    reflectors = named_reflectors([build_volume(capture, r) for r in capture.reflectors], config.model)
    rng = np.random.default_rng(0)
    seeds = [primary_seeds(capture, reflectors, config.primary_points, rng)]
    reflectors = [r for r in reflectors if r.model != "none"]
    warps, volumes = start_warps(capture, reflectors, config), [r.volume for r in reflectors]
    seeds += [
        reflection_seeds(capture, v, w, config.reflection_points, rng) for v, w in zip(volumes, warps, strict=True)
    ]
    return initial_scene(capture, volumes, warps, seeds, 1.0, config)


@pytest.fixture(scope="module")
def scene(capture):
    scene = build(capture)
    torch.manual_seed(1)
    with torch.no_grad():  # an untrained head would hide the network
        scene.renderer.head.weight.normal_(0, 0.05)
        scene.environment.features.normal_(0, 0.2)
    return scene


def test_a_viewport_is_a_crop_of_the_whole_render(capture, scene):
    camera = capture.train[0].camera
    whole = scene.render(camera)
    part = scene.render(camera, Viewport(20, 10, 15, 12))
    for name, a, b in zip(whole._fields, part, whole, strict=True):
        torch.testing.assert_close(a, b[10:22, 20:35], rtol=1e-4, atol=1e-4, msg=name)


def test_the_reflector_carries_the_reflection_weight_and_the_floor_does_not(capture, scene):
    camera = capture.train[2].camera
    weight = scene.render(camera).reflection_weight.numpy()
    mask = ball_mask(camera)
    assert weight[mask].mean() > 0.6
    assert weight[~mask].mean() < 0.1


def test_the_environment_does_not_start_from_what_mirrors_show(capture):
    scene = build(capture)
    with torch.no_grad():
        scene.primary.opacity_logits.fill_(-20.0)  # open everywhere
    camera = capture.train[0].camera
    config = TrainConfig(capture.root, capture.root / "run", image_size=max(camera.width, camera.height))
    weights = seen_through(capture, scene, config)[2].numpy()[: camera.width * camera.height]
    mirror = scene.volumes[0].project_mask(camera).ravel()
    assert mirror.any()
    assert (weights[mirror] == 0).all()
    assert (weights[~mirror] > 0.99).all()


def test_a_visual_hull_is_carved_once_however_many_scenes_start_from_it(capture, monkeypatch):
    carved = mock.Mock(wraps=mirrors.carve_visual_hull)
    monkeypatch.setattr(mirrors, "carve_visual_hull", carved)
    volume, rng = build_volume(capture, "ball"), np.random.default_rng(0)
    for model in ("sphere", "revolution"):
        reflectors = named_reflectors([volume], (model,))
        primary_seeds(capture, reflectors, 1000, rng)
        start_warps(capture, reflectors, TrainConfig(capture.root, capture.root / "run"))
    assert carved.call_count == 1


def test_a_vase_shows_one_point_several_times_and_all_of_its_images_teach_it(capture):
    scene = build(capture, model=("revolution",), reflection_points=2000)
    z = np.linspace(-0.5, 0.5, 200)
    angle = np.random.default_rng(0).uniform(0, 2 * np.pi, 200)
    radius = 0.2 + 0.1 * np.cos(9 * z)  # two bellies, and a waist
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
    vase, _ = fit_revolution(points, np.zeros(3), np.diag([0.25, 0.25, 0.5]))
    moved = vase._replace(center=vase.center + torch.from_numpy(BALL_CENTER))
    scene.warps[0] = RevolutionWarp(type(moved)(*(v.float() for v in moved)))
    disks = scene.reflection_disks(0, capture.train[0].camera)
    images = disks.rows.bincount()
    assert images.max() > 1
    cloud = scene.reflections[0]
    assert torch.equal(disks.features, cloud.features[disks.rows])
    often = images.argmax()
    (disks.features[disks.rows == often].sum()).backward()
    assert torch.equal(cloud.features.grad[often], images.max() * torch.ones(len(cloud.features[0])))


def test_a_nearer_diffuse_wall_hides_the_reflection(capture):
    scene = build(capture)
    camera = capture.train[0].camera
    wall = camera.center + 0.4 * (BALL_CENTER - camera.center)
    with torch.no_grad():
        chosen = torch.arange(0, len(scene.primary), 2)
        spread = torch.rand(len(chosen), 3) - 0.5
        scene.primary.positions[chosen] = torch.tensor(wall, dtype=torch.float32) + 0.5 * spread
        scene.primary.rho_logits[chosen] = -8.0
        scene.primary.opacity_logits[chosen] = 4.0
        scene.primary.log_footprints[chosen] = -5.0
        features = [f for f in scene.reflections[0].parameters() if f.shape[-1:] == (6,)]
        before = scene.render(camera).rgb
        features[0] += 1.0
        after = scene.render(camera).rgb
    assert float((after - before).abs().max()) < 0.02


def test_depth_is_that_of_the_surface(capture, scene):
    """A pixel on the floor: the depth of where its ray meets y = 0."""
    camera = capture.train[0].camera
    x, y = 32, 44
    assert not ball_mask(camera)[y, x]
    ray = camera.ray_directions(np.array([x + 0.5, y + 0.5]))
    expected = -camera.center[1] / ray[1]
    assert float(scene.render(camera).depth[y, x]) == pytest.approx(expected, rel=0.02)


def test_a_decoupled_warp_camera_changes_reflections_only(capture, scene):
    camera, other = capture.train[0].camera, capture.train[3].camera
    with torch.no_grad():
        scene.warps[0].network[-1].weight *= 50
    a, b = scene.render(camera), scene.render(camera, warp_camera=other)
    same = scene.render(camera, warp_camera=camera)
    assert torch.equal(a.rgb, same.rgb)
    assert torch.equal(a.primary_rgb, b.primary_rgb)
    assert float((a.reflection_rgb - b.reflection_rgb).abs().max()) > 0.01


@pytest.mark.parametrize("model", ["none", *LADDER[1:]])
def test_a_saved_scene_renders_the_same(capture, tmp_path, model):
    scene = build(capture, model=(model,), warp_width=16, renderer_layers=5)
    scene.save(tmp_path / "scene.safetensors")
    loaded = Scene.load(tmp_path / "scene.safetensors")
    camera = toy_cameras(5, 40, 30)[1]
    for a, b in zip(scene.render(camera), loaded.render(camera), strict=True):
        assert torch.equal(a, b)
    assert [v.name for v in loaded.volumes] == ([] if model == "none" else ["ball"])


def test_a_file_that_is_missing_cut_off_or_foreign_is_refused(scene, tmp_path):
    path = tmp_path / "scene.safetensors"
    with pytest.raises(UserError, match="There is no scene"):
        Scene.load(path)
    scene.save(path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match="not a complete scene file"):
        Scene.load(path)
    from safetensors.torch import save_file

    save_file({"a": torch.zeros(1)}, path)
    with pytest.raises(UserError, match="scene format None"):
        Scene.load(path)
