"""Every backend of the splatter against the reference in float64: scenes, settings, viewports, channels and cameras."""

import functools
import inspect

import dense
import pytest
import splatter
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from splatter import (
    DTYPES,
    EVERYWHERE,
    TOLERANCE,
    WIDE,
    assert_close,
    assert_like_reference,
    front_camera,
    moved_camera,
    pinhole,
    random_scene,
    reference_results,
    results,
    tangential,
)

from catacaustics.cameras import Viewport
from catacaustics.splatting import native, reference
from catacaustics.splatting.config import SplatConfig

# How near to a cut-off, as a share of it, rounding decides.
ROOM = {torch.float32: 1e-4, torch.float64: 1e-10}


@DTYPES
@settings(
    max_examples=30,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],  # the backend is the same for all examples
)
@given(
    n=st.integers(0, 120),
    channels=st.integers(1, 9),
    size=st.sampled_from([1e-4, 0.01, 0.1, 1.0]),
    moved=st.booleans(),
    corner=st.tuples(st.integers(-40, 40), st.integers(-40, 40)),
    shape=st.tuples(st.integers(1, 75), st.integers(1, 75)),
    alpha_min=st.sampled_from([0.0, 1e-6, 0.01]),
    stop=st.sampled_from([0.0, 1e-4, 0.1]),
    seed=st.integers(0, 1000),
)
def test_random_scenes_look_as_in_the_reference(
    backend, dtype, n, channels, size, moved, corner, shape, alpha_min, stop, seed
):
    scene = random_scene(n, channels, seed, dtype, size)
    config = SplatConfig(support=8.0, alpha_min=alpha_min, stop_transmittance=stop)
    window = Viewport(*corner, *shape)
    camera = moved_camera(60, 50, 60.0, dtype) if moved else front_camera(60, 50, 60.0)
    pixels = dense.settled_pixels(scene, camera, window, config, ROOM[dtype]) if alpha_min or stop else None
    # Far from the splats there may be next to nothing, down to exp(-32): shares of that say little.
    assert_like_reference(scene, camera, window, config, case="random scenes", pixels=pixels, least=1e-3)


@DTYPES
@pytest.mark.parametrize(
    "config",
    [
        SplatConfig.exact(),
        SplatConfig.fast(),
        SplatConfig(alpha_min=1 / 255),
        SplatConfig.fast(alpha_min=1 / 255, support=8.0),
    ],
    ids=["support", "fast", "alpha_min", "both"],
)
def test_cut_offs_are_those_of_the_reference(backend, dtype, config):
    """Pixels in which rounding may decide about a pair are few, and left out."""
    scene = random_scene(300, 4, dtype=dtype, size=0.12)
    scene[2][::3] *= 0.1
    camera, window = front_camera(40, 30, 40.0), Viewport(2, 1, 35, 29)
    pixels = dense.settled_pixels(scene, camera, window, config, ROOM[dtype])
    assert pixels.double().mean() > (0.95 if dtype == torch.float32 else 0.999)
    want = reference_results(scene, camera, window, config, pixels)
    whole = reference_results(scene, camera, window, WIDE, pixels)
    for name, value in whole.items():
        dropped = float((value - want[name]).abs().max()) / float(value.abs().max())
        assert dropped > 4 * TOLERANCE[dtype], f"{name}: the cut-offs make no difference"
    assert_like_reference(scene, camera, window, config, case="cut-offs", pixels=pixels, want=want)


@DTYPES
@pytest.mark.parametrize("channels", [0, 1, 4, 5, 7, 16, 17, 37])
def test_any_number_of_channels(backend, dtype, channels):
    scene = random_scene(100, channels, dtype=dtype, size=0.1)
    assert_like_reference(scene, front_camera(), case="any number of channels")


@DTYPES
@pytest.mark.parametrize(
    "viewport", [(5, 4, 1, 1), (0, 0, 33, 31), (-70, -50, 65, 129), (23, 17, 64, 3), (100, 100, 7, 9), (0, 0, 0, 5)]
)
def test_viewports_of_any_size_and_place_look_as_in_the_reference(backend, dtype, viewport):
    window = Viewport(*viewport)
    got = assert_like_reference(random_scene(80, dtype=dtype, size=0.1), front_camera(), window, case="viewports")
    assert got["image"].shape == (window.height, window.width, 3)


@pytest.mark.parametrize(
    ("dtype", "stop"),
    [(torch.float32, 0.0), (torch.float64, 0.0), (torch.float64, 0.9), (torch.float64, 0.3)],
    ids=["float32-all", "float64-all", "float64-stop-early", "float64-stop-late"],
)
def test_a_tile_with_more_pairs_than_are_held_at_a_time_has_the_same_gradients(backend, dtype, stop):
    scene = random_scene(1500, 2, dtype=dtype, size=0.6)
    scene[3] = 0.01 * scene[3]
    config = SplatConfig(support=8.0, stop_transmittance=stop)
    assert_like_reference(scene, front_camera(), config=config, case="many pairs in a tile")


@functools.cache
def with_early_stops():
    """A scene, a camera, and for each of some settings what the reference gives."""
    scene, camera = random_scene(700, 1, dtype=torch.float64, size=0.6), pinhole(16, focal=16.0)
    scene[3] = torch.full_like(scene[3], 0.02)
    stops = (0.99, 0.7, 0.5, 0.3, 0.15, 0.1, 0.05, 0.02, 0.01)
    configs = [SplatConfig(support=8.0, stop_transmittance=stop) for stop in stops]
    return scene, camera, [(config, reference_results(scene, camera, None, config)) for config in configs]


def test_early_stop_at_any_depth_of_a_tile_leaves_gradients_as_they_are(backend):
    """Wherever it falls among the groups, chunks and batches in which splats are taken."""
    scene, camera, cases = with_early_stops()
    for config, want in cases:
        assert_like_reference(scene, camera, config=config, case="early stop", want=want)


@DTYPES
def test_tensors_that_are_not_contiguous_are_taken_as_they_are(backend, dtype):
    scene = random_scene(40, 4, dtype=dtype, size=0.1)
    strided = [torch.stack([t, t], -1)[..., 0] for t in scene]
    strided[4] = scene[4].T.contiguous().T
    a, b = results(scene, front_camera()), results(strided, front_camera())
    assert all(torch.equal(a[name], b[name]) for name in a)


def screen_gradients(backend, scene, pose, lens, config):
    """Gradients to points and camera of a sum over means and forms that weighs every value differently, by one of the
    backends or by the textbook's formulas (`dense`)."""
    dtype, device = scene[0].dtype, "cpu" if backend in ("textbook", "reference") else splatter.device.name
    inputs = [t.detach().clone().requires_grad_() for t in (*scene[:3], pose.to(dtype), lens.to(dtype))]
    positions, normals, footprints, pose, lens = (t.to(device) for t in inputs)
    if backend == "textbook":
        means, sigma, _ = dense.project(positions, normals, footprints, pose, lens, config.low_pass)
        w = torch.linalg.inv(sigma)[:, 0, 0]
        forms = torch.stack([w, sigma[:, 0, 1] / sigma[:, 1, 1], 1 / sigma[:, 1, 1]], 1)
        visible = torch.arange(len(means))
    elif backend == "reference":
        project = inspect.unwrap(reference.project)  # as annotated, the lens is made of numbers
        splats = project(positions, normals, footprints, pose, lens[:2].unbind(), lens[2:].unbind(), config.low_pass)
        means, forms, visible = splats.means, splats.forms, torch.arange(len(splats.means))
    else:
        cuts = (-500, -500, 1000, 1000, config.low_pass, config.support, 0.0, config.near, *EVERYWHERE)
        points = (positions, normals, footprints, scene[3].to(device))
        means, forms, visible = native.splat_project(*points, pose, lens, *cuts)
    weights = torch.rand(len(scene[0]), 5, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert len(visible) == len(scene[0])
    (torch.cat([means, forms], 1).double().cpu() * weights[visible.cpu()]).sum().backward()
    names = ("positions", "normals", "footprints", "pose", "lens")
    return {name: t.grad.double() for name, t in zip(names, inputs, strict=True)}


def along_motions(gradients, normals, pose):
    """Gradients for normals that stay unit vectors and poses that stay rigid, see `tangential`."""
    g_pose = gradients["pose"]
    g_turn = g_pose[:3, :3] @ pose[:3, :3].T
    camera = {"turn": g_turn - g_turn.T, "shift": g_pose[:3, 3], "lens": gradients["lens"]}
    return {"positions": gradients["positions"], "normals": tangential(gradients["normals"], normals)} | camera


@DTYPES
@pytest.mark.parametrize("n", [1, 300, 70_000])
def test_gradients_of_points_and_camera_through_the_projection_are_the_textbooks(backend, dtype, n):
    scene = random_scene(n, dtype=dtype, size=0.1)
    camera = moved_camera(60, 50, 60.0, dtype)
    pose = torch.tensor(camera.camera_from_world)
    lens = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy]).to(dtype).double()
    got = screen_gradients(backend, scene, pose, lens, WIDE)
    assert got["pose"][3].eq(0).all()
    exact = [t.double() for t in scene]
    assert_close(got, screen_gradients("reference", exact, pose, lens, WIDE), dtype, "camera and projection")
    textbook = along_motions(screen_gradients("textbook", exact, pose, lens, WIDE), scene[1], pose)
    assert all(textbook[name].any() for name in ("turn", "shift", "lens"))
    assert_close(along_motions(got, scene[1], pose), textbook, dtype, "camera and projection, textbook")


@DTYPES
@pytest.mark.parametrize("stop", [0.0, 1e-4])
def test_two_runs_give_the_same_bit_for_bit_where_that_is_asked_for(backend, dtype, stop):
    config = SplatConfig(stop_transmittance=stop, deterministic=True)
    scene = random_scene(30_000 if backend in ("cpu", "cuda") else 1000, 5, dtype=dtype, size=0.02)
    camera = moved_camera(200, 150, 180.0)
    pose = torch.tensor(camera.camera_from_world)
    lens = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=torch.float64)

    def run():
        return results(scene, camera, None, config) | screen_gradients(backend, scene, pose, lens, config)

    first = run()
    for _ in range(2 if backend == "cuda" else 1):
        for name, value in run().items():
            assert torch.equal(value, first[name]), name
