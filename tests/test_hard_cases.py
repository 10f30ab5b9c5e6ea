"""Hard cases of splatting, on every backend: known answers, and the reference in float64 on the same numbers."""

import functools
import math
import re

import pytest
import torch
from splatter import (
    DTYPES,
    NAMES,
    TOLERANCE,
    WIDE,
    assert_close,
    assert_like_reference,
    facing,
    front_camera,
    pinhole,
    random_scene,
    reference_results,
    results,
    splat_points,
    tangential,
    weighted_sum,
)

from catacaustics.splatting.config import SplatConfig

GEOMETRY = ("positions", "normals", "footprints")
# The product of 100 000 factors has as many roundings, which walk at random: sqrt(1e5) * 2^-25 = 1e-5, and a tail.
MANY_ROUNDINGS = 2.5


@DTYPES
def test_a_stack_of_5000_opaque_splats_shows_the_first_and_its_gradient_is_exact(backend, dtype):
    """In the pixel on the axis all are opaque; around it, ever less."""
    n = 5000
    features = torch.rand(n, 3, generator=torch.Generator().manual_seed(0), dtype=dtype)
    scene = facing(2 + torch.arange(n) / n, 1.0, features, footprint=0.01, dtype=dtype)
    assert_like_reference(scene, pinhole(5), case="5000 opaque splats")
    scene = [t.requires_grad_() for t in scene]
    out = splat_points(*scene, pinhole(5))
    out.image[2, 2].sum().backward()
    assert torch.equal(out.image[2, 2].detach(), features[0])
    assert out.transmittance[2, 2].item() == 0
    expected = torch.zeros(n, dtype=dtype)
    expected[0] = (features[0] - features[1]).sum()
    torch.testing.assert_close(scene[3].grad, expected, rtol=TOLERANCE[dtype], atol=0)
    assert scene[4].grad[0].eq(1).all()
    assert scene[4].grad[1:].eq(0).all()
    # On the axis alpha has its largest value: no point moves it.
    assert all(t.grad.abs().max() == 0 for t in scene[:3])


@DTYPES
def test_an_alpha_a_hair_below_one_keeps_its_transmittance(backend, dtype):
    hair = 2.0**-23
    scene = [t.requires_grad_() for t in facing([2, 3], 1 - hair, [0.0, 1.0], dtype=dtype)]
    out = splat_points(*scene, pinhole(1))
    assert out.transmittance.item() == pytest.approx(hair**2, rel=1e-6)
    assert out.image.item() == pytest.approx(hair, rel=1e-6)
    (gradient,) = torch.autograd.grad(out.transmittance.sum(), scene[3])
    assert gradient.tolist() == pytest.approx([-hair, -hair], rel=1e-6)


def many_over_one_pixel(n, dtype):
    """Faint disks that face the camera, a little off the axis."""
    g = torch.Generator().manual_seed(0)
    opacities = (0.5 + torch.rand(n, generator=g, dtype=torch.float64)) / n
    scene = facing(2 + torch.arange(n) / n, opacities, torch.rand(n, 2, generator=g), footprint=1e-2, dtype=dtype)
    scene[0][:, :2] = 0.2 * torch.rand(n, 2, generator=g) - 0.05
    return scene


@functools.cache
def reference_of_many(n, dtype):
    return reference_results(many_over_one_pixel(n, dtype), pinhole(1))


@DTYPES
def test_100000_splats_over_one_pixel_add_up_and_so_do_their_gradients(backend, dtype):
    n = 100_000 if backend in ("cpu", "cuda") and dtype == torch.float32 else 10_000  # the others take seconds
    want = reference_of_many(n, dtype)
    assert 0.2 < want["transmittance"].item() < 0.8
    assert all(want[name].any() for name in (*NAMES, "screen"))
    scene, case = many_over_one_pixel(n, dtype), "100000 splats over a pixel"
    assert_like_reference(scene, pinhole(1), case=case, want=want, factor=MANY_ROUNDINGS)


@DTYPES
def test_equal_splats_over_one_pixel_leave_a_power_of_what_one_leaves(backend, dtype):
    n = 100_000 if backend in ("cpu", "cuda") else 10_000
    alpha = 2.0**-17  # a power of two: 1 - alpha is exact in float32
    scene = [t.requires_grad_() for t in facing(2 + torch.arange(n) / n, alpha, torch.ones(n), dtype=dtype)]
    out = splat_points(*scene, pinhole(1))
    out.transmittance.sum().backward()
    through, tolerance = (1 - alpha) ** n, MANY_ROUNDINGS * TOLERANCE[dtype]
    assert out.transmittance.item() == pytest.approx(through, rel=tolerance)
    assert out.image.item() == pytest.approx(1 - through, rel=tolerance)
    expected = torch.full((n,), -through / (1 - alpha), dtype=dtype)
    torch.testing.assert_close(scene[3].grad, expected, rtol=tolerance, atol=0)
    assert scene[4].grad.eq(0).all()


@DTYPES
@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3])
def test_grazing_disks_look_as_in_the_reference(backend, dtype, angle):
    ray = torch.tensor([0.1, 0.05, 1.0], dtype=torch.float64)
    side = torch.nn.functional.normalize(torch.linalg.cross(ray, torch.tensor([0.0, 1.0, 0.3]).double()), dim=0)
    normal = math.cos(angle) * side + math.sin(angle) * torch.nn.functional.normalize(ray, dim=0)
    one = torch.ones(1, dtype=torch.float64)
    scene = [t.to(dtype) for t in (ray[None], normal[None], 0.05 * one, 0.8 * one, one[:, None])]
    assert_like_reference(scene, pinhole(40, 30, 40.0), case=f"grazing by {angle:g}")


@DTYPES
@pytest.mark.parametrize("footprint", [1e-12, 1e6, 1e12, 9e14])
@pytest.mark.parametrize("focal", [30.0, 1000.0])
def test_footprints_from_nothing_to_larger_than_the_scene(backend, dtype, footprint, focal):
    if (backend, dtype, focal, footprint) == ("reference", torch.float32, 1000, 9e14):
        pytest.skip("PyTorch's derivative of 1 / x squares it first")
    scene, camera = random_scene(30, dtype=dtype), front_camera(focal=focal)
    scene[0][:, :2] *= 30 / focal
    scene[2] = torch.full_like(scene[2], footprint)
    got = assert_like_reference(scene, camera, case=f"footprints of {footprint:g}", least=0)
    assert float(got["image"].max()) > 0


@DTYPES
def test_splats_that_cover_the_image_look_as_in_the_reference(backend, dtype):
    scene = random_scene(25, 4, dtype=dtype, size=3.0)
    assert_like_reference(scene, front_camera(150, 110, 120.0), case="splats that cover the image")


@DTYPES
def test_points_behind_the_camera_or_the_near_plane_are_not_drawn(backend, dtype):
    scene = facing([-2.0, 0.0, 0.99, 1.01], 0.5, [1.0, 2.0, 3.0, 4.0], dtype=dtype)
    out = splat_points(*scene, pinhole(1), config=SplatConfig(near=1.0))
    assert out.visible.tolist() == [3]
    assert out.image.item() == pytest.approx(2.0)


@DTYPES
@pytest.mark.parametrize("near", [1.0, 0.01, 1 / 3])
def test_a_point_in_the_near_plane_itself_is_dropped_and_the_next_number_is_not(backend, dtype, near):
    """The plane lies where the type of the points has it."""
    plane = torch.tensor(near, dtype=dtype)
    before, behind = (torch.nextafter(plane, torch.tensor(to, dtype=dtype)) for to in (0.0, 9.0))
    scene = facing(torch.stack([behind, plane, before, plane, behind]), 0.5, torch.arange(5), dtype=dtype)
    out = splat_points(*scene, pinhole(1), config=SplatConfig(near=near))
    assert out.visible.tolist() == [0, 4]
    assert out.image.item() == pytest.approx(1.0)


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
    config = SplatConfig(support=8.0, guard_band=1e9)
    got = assert_like_reference(scene, front_camera(), config=config, case="centres 1e6 px away")
    beside = [t[20:] for t in scene]
    alone = results(beside, front_camera(), None, config)
    assert (got["transmittance"] < 0.9 * alone["transmittance"]).all()


@DTYPES
def test_no_points_leave_all_light_through(backend, dtype):
    got = results(random_scene(0, dtype=dtype), front_camera())
    assert got["image"].eq(0).all()
    assert got["transmittance"].eq(1).all()
    assert all(got[name].shape[0] == 0 for name in NAMES)


@DTYPES
def test_transparent_points_leave_all_light_through_and_feel_what_they_would_change(backend, dtype):
    scene = random_scene(50, dtype=dtype, size=0.1)
    scene[3].zero_()
    got = assert_like_reference(scene, front_camera(), case="transparent points")
    assert got["image"].eq(0).all()
    assert got["transmittance"].eq(1).all()
    assert got["opacities"].ne(0).all()
    assert all(got[name].eq(0).all() for name in (*GEOMETRY, "features", "screen"))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("index", range(5))
@pytest.mark.parametrize("bad", [[40, 66], [0], [20_000, 20_001, 59_999]], ids=str)
def test_values_that_are_not_finite_are_refused_by_name_count_and_place(backend, index, value, bad):
    """`bad` counts numbers from the first on, three in a row of positions, normals and features."""
    scene = random_scene(60_000 if bad[-1] > 100 else 70, dtype=torch.float32)
    scene[index].view(-1)[bad] = value
    place = [bad[0] // 3, bad[0] % 3] if scene[index].ndim == 2 else [bad[0]]
    message = f"{NAMES[index]} has {len(bad)} values that are not finite, the first at {place}"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        splat_points(*scene, front_camera())


def with_denormals(where, dtype):
    """A scene in which some numbers, given or on the way, are less than the smallest normal one of the type."""
    tiny = 1e-40 if dtype == torch.float32 else 1e-310
    scene, config = random_scene(60, dtype=dtype, size=0.1), WIDE
    if where == "features and opacities":
        scene[4][:] = tiny
        scene[3][::2] = tiny
    elif where == "positions":
        scene[0][:, :2] = torch.where(scene[0][:, :2] > 0, tiny, -tiny)
    elif where == "normals":
        scene[1] = torch.tensor([[tiny, -tiny, 1.0], [1.0, tiny, -tiny]], dtype=dtype).repeat(30, 1)
    elif where == "footprints":
        scene[2][:] = tiny
    elif where == "transmittance":
        scene = facing(2 + torch.arange(600) / 600, 0.75, torch.rand(600), footprint=0.1, dtype=dtype)
    elif where == "falloff":
        config = SplatConfig(support=60.0)
        scene[2] *= 0.05
    return scene, config


@DTYPES
@pytest.mark.parametrize(
    "where", ["features and opacities", "positions", "normals", "footprints", "transmittance", "falloff"]
)
def test_numbers_too_small_to_be_normal_cost_no_more_than_themselves(backend, dtype, where):
    """Native code may take them for 0: of each splat and pixel, less than the smallest normal number may be lost."""
    scene, config = with_denormals(where, dtype)
    camera = front_camera()
    pairs = len(scene[0]) * camera.width * camera.height
    room = pairs * torch.finfo(dtype).smallest_normal
    got, want = results(scene, camera, None, config), reference_results(scene, camera, None, config)
    if where == "normals":  # the basis of the tangents depends on the sign of z
        got, want = (g | {"normals": tangential(g["normals"], scene[1])} for g in (got, want))
    assert_close(got, want, dtype, f"denormal {where}", room=room)
    assert float(torch.tensor(1e-40) * 1) > 0, "denormals are flushed in the caller's thread"


def behind_a_wall(n, dtype):
    scene = random_scene(n, dtype=dtype, size=0.01)
    scene[0][:, 2] += 3
    wall = facing([2.0], 1.0, [[0.5, 0.5, 0.5]], footprint=1e12, dtype=dtype)
    return [torch.cat([w, t]) for w, t in zip(wall, scene, strict=True)]


@functools.cache
def reference_behind_a_wall(n):
    return reference_results(behind_a_wall(n, torch.float64), front_camera())


def test_the_trillionth_that_an_opaque_wall_lets_through_looks_as_in_the_reference(backend):
    scene = behind_a_wall(4000, torch.float64)
    assert_like_reference(scene, front_camera(), case="points behind a wall", want=reference_behind_a_wall(4000))


@DTYPES
def test_an_opaque_wall_hides_half_a_million_points_and_still_feels_the_one_behind_it(backend, dtype):
    n = 500_000 if backend in ("cpu", "cuda") and dtype == torch.float32 else 10_000
    scene, camera = behind_a_wall(n, dtype), front_camera()
    got = results(scene, camera, config=SplatConfig())
    assert got["image"].sub(0.5).abs().max() < 1e-5
    assert all(torch.isfinite(value).all() for value in got.values())
    with torch.no_grad():
        behind = splat_points(*[t[1:] for t in scene], camera)
    # The loss is linear in the wall's opacity and features; in the corners the wall is 1 - 1e-12 of what it is.
    image, tolerance = torch.ones(*behind.image.shape, dtype=torch.float64), TOLERANCE[dtype] + 1e-12
    shown = float(weighted_sum(image, 0 * image[..., 0]))
    change = 0.5 * shown - float(weighted_sum(behind.image.double(), behind.transmittance.double()))
    assert float(got["opacities"][0]) == pytest.approx(change, rel=tolerance)
    assert float(got["features"][0].sum()) == pytest.approx(shown, rel=tolerance)
    # It lets nothing through in float32; in float64, some trillionths.
    through = 0.0 if dtype == torch.float32 else 1e-9
    assert all(got[name][1:].abs().max() <= through for name in (*NAMES, "screen"))


@DTYPES
def test_large_features_do_not_drown_small_ones_beside_them_nor_their_gradients(backend, dtype):
    scene = random_scene(100, 2, dtype=dtype, size=0.1)
    scene[4] = scene[4] * torch.tensor([1e4, 1e-4], dtype=dtype)
    want = reference_results(scene, front_camera())
    got = assert_like_reference(scene, front_camera(), case="features of 1e4 and 1e-4", want=want)
    for name in ("image", "features"):
        small = {name: want[name][..., 1]}
        assert_close({name: got[name][..., 1]}, small, dtype, "features of 1e-4 beside 1e4")
