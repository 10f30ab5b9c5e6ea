"""Hard cases of splatting, on every backend against the reference in float64; and what only native code has."""

import ctypes
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import splatter
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from splatter import splat_points
from test_splatting import NAMES, front_camera, random_scene, weighted_sum

from catacaustics import kernels
from catacaustics.cameras import Camera, Viewport
from catacaustics.config import SplatConfig
from catacaustics.errors import UserError
from catacaustics.kernels import NativeError, find_library, load_library
from catacaustics.splatting import native, reference

# Largest difference from the reference in float64, as a share of the largest value of each result.
TOLERANCE = {torch.float32: 3e-5, torch.float64: 1e-12}
# No pixel lies where rounding decides whether it is drawn.
WIDE = SplatConfig(support=8.0)
EVERYWHERE = [-1e9, -1e9, 1e9, 1e9]
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])

needs_native = pytest.mark.skipif(
    find_library("cpu").library is None, reason=f"no native splatter: {find_library('cpu').problem}"
)


def results(scene, camera, viewport, config, backend=None):
    """Image, transmittance and every gradient, by name, as float64."""
    scene = [t.detach().clone().requires_grad_() for t in scene]
    out = splat_points(*scene, camera, viewport, config, backend)
    out.screen.retain_grad()
    weighted_sum(out.image.double(), out.transmittance.double()).backward()
    named = {"image": out.image, "transmittance": out.transmittance}
    if len(out.visible):
        # By point: two backends may put points that are drawn nowhere on different sides of the cull.
        screen = torch.zeros(len(scene[0]), 2, dtype=torch.float64)
        named["screen"] = screen.index_copy(0, out.visible, out.screen.grad.double().cpu())
    grads = {name: torch.zeros_like(t) if t.grad is None else t.grad for name, t in zip(NAMES, scene, strict=True)}
    return {name: t.detach().double() for name, t in (named | grads).items()}


def assert_like_reference(scene, camera, viewport=None, config=WIDE, scale=1.0):
    """The backend under test agrees with the reference in float64 on the same numbers."""
    got = results(scene, camera, viewport, config)
    want = results([t.double() for t in scene], camera, viewport, config, "reference")
    for name, expected in want.items():
        value = got.get(name, torch.zeros_like(expected))
        assert torch.isfinite(value).all(), name
        if expected.numel():
            error = float((value - expected).abs().max()) / max(float(expected.abs().max()), 1e-30)
            splatter.note_error(scene[0].dtype, name, error)
            allowed = scale * TOLERANCE[scene[0].dtype]
            assert error <= allowed, f"{name}: off by {error:.2e} of the largest value, allowed {allowed:.2e}"
    return got


def facing(depths, opacities, features, footprint=1e-4, dtype=torch.float32):
    """Disks on the axis of a one-pixel camera, facing it."""
    n = len(depths)
    positions = torch.zeros(n, 3, dtype=dtype)
    positions[:, 2] = torch.as_tensor(depths, dtype=dtype)
    normals = torch.tensor([[0.0, 0, -1]], dtype=dtype).expand(n, 3)
    features = torch.as_tensor(features, dtype=dtype).reshape(n, -1)
    opacities = torch.as_tensor(opacities, dtype=dtype).expand(n).clone()
    return [positions, normals, torch.full((n,), footprint, dtype=dtype), opacities, features]


def pinhole(width, height=None, focal=10.0):
    height = height or width
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


@DTYPES
@settings(
    max_examples=15,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],  # the backend is the same for all examples
)
@given(
    n=st.integers(0, 120),
    channels=st.integers(1, 9),
    size=st.sampled_from([1e-4, 0.01, 0.1, 1.0]),
    corner=st.tuples(st.integers(-40, 40), st.integers(-40, 40)),
    shape=st.tuples(st.integers(1, 75), st.integers(1, 75)),
    alpha_min=st.sampled_from([0.0, 1e-6]),
    stop=st.sampled_from([0.0, 1e-4]),
    seed=st.integers(0, 1000),
)
def test_random_scenes_look_as_in_the_reference(
    backend, dtype, n, channels, size, corner, shape, alpha_min, stop, seed
):
    scene = random_scene(n, channels, seed, dtype, size)
    config = SplatConfig(support=8.0, alpha_min=alpha_min, stop_transmittance=stop)
    window = Viewport(*corner, *shape)
    camera = front_camera(60, 50, 60.0)
    want = results([t.double() for t in scene], camera, window, config, "reference")
    got = results(scene, camera, window, config)
    for name, value in got.items():
        expected = want.get(name, torch.zeros_like(value))
        largest = max(float(expected.abs().max()), 1e-3) if expected.numel() else 0
        if alpha_min == stop == 0 and expected.numel():
            splatter.note_error(dtype, name, float((value - expected).abs().max()) / largest)
        # With cut-offs, rounding decides about pairs on the border, which are worth as much as these.
        atol = (TOLERANCE[dtype] + 10 * alpha_min + 10 * stop) * largest
        torch.testing.assert_close(value, expected, rtol=0, atol=atol)


@DTYPES
def test_a_stack_of_5000_opaque_splats_shows_the_first_and_its_gradient_is_exact(backend, dtype):
    n = 5000
    features = torch.rand(n, 3, generator=torch.Generator().manual_seed(0), dtype=dtype)
    scene = [t.requires_grad_() for t in facing(2 + torch.arange(n) / n, 1.0, features, dtype=dtype)]
    out = splat_points(*scene, pinhole(1))
    out.image.sum().backward()
    assert torch.equal(out.image[0, 0].detach(), features[0])
    assert out.transmittance.item() == 0
    expected = torch.zeros(n, dtype=dtype)
    expected[0] = (features[0] - features[1]).sum()
    torch.testing.assert_close(scene[3].grad, expected, rtol=1e-5, atol=0)
    assert scene[4].grad[0].eq(1).all()
    assert scene[4].grad[1:].eq(0).all()


@DTYPES
def test_an_alpha_a_hair_below_one_keeps_its_transmittance(backend, dtype):
    hair = 2.0**-23
    scene = [t.requires_grad_() for t in facing([2, 3], 1 - hair, [0.0, 1.0], dtype=dtype)]
    out = splat_points(*scene, pinhole(1))
    assert out.transmittance.item() == pytest.approx(hair**2, rel=1e-6)
    assert out.image.item() == pytest.approx(hair, rel=1e-6)
    (gradient,) = torch.autograd.grad(out.transmittance.sum(), scene[3])
    assert gradient.tolist() == pytest.approx([-hair, -hair], rel=1e-6)


def test_100000_splats_over_one_pixel_add_up(backend):
    dtype = torch.float64 if backend == "reference" else torch.float32
    n, alpha = 100_000, 2.0**-17  # a power of two: 1 - alpha is exact in float32
    scene = [t.requires_grad_() for t in facing(2 + torch.arange(n) / n, alpha, torch.ones(n), dtype=dtype)]
    out = splat_points(*scene, pinhole(1))
    out.transmittance.sum().backward()
    through = (1 - alpha) ** n
    tolerance = 1e-3 if dtype == torch.float32 else 1e-10
    assert out.transmittance.item() == pytest.approx(through, rel=tolerance)
    assert out.image.item() == pytest.approx(1 - through, rel=tolerance)
    assert float(scene[3].grad.sum()) == pytest.approx(-n * through / (1 - alpha), rel=tolerance)


@pytest.mark.parametrize(
    ("dtype", "stop"), [(torch.float32, 0.0), (torch.float64, 0.0), (torch.float64, 0.9), (torch.float64, 0.3)]
)
def test_a_tile_with_more_pairs_than_are_held_at_a_time_has_the_same_gradients(backend, dtype, stop):
    scene = random_scene(1500, 2, dtype=dtype, size=0.6)
    scene[3] = 0.01 * scene[3]
    assert_like_reference(scene, front_camera(), config=SplatConfig(support=8.0, stop_transmittance=stop), scale=3)


def test_early_stop_at_any_depth_of_a_tile_leaves_gradients_as_they_are(backend):
    """Wherever it falls among the groups, chunks and batches in which splats are taken."""
    scene = random_scene(700, 1, dtype=torch.float64, size=0.6)
    scene[3] = torch.full_like(scene[3], 0.02)
    for stop in (0.99, 0.7, 0.5, 0.3, 0.15, 0.1, 0.05, 0.02, 0.01):
        config = SplatConfig(support=8.0, stop_transmittance=stop)
        assert_like_reference(scene, pinhole(16, focal=16.0), config=config, scale=3)


@DTYPES
@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3])
def test_grazing_disks_look_as_in_the_reference(backend, dtype, angle):
    ray = torch.tensor([0.1, 0.05, 1.0], dtype=torch.float64)
    side = torch.nn.functional.normalize(torch.linalg.cross(ray, torch.tensor([0.0, 1.0, 0.3]).double()), dim=0)
    normal = math.cos(angle) * side + math.sin(angle) * torch.nn.functional.normalize(ray, dim=0)
    one = torch.ones(1, dtype=torch.float64)
    scene = [t.to(dtype) for t in (ray[None], normal[None], 0.05 * one, 0.8 * one, one[:, None])]
    # On edge, the gradients of the normal are differences of large numbers.
    assert_like_reference(scene, pinhole(40, 30, 40.0), scale=100)


@DTYPES
@pytest.mark.parametrize("footprint", [1e-12, 1e6])
def test_footprints_from_nothing_to_larger_than_the_scene(backend, dtype, footprint):
    scene = random_scene(30, dtype=dtype)
    scene[2] = torch.full_like(scene[2], footprint)
    got = assert_like_reference(scene, front_camera(), scale=10)
    assert float(got["image"].max()) > 0


@DTYPES
def test_points_behind_the_camera_or_the_near_plane_are_not_drawn(backend, dtype):
    scene = facing([-2.0, 0.0, 0.99, 1.01], 0.5, [1.0, 2.0, 3.0, 4.0], dtype=dtype)
    out = splat_points(*scene, pinhole(1), config=SplatConfig(near=1.0))
    assert out.visible.tolist() == [3]
    assert out.image.item() == pytest.approx(2.0)


@DTYPES
def test_points_at_equal_depth_keep_their_order_among_many(backend, dtype):
    n = 20_000
    depths = 2 + (torch.arange(n) * 7919 % 13).to(dtype)
    out = splat_points(*facing(depths, 0.5, torch.arange(n), dtype=dtype), pinhole(1))
    assert torch.equal(out.visible, torch.argsort(depths, stable=True))


@DTYPES
def test_centres_a_million_pixels_away_do_no_harm(backend, dtype):
    scene = random_scene(40, dtype=dtype, size=0.1)
    scene[0][:20, :2] = torch.tensor([4e4, -3e4], dtype=dtype)
    scene[2][:10] = 1e9  # these reach into the image
    config = SplatConfig(guard_band=1e9)
    out = splat_points(*[t.requires_grad_() for t in scene], front_camera(), config=config)
    (out.image.sum() + out.transmittance.sum()).backward()
    assert all(torch.isfinite(t.grad).all() for t in scene)
    if dtype == torch.float64:
        assert_like_reference(scene, front_camera(), config=SplatConfig(support=8.0, guard_band=1e9), scale=100)
    scene[0].data[:20, 2] = -1
    alone = splat_points(*scene, front_camera(), config=config)
    if dtype == torch.float64:
        assert (out.transmittance <= alone.transmittance + 1e-12).all()
    assert len(out.visible) >= len(alone.visible)


@DTYPES
def test_splats_that_cover_the_image_look_as_in_the_reference(backend, dtype):
    scene = random_scene(25, 4, dtype=dtype, size=3.0)
    assert_like_reference(scene, front_camera(150, 110, 120.0), scale=3)


@DTYPES
@pytest.mark.parametrize(
    "viewport", [(5, 4, 1, 1), (0, 0, 33, 31), (-70, -50, 65, 129), (23, 17, 64, 3), (100, 100, 7, 9), (0, 0, 0, 5)]
)
def test_viewports_of_any_size_and_place_look_as_in_the_reference(backend, dtype, viewport):
    window = Viewport(*viewport)
    got = assert_like_reference(random_scene(80, dtype=dtype, size=0.1), front_camera(), window)
    assert got["image"].shape == (window.height, window.width, 3)


@DTYPES
def test_no_points_and_transparent_points_leave_all_light_through(backend, dtype):
    for scene in (random_scene(0, dtype=dtype), random_scene(50, dtype=dtype)):
        scene[3].zero_()
        out = splat_points(*scene, front_camera())
        assert out.image.abs().max() == 0
        assert out.transmittance.eq(1).all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("index", range(5))
def test_values_that_are_not_finite_are_refused_by_name_count_and_place(backend, index, value):
    scene = random_scene(70, dtype=torch.float32)
    scene[index].view(-1)[[40, 66]] = value
    place = r"\[\d+(, \d+)?\]"
    with pytest.raises(ValueError, match=rf"{NAMES[index]} has 2 values that are not finite, the first at {place}"):
        splat_points(*scene, front_camera())


def test_denormal_numbers_do_no_harm_and_the_callers_stay(backend):
    tiny = 1e-40
    scene = random_scene(50, dtype=torch.float32)
    scene[4][:] = tiny
    scene[3][::2] = tiny
    out = splat_points(*[t.requires_grad_() for t in scene], front_camera())
    (out.image.sum() + out.transmittance.sum()).backward()
    assert out.image.max() < 1e-38
    assert all(torch.isfinite(t.grad).all() for t in scene)
    assert float(torch.tensor(tiny) * 1) > 0, "denormals are flushed in the caller's thread"


@DTYPES
def test_an_opaque_wall_hides_half_a_million_points_and_still_feels_the_one_behind_it(backend, dtype):
    n = 500_000 if backend in ("cpu", "cuda") and dtype == torch.float32 else 20_000
    scene = random_scene(n, dtype=dtype, size=0.01)
    scene[0][:, 2] += 3
    wall = facing([2.0], 1.0, [[0.5, 0.5, 0.5]], footprint=1e12, dtype=dtype)
    scene = [torch.cat([w, t]).requires_grad_() for w, t in zip(wall, scene, strict=True)]
    out = splat_points(*scene, front_camera())
    out.image.sum().backward()
    assert out.image.detach().sub(0.5).abs().max() < 1e-5
    assert scene[4].grad[1:].abs().max() < 1e-4
    with torch.no_grad():
        behind = splat_points(*[t[1:] for t in scene], front_camera()).image
    assert float(scene[3].grad[0]) == pytest.approx(float((0.5 - behind).sum()), rel=1e-3)


@DTYPES
@pytest.mark.parametrize("channels", [0, 1, 4, 5, 7, 16, 17, 37])
def test_any_number_of_channels(backend, dtype, channels):
    scene = random_scene(100, max(channels, 1), dtype=dtype, size=0.1)
    scene[4] = scene[4][:, :channels]
    if channels:
        assert_like_reference(scene, front_camera(), scale=2)
    else:
        expected = splat_points(*[t.double() for t in scene], front_camera(), None, WIDE, "reference")
        out = splat_points(*scene, front_camera(), None, WIDE)
        torch.testing.assert_close(out.transmittance.double(), expected.transmittance, rtol=1e-4, atol=1e-6)


@DTYPES
def test_large_features_do_not_drown_small_ones_beside_them(backend, dtype):
    scene = random_scene(100, 2, dtype=dtype, size=0.1)
    scene[4] = scene[4] * torch.tensor([1e4, 1e-4], dtype=dtype)
    out = splat_points(*scene, front_camera(), None, WIDE)
    expected = splat_points(*[t.double() for t in scene], front_camera(), None, WIDE, "reference")
    for channel in range(2):
        largest = float(expected.image[..., channel].max())
        error = (out.image[..., channel] - expected.image[..., channel]).abs().max()
        assert float(error) < TOLERANCE[dtype] * largest


@DTYPES
def test_large_features_do_not_drown_the_gradients_of_small_ones(backend, dtype):
    scene = random_scene(100, 2, dtype=dtype, size=0.1)
    scene[4] = scene[4] * torch.tensor([1e4, 1e-4], dtype=dtype)
    got = assert_like_reference(scene, front_camera())
    want = results([t.double() for t in scene], front_camera(), None, WIDE, "reference")
    for channel in range(2):
        error = (got["features"] - want["features"])[:, channel].abs().max()
        assert float(error) < TOLERANCE[dtype] * float(want["features"][:, channel].abs().max())


@DTYPES
def test_tensors_that_are_not_contiguous_are_taken_as_they_are(backend, dtype):
    scene = random_scene(40, 4, dtype=dtype, size=0.1)
    strided = [torch.stack([t, t], -1)[..., 0] for t in scene]
    strided[4] = scene[4].T.contiguous().T
    a, b = splat_points(*scene, front_camera()), splat_points(*strided, front_camera())
    assert torch.equal(a.image, b.image)


def disks(**changes):
    return reference.Disks(*random_scene(6, dtype=torch.float32))._replace(**changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"normals": torch.zeros(5, 3)}, r"normals must have shape \(6, 3\), got \(5, 3\)"),
        ({"footprints": torch.zeros(6, 1)}, r"footprints must have shape \(6,\), got \(6, 1\)"),
        ({"features": torch.zeros(6)}, r"features must have shape \(6, 6\), got \(6,\)"),
        ({"opacities": torch.zeros(6).double()}, "opacities must be float32 or float64 like positions, got .*float64"),
        ({"positions": torch.zeros(6, 3).half()}, "positions must be float32 or float64"),
        ({"normals": torch.zeros(6, 3, device="meta")}, "normals must be on cpu like positions, got meta"),
    ],
)
def test_tensors_that_do_not_go_together_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        reference.check_shapes(**disks(**changes)._asdict())


# What only native code has.


@needs_native
def test_a_function_that_splats_compiles_as_one_graph():
    """In a process of its own: the checks of shapes that tests add cannot be traced."""
    code = """
import sys, torch
sys.path.insert(0, sys.argv[1])
from test_splatting import front_camera, random_scene
from catacaustics.splatting import splat_points

scene, camera = [t.requires_grad_() for t in random_scene(50, dtype=torch.float32, size=0.1)], front_camera()
def loss(*scene):
    out = splat_points(*scene, camera, backend="cpu")
    return (out.image**2).sum() + out.transmittance.sum()

torch._dynamo.config.capture_dynamic_output_shape_ops = True  # how many points are visible is known when it runs
compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
for a, b in zip(torch.autograd.grad(compiled(*scene), scene), torch.autograd.grad(loss(*scene), scene)):
    torch.testing.assert_close(a, b)
"""
    subprocess.run([sys.executable, "-c", code, str(Path(__file__).parent)], check=True, timeout=200)


@needs_native
@pytest.mark.parametrize("low_pass", [0.3, 1e-4])
def test_projection_gradients_pass_finite_differences_for_the_camera_too(low_pass):
    positions, normals, footprints, opacities, _ = random_scene(7, size=0.2)
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.3, -0.2], [-0.3, 0, 0.1], [0.2, -0.1, 0]]).double())
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turn, torch.tensor([0.1, -0.05, 0.2])
    lens = torch.tensor([30.0, 33.0, 12.3, 8.8], dtype=torch.float64)

    def projected(positions, normals, footprints, pose, lens):
        unit = torch.nn.functional.normalize(normals, dim=1)
        cuts = (-500, -500, 1000, 1000, low_pass, 3.33, 0.0, 0.01, *EVERYWHERE)
        return native.splat_project(positions, unit, footprints, opacities, pose, lens, *cuts)[:2]

    inputs = [t.clone().requires_grad_() for t in (positions, normals, footprints, pose, lens)]
    assert torch.autograd.gradcheck(projected, inputs, eps=1e-7, atol=1e-5, rtol=1e-5)


@needs_native
def test_the_operators_keep_torchs_rules():
    scene = random_scene(20, 3, dtype=torch.float32, size=0.1)
    points = [t.requires_grad_() for t in scene[:3]]
    pose, lens = torch.eye(4), torch.tensor([30.0, 33.0, 12.3, 8.8])
    window = [0, 0, 24, 18]
    camera = (pose.requires_grad_(), lens.requires_grad_(), *window)
    project = (*points, scene[3], *camera, 0.3, 3.33, 0.0, 0.01, *EVERYWHERE)
    torch.library.opcheck(native.splat_project, project)
    with torch.no_grad():
        means, forms, visible = native.splat_project(*project)
        screen = (means, forms, scene[3].detach(), visible, *window, 3.33, 0.0)
        torch.library.opcheck(native.splat_bin, screen)
        bins = native.splat_bin(*screen)
    inputs = [t.detach().requires_grad_() for t in (means, forms, scene[3], scene[4])]
    blend = (*inputs, visible, *bins, *window, 0.0, False)
    torch.library.opcheck(native.splat_blend, blend)
    with torch.no_grad():
        image, transmittance = native.splat_blend(*blend)
        splats = (scene[4].detach(), visible, *bins, *window, 0.0, False)
        torch.library.opcheck(native.splat_blend_backward, (image, transmittance, *splats))
        g = (torch.rand_like(means), torch.rand_like(forms))
        camera = [t.detach() for t in (*points, pose, lens)]
        torch.library.opcheck(native.splat_project_backward, (*g, *camera, visible, 0.3))


@needs_native
@DTYPES
def test_results_are_the_same_bit_for_bit_for_every_number_of_threads(dtype):
    scene, camera = random_scene(30_000, 5, dtype=dtype, size=0.02), front_camera(200, 150, 180.0)
    pose, lens = torch.eye(4, dtype=dtype), torch.tensor([180.0, 198.0, 100.3, 74.8], dtype=dtype)
    before, all_results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3, 7):
            torch.set_num_threads(threads)
            got = results(scene, camera, None, SplatConfig(), "cpu")
            inputs = [t.clone().requires_grad_() for t in (pose, lens)]
            window = [0, 0, 200, 150]
            means, forms, _ = native.splat_project(*scene[:4], *inputs, *window, 0.3, 3.33, 0.0, 0.01, *EVERYWHERE)
            (means.sum() + forms.sum()).backward()
            all_results.append([*got.values(), *(t.grad for t in inputs)])
    finally:
        torch.set_num_threads(before)
    for other in all_results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(all_results[0], other, strict=True))


@needs_native
def test_a_whole_image_has_the_gradients_of_its_halves_together():
    """Also where the gradients of the tiles do not fit memory at once."""
    scene, camera = random_scene(300_000, 16, dtype=torch.float32, size=0.002), front_camera(640, 400, 500.0)
    weights = torch.rand(400, 640, 16)

    def gradients(*windows):
        leaves = [t.clone().requires_grad_() for t in scene]
        for x0, width in windows:
            out = splat_points(*leaves, camera, Viewport(x0, 0, width, 400), backend="cpu")
            (out.image * weights[:, x0 : x0 + width]).sum().backward()
        return [t.grad for t in leaves]

    for whole, halves in zip(gradients((0, 640)), gradients((0, 320), (320, 320)), strict=True):
        torch.testing.assert_close(whole, halves, rtol=0, atol=1e-4 * float(whole.abs().max()))


@needs_native
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from Linux' /proc")
def test_memory_kept_for_calls_to_come_is_bounded_and_given_back_when_asked():
    def resident() -> int:
        ctypes.CDLL(None).malloc_trim(0)  # what is free in malloc is not held by the library
        return 1024 * int(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0])

    scene = [t.requires_grad_() for t in random_scene(400_000, 8, dtype=torch.float32, size=0.002)]
    splat_points(*scene, front_camera(640, 400, 500.0), backend="cpu").image.sum().backward()
    before = resident()
    find_library("cpu").library.handle.catacaustics_release()
    assert 2**24 < before - resident() < 2**28 + 2**23


@needs_native
def test_the_screen_positions_are_in_the_graph_for_densification():
    scene = [t.requires_grad_() for t in random_scene(30, dtype=torch.float32, size=0.1)]
    out = splat_points(*scene, front_camera(), backend="cpu")
    out.screen.retain_grad()
    out.image.sum().backward()
    assert out.screen.grad.abs().max() > 0
    assert len(out.screen) == len(out.visible)


@needs_native
def test_every_variant_that_this_processor_runs_gives_the_same(monkeypatch):
    scene, camera = random_scene(2000, 6, dtype=torch.float32, size=0.05), front_camera(120, 90, 100.0)
    best = results(scene, camera, None, WIDE, "cpu")
    tried = 0
    for path in sorted(find_library("cpu").library.path.parent.glob("*_cpu*.so")):
        try:
            variant = load_library(path)
        except NativeError as error:
            assert "needs instructions that this processor lacks" in str(error)  # noqa: PT017
            continue
        tried += 1
        monkeypatch.setattr(kernels, "find_library", lambda _, variant=variant: kernels.Found(variant, ""))
        for name, value in results(scene, camera, None, WIDE, "cpu").items():
            largest = float(best[name].abs().max())
            torch.testing.assert_close(value, best[name], rtol=0, atol=TOLERANCE[torch.float32] * largest)
    assert tried


@needs_native
def test_a_forked_process_splats_too():
    code = (
        "import os, sys, torch; sys.path.insert(0, sys.argv[1]);"
        "from test_splatting import random_scene, front_camera;"
        "from catacaustics.splatting import splat_points;"
        "scene = random_scene(5000, dtype=torch.float32); torch.set_num_threads(2);"
        "splat_points(*scene, front_camera(), backend='cpu');"
        "child = os.fork();\n"
        "if child == 0:\n"
        "    out = splat_points(*scene, front_camera(), backend='cpu'); os._exit(0 if out.image.max() > 0 else 1)\n"
        "sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))"
    )
    subprocess.run([sys.executable, "-c", code, str(Path(__file__).parent)], check=True, timeout=100)


@needs_native
def test_a_library_that_is_missing_damaged_or_foreign_is_refused_with_a_reason(tmp_path):
    whole = find_library("cpu").library.path.read_bytes()
    foreign = bytearray(whole)
    foreign[18:20] = b"\xb7\x00" if foreign[18:20] != b"\xb7\x00" else b"\x3e\x00"
    cases = {
        "missing": (None, "is not there"),
        "empty": (b"", "is not a shared library"),
        "text": (b"#!/bin/sh\n" * 100, "is not a shared library"),
        "half": (whole[: len(whole) // 2], "is cut short"),
        "foreign": (bytes(foreign), "another kind of processor"),
    }
    for name, (data, reason) in cases.items():
        path = tmp_path / f"{name}.so"
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(NativeError, match=reason):
            load_library(path)


@needs_native
def test_another_library_is_refused_and_the_best_of_several_is_taken(tmp_path, monkeypatch):
    other = next((Path(torch.__file__).parent / "lib").glob("libc10.*"))
    with pytest.raises(NativeError, match=r"cannot be loaded.*catacaustics_abi"):
        load_library(other)
    folder = tmp_path / "_native"
    folder.mkdir()
    for installed in find_library("cpu").library.path.parent.glob("*_cpu*.so"):
        (folder / installed.name).write_bytes(installed.read_bytes())
    best = find_library("cpu").library.path.name  # the first that is tried
    (folder / best).write_bytes((folder / best).read_bytes()[:5000])
    monkeypatch.setattr(kernels, "_folders", lambda: [folder])
    found = find_library.__wrapped__("cpu")
    if found.library is None:
        assert found.problem == f"{best} is cut short"
    else:
        assert found.library.path.name != best


def test_without_a_library_the_reference_takes_over_and_says_so_once(monkeypatch, caplog):
    monkeypatch.setattr(kernels, "find_library", lambda _: kernels.Found(None, "it was never built"))
    kernels._say_once.cache_clear()
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "auto")
    for _ in range(3):
        splat_points(*random_scene(5), front_camera())
    assert [r.getMessage() for r in caplog.records].count(
        "computing in PyTorch, which is many times slower than native code: it was never built"
    ) == 1
    kernels._say_once.cache_clear()
    with pytest.raises(UserError, match="it was never built"):
        splat_points(*random_scene(5), front_camera(), backend="cpu")


def test_an_unknown_backend_is_refused_by_name(monkeypatch):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "cdua")
    with pytest.raises(UserError, match="'cdua'"):
        splat_points(*random_scene(5), front_camera())
