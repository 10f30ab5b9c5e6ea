"""The cull before splatting: in PyTorch and in native code, which agree, and never drop a point that is drawn."""

import numpy as np
import pytest
import torch
from splatter import front_camera, needs_native

from catacaustics.cameras import Camera, Viewport
from catacaustics.geometry import look_at
from catacaustics.splatting import points_in_view
from catacaustics.splatting.config import SplatConfig

BACKENDS = pytest.mark.parametrize("backend", ["reference", pytest.param("cpu", marks=needs_native)])
NEAR = SplatConfig().near


def some_points(n, size, dtype, seed=0):
    """Points all around the origin, some at the near plane of a camera there, with footprints about size^2."""
    rng = torch.Generator().manual_seed(seed)
    positions = 3 * torch.randn(n, 3, generator=rng, dtype=torch.float64)
    positions[::7] *= 0.01
    positions[::11, 2] = NEAR * (1 + 1e-3 * torch.randn(len(positions[::11]), generator=rng, dtype=torch.float64))
    footprints = size**2 * torch.exp(2 * torch.randn(n, generator=rng, dtype=torch.float64))
    return positions.to(dtype), footprints.to(dtype)


def cameras():
    posed = look_at(np.array([1.0, -2.0, 4.0]), np.array([0.2, 0.1, 0.0]), np.array([0.0, -1.0, 0.0]))
    return [front_camera(60, 50, 60.0), Camera(300, 200, 250.0, 280.0, 140.0, 110.0, posed)]


@needs_native
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("size", [1e-6, 0.03, 1.0, 1e4])
@pytest.mark.parametrize("viewport", [(0, 0, 60, 50), (20, 10, 1, 1), (-50, -70, 40, 60), (400, 100, 30, 30)])
def test_native_code_keeps_the_points_that_pytorch_keeps(monkeypatch, dtype, size, viewport):
    for camera in cameras():
        positions, footprints = some_points(20_003, size, dtype)
        chosen = (positions, footprints, camera, Viewport(*viewport))
        native = points_in_view(*chosen)
        monkeypatch.setenv("CATACAUSTICS_BACKEND", "reference")
        expected = points_in_view(*chosen)
        monkeypatch.delenv("CATACAUSTICS_BACKEND")
        assert native.dtype == expected.dtype
        assert (native.diff() > 0).all()
        differ = set(native.tolist()) ^ set(expected.tolist())
        assert len(differ) <= (3 if dtype == torch.float32 else 0)  # rounding decides


@BACKENDS
def test_points_behind_the_near_plane_beside_the_view_and_not_a_number_are_dropped(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    camera = front_camera(60, 50, 60.0)
    nan, depth = float("nan"), float(torch.linalg.inv(torch.tensor(camera.camera_from_world))[2, 3])
    seen = [0.0, 0.0, depth + 5]
    positions = torch.tensor(
        [seen, [0, 0, depth - 5], [0, 0, depth], [0, 0, depth + NEAR / 2], [nan, 0, depth + 5], [9, 0, depth + 5], seen]
    )
    footprints = torch.full((7,), 1e-4)
    footprints[6] = nan
    assert points_in_view(positions, footprints, camera, camera.viewport).tolist() == [0]
    footprints[5] = 1e4  # wide enough to reach the image, but its centre is too far out
    assert points_in_view(positions, footprints, camera, camera.viewport).tolist() == [0]


@BACKENDS
def test_a_footprint_reaches_into_a_viewport_beside_its_centre(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    camera = Camera(60, 50, 60.0, 60.0, 30.0, 25.0, np.eye(4))
    positions = torch.tensor([[0.0, 0, 2]]).expand(2, 3)
    # Ten pixels are a third of a unit at depth 2, and a splat reaches three standard deviations.
    config = SplatConfig(support=3.0, low_pass=0.0)
    reach = 10 / 30 / 3
    footprints = torch.tensor([(0.97 * reach) ** 2, (1.03 * reach) ** 2])
    assert points_in_view(positions, footprints, camera, Viewport(40, 20, 5, 10), config).tolist() == [1]


@BACKENDS
def test_of_no_points_none_are_in_view(monkeypatch, backend):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", backend)
    camera = front_camera(60, 50, 60.0)
    assert points_in_view(torch.zeros(0, 3), torch.zeros(0), camera, camera.viewport).tolist() == []


@needs_native
def test_threads_do_not_change_which_points_are_kept():
    positions, footprints = some_points(50_000, 0.1, torch.float32)
    camera, threads, kept = cameras()[1], torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            kept.append(points_in_view(positions, footprints, camera, camera.viewport))
    finally:
        torch.set_num_threads(threads)
    assert len(kept[0]) > 1000
    assert all(torch.equal(kept[0], other) for other in kept[1:])
