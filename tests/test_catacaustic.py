"""Reflection flow: on a path-traced ball with known geometry, and catacaustics against rays that meet."""

from pathlib import Path

import numpy as np
import pytest
import torch

from catacaustics.capture.dataset import open_capture
from catacaustics.capture.truth import read_reflectors, read_truth, truth_path
from catacaustics.catacaustic import caustic_errors, flow_error, sphere_caustic
from catacaustics.reflectors.volume import build_volume
from catacaustics.reflectors.warps import QuadricWarp, StaticWarp
from catacaustics.renderer import NeuralRenderer
from catacaustics.scene import PointParameters, Scene
from catacaustics.splatting.config import SplatConfig

BALL = Path(__file__).parents[1] / "data_samples" / "ball"


@pytest.fixture(scope="module")
def ball():
    capture = open_capture(BALL)
    geometry = read_reflectors(BALL)["ball"]
    return capture, build_volume(capture, "ball"), geometry["center"], geometry["radius"]


def scene_of(volume, warp, positions):
    def cloud(points, rho):
        n = len(points)
        half = torch.full((n,), 0.5)
        points = torch.as_tensor(points, dtype=torch.float32)
        return PointParameters(points, torch.ones(n, 3), half, half.clone(), torch.zeros(n, 6), rho)

    primary = cloud(np.zeros((1, 3)), torch.full((1,), 0.5))
    return Scene(primary, [cloud(positions, None)], [warp], [volume], None, NeuralRenderer(8, 3), SplatConfig())


def true_sources(capture):
    views = [v for v in capture.train if truth_path(BALL, v.name).is_file()]
    maps = [read_truth(BALL, v.name).source.reshape(-1, 3)[::37] for v in views]
    sources = np.concatenate(maps)
    return sources[np.isfinite(sources).all(1)][:4000]


def sphere_warp(center, radius):
    return QuadricWarp(torch.tensor(center), radius * torch.eye(3), sphere=True)


def test_the_true_sphere_displays_true_sources_where_the_path_tracer_saw_them(ball):
    capture, volume, center, radius = ball
    scene = scene_of(volume, sphere_warp(center, radius), true_sources(capture))
    error = flow_error(scene, capture)
    assert error.samples > 5000
    assert error.median < 0.15
    assert error.mean < 0.5
    assert error.static > 1  # there was motion to get wrong


def test_a_wrong_sphere_and_a_reflection_that_sticks_to_the_surface_are_found_out(ball):
    capture, volume, center, radius = ball
    sources = true_sources(capture)
    right = flow_error(scene_of(volume, sphere_warp(center, radius), sources), capture)
    wrong = flow_error(scene_of(volume, sphere_warp(center, 0.8 * radius), sources), capture)
    assert wrong.median > 3 * right.median
    surface, _ = volume.sample_surface(3000, np.random.default_rng(0))
    stuck = flow_error(scene_of(volume, StaticWarp(), surface), capture)
    assert stuck.median == pytest.approx(stuck.static, rel=0.35)
    assert stuck.median > 8 * right.median


def test_a_capture_without_truth_has_no_flow_error(ball, tmp_path):
    capture, volume, center, radius = ball
    from dataclasses import replace

    scene = scene_of(volume, sphere_warp(center, radius), np.ones((10, 3)))
    assert flow_error(scene, replace(capture, root=tmp_path)) is None


def test_on_the_catacaustic_neighbouring_reflected_rays_meet():
    """Brute force: mirror a pencil of rays from the source in the plane of incidence and cut two of them."""
    center, radius = torch.zeros(3, dtype=torch.float64), 0.5
    source = torch.tensor([1.2, 0.9, 0.0], dtype=torch.float64)
    camera = torch.tensor([2.0, -1.0, 0.0], dtype=torch.float64)
    found = sphere_caustic(source, center, radius, camera)

    def reflected(angle):
        point = radius * np.array([np.cos(angle), np.sin(angle)])
        ray = point - source.numpy()[:2]
        normal = point / radius
        return point, ray - 2 * (ray @ normal) * normal

    # The ray that reaches the camera, and its neighbour.
    angles = np.linspace(-1.2, 1.2, 200_001)
    miss = [np.cross(np.append(reflected(a)[1], 0), np.append(camera.numpy()[:2] - reflected(a)[0], 0))[2]
            for a in angles[::100]]  # fmt: skip
    start = angles[::100][np.argmin(np.abs(miss))]
    low, high = start - 2e-3, start + 2e-3

    def miss_at(a):
        point, ray = reflected(a)
        to = camera.numpy()[:2] - point
        return ray[0] * to[1] - ray[1] * to[0]

    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if miss_at(low) * miss_at(middle) > 0 else (low, middle)
    (p, r), (q, s) = reflected(low - 1e-6), reflected(low + 1e-6)
    t = np.linalg.solve(np.stack([r, -s], 1), q - p)[0]
    np.testing.assert_allclose(found.numpy()[:2], p + t * r, atol=1e-4)


def test_the_sphere_warp_lies_on_the_catacaustics_rays_and_a_static_point_does_not():
    center, radius = torch.tensor([0.1, 0.2, -0.1], dtype=torch.float64), 0.4
    source = torch.tensor([1.0, 1.5, 0.3], dtype=torch.float64)
    angles = torch.linspace(-0.6, 0.9, 15, dtype=torch.float64)
    cameras = center + 2 * torch.stack([torch.cos(angles), torch.sin(angles), 0.3 * torch.sin(3 * angles)], 1)
    warp = QuadricWarp(center, radius * torch.eye(3, dtype=torch.float64), sphere=True).double()
    assert caustic_errors(warp, source, source, center, radius, cameras).max() < 1e-6
    first = sphere_caustic(source, center, radius, cameras[0])
    static = caustic_errors(StaticWarp(), first, source, center, radius, cameras)
    assert static[0] < 1e-6
    assert static.max() > 1
