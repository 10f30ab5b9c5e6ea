"""The splatter against brute force, closed forms and finite differences."""

import math

import dense
import numpy as np
import pytest
import torch
from splatter import (
    NAMES,
    WIDE,
    front_camera,
    moved_camera,
    random_scene,
    results,
    splat_points,
    tangential,
    weighted_sum,
)

from catacaustics.cameras import Camera, Viewport
from catacaustics.splatting.config import SplatConfig
from catacaustics.splatting.reference import tangent_basis

pytestmark = pytest.mark.usefixtures("backend")


@pytest.mark.parametrize("cuts", [{}, {"stop_transmittance": 0.3}, {"alpha_min": 0.02}], ids=str)
@pytest.mark.parametrize("budget", [10**9, 300])
@pytest.mark.parametrize("see", [front_camera, moved_camera])
def test_image_and_every_gradient_agree_with_brute_force_whatever_the_memory_budget(budget, cuts, see):
    config = SplatConfig(support=4.0, pair_budget=budget, **cuts)
    camera, viewport = see(), Viewport(3, 2, 17, 13)
    scene = [t.requires_grad_() for t in random_scene(60, size=0.05)]
    out = splat_points(*scene, camera, viewport, config)
    expected = dense.splat(*scene, camera, viewport, config)
    torch.testing.assert_close(out.image, expected[0], rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(out.transmittance, expected[1], rtol=1e-10, atol=1e-12)
    got = torch.autograd.grad(weighted_sum(out.image, out.transmittance), scene)
    want = torch.autograd.grad(weighted_sum(*expected), scene)
    got, want = ([*g[:1], tangential(g[1], scene[1].detach()), *g[2:]] for g in (got, want))
    for name, a, b in zip(NAMES, got, want, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-10, msg=lambda m, name=name: f"{name}: {m}")


@pytest.mark.parametrize("n", [1, 2, 50])
def test_gradients_pass_finite_differences(n):
    scene = [t.requires_grad_() for t in random_scene(n, channels=2, seed=n, size=0.15)]
    camera, viewport = front_camera(), Viewport(9, 6, 5, 4)

    def blend(positions, normals, footprints, opacities, features):
        unit = torch.nn.functional.normalize(normals, dim=1)
        out = splat_points(positions, unit, footprints, opacities, features, camera, viewport, WIDE)
        return out.image, out.transmittance

    # Fast mode checks a random projection of the Jacobian: 50 splats have 550 inputs.
    assert torch.autograd.gradcheck(blend, scene, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=n > 2)


def test_one_facing_disk_integrates_to_its_closed_form():
    """The integral of o exp(-q/2) over the screen is 2 pi o sqrt(det Sigma)."""
    camera = Camera(101, 101, 50.0, 50.0, 50.5, 50.5, np.eye(4))
    s, z, opacity = 0.04, 2.0, 0.7
    one = torch.ones(1, dtype=torch.float64)
    position = torch.tensor([[0.0, 0.0, z]], dtype=torch.float64)
    normal = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    out = splat_points(position, normal, s * one, opacity * one, one[:, None], camera, config=WIDE)
    variance = s * (50 / z) ** 2 + 0.3
    assert float(out.image.sum()) == pytest.approx(2 * math.pi * opacity * variance, rel=1e-9)


def test_an_opaque_splat_hides_what_is_behind_it_and_gradients_stay_exact():
    camera = Camera(1, 1, 10.0, 10.0, 0.5, 0.5, np.eye(4))
    positions = torch.tensor([[0.0, 0, 3], [0.0, 0, 2], [0.0, 0, 4]], dtype=torch.float64)
    normals = torch.tensor([[0.0, 0, 1]] * 3, dtype=torch.float64)
    opacities = torch.ones(3, dtype=torch.float64, requires_grad=True)
    features = torch.tensor([[0.2], [0.5], [0.9]], dtype=torch.float64, requires_grad=True)
    footprints = torch.full((3,), 1e-4, dtype=torch.float64)
    out = splat_points(positions, normals, footprints, opacities, features, camera)
    assert out.image.item() == 0.5
    assert out.transmittance.item() == 0
    g_opacity, g_features = torch.autograd.grad(out.image.sum(), (opacities, features))
    # The front splat at opacity 1: dI/do = c_front - (what is right behind it) = 0.5 - 0.2.
    torch.testing.assert_close(g_opacity, torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64))
    torch.testing.assert_close(g_features[:, 0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


def test_a_transparent_splat_still_has_an_opacity_gradient():
    camera = Camera(1, 1, 10.0, 10.0, 0.5, 0.5, np.eye(4))
    scene = random_scene(1)
    scene[0] = torch.tensor([[0.0, 0, 2]], dtype=torch.float64)
    scene[3] = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    out = splat_points(*scene, camera)
    (gradient,) = torch.autograd.grad(out.image.sum(), scene[3])
    assert float(gradient) == pytest.approx(float(scene[4].sum()), rel=1e-12)


def test_points_at_equal_depth_keep_their_input_order():
    camera = Camera(1, 1, 10.0, 10.0, 0.5, 0.5, np.eye(4))
    positions = torch.tensor([[0.0, 0, 2]] * 2)
    normals = torch.tensor([[0.0, 0, 1]] * 2)
    features = torch.tensor([[1.0], [2.0]])
    out = splat_points(positions, normals, torch.full((2,), 1e-4), torch.ones(2), features, camera)
    assert float(out.image) == 1.0


def test_input_order_changes_neither_image_nor_gradients_where_depths_differ():
    scene = random_scene(80)
    shuffle = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    a = results(scene, front_camera())
    b = results([t[shuffle] for t in scene], front_camera())
    for name, value in b.items():
        expected = a[name] if name in ("image", "transmittance") else a[name][shuffle]
        torch.testing.assert_close(value, expected, rtol=0, atol=1e-13 * float(expected.abs().max()))


def test_a_viewport_is_a_crop_and_may_reach_outside_the_image():
    scene = random_scene(60)
    camera = front_camera()
    whole = splat_points(*scene, camera, Viewport(-4, -4, 40, 30))
    part = splat_points(*scene, camera, Viewport(2, 3, 5, 7))
    torch.testing.assert_close(part.image, whole.image[7:14, 6:11], rtol=1e-12, atol=1e-14)


def test_a_point_beside_the_camera_does_not_cover_the_image():
    """Nearly in the camera plane, 60 degrees outside the view: its affine footprint would be thousands of pixels."""
    one = torch.ones(1)
    beside = torch.tensor([[0.5, 0.0, 0.02]])
    out = splat_points(beside, torch.tensor([[0.0, 1.0, 0.0]]), 1e-2 * one, one, one[:, None], front_camera())
    assert out.image.abs().max() == 0


def test_the_camera_pose_moves_the_image_as_moving_the_points_does():
    scene = random_scene(40)
    pose = torch.tensor(moved_camera().camera_from_world)
    a = splat_points(*scene, moved_camera())
    moved = (scene[0] @ pose[:3, :3].T + pose[:3, 3], scene[1] @ pose[:3, :3].T)
    b = splat_points(*moved, *scene[2:], front_camera())
    torch.testing.assert_close(a.image, b.image, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("n", [0, 5])
def test_nothing_in_view_gives_black_and_full_transmittance(n):
    scene = random_scene(5)
    scene = [t[:n] for t in scene]
    scene[0] = scene[0] - torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
    out = splat_points(*scene, front_camera())
    assert out.image.abs().max() == 0
    assert out.transmittance.min() == 1


def test_a_small_pair_budget_gives_the_same_float32_image_as_an_ample_one():
    scene = random_scene(500, dtype=torch.float32, size=0.2)
    camera = front_camera()
    small = splat_points(*scene, camera, config=SplatConfig(pair_budget=20_000))
    ample = splat_points(*scene, camera, config=SplatConfig(pair_budget=10**8))
    torch.testing.assert_close(small.image, ample.image, rtol=1e-5, atol=1e-6)


def test_early_stop_draws_nothing_behind_and_gradients_belong_to_that_image():
    """T in front of each splat is 1, 1/2, 1/4, 1/8: with a stop of 1/4, three are drawn."""
    camera = Camera(1, 1, 10.0, 10.0, 0.5, 0.5, np.eye(4))
    positions = torch.tensor([[0.0, 0, z] for z in (2, 3, 4, 5)])
    half = torch.full((4,), 0.5, requires_grad=True)
    features = torch.tensor([[1.0], [10.0], [100.0], [1000.0]], requires_grad=True)
    facing = torch.tensor([[0.0, 0, -1]]).expand(4, 3)
    out = splat_points(
        positions, facing, torch.full((4,), 1e-4), half, features, camera, config=SplatConfig(stop_transmittance=0.25)
    )
    assert out.image.item() == 0.5 + 10 / 4 + 100 / 8
    assert out.transmittance.item() == 1 / 8
    (out.image.sum() + 16 * out.transmittance.sum()).backward()
    assert features.grad is not None
    assert half.grad is not None
    assert features.grad[:, 0].tolist() == [1 / 2, 1 / 4, 1 / 8, 0]
    # T_i (c_i - R_i), where R is what is seen behind: 16, then half of it and half of each colour.
    assert half.grad.tolist() == [1 - (5 + 29), (10 - 58) / 2, (100 - 16) / 4, 0]


def test_the_presets_differ_in_the_cut_offs_alone():
    assert SplatConfig.exact() == SplatConfig()
    assert SplatConfig.fast(near=0.5) == SplatConfig(near=0.5, stop_transmittance=1e-4)
    with pytest.raises(TypeError, match="alpha_mni"):
        SplatConfig.fast(alpha_mni=0.1)


def test_the_fast_preset_changes_the_image_by_no_more_than_the_light_it_stops():
    scene = random_scene(600, size=0.2)
    exact = splat_points(*scene, front_camera(), config=SplatConfig.exact())
    fast = splat_points(*scene, front_camera(), config=SplatConfig.fast())
    error = (exact.image - fast.image).abs().max()
    assert 0 < error <= 1e-4 * float(scene[4].max())


def test_cut_off_at_small_alpha_changes_the_image_by_no_more_than_what_it_drops():
    scene = random_scene(60)
    exact = splat_points(*scene, front_camera(), config=SplatConfig(support=6.0))
    cut = splat_points(*scene, front_camera(), config=SplatConfig(support=6.0, alpha_min=1 / 255))
    error = (exact.transmittance - cut.transmittance).abs().max()
    assert 0 < error < 60 / 255


def test_values_out_of_range_and_wrong_types_are_refused_by_name():
    for index, value, message in ((2, -1.0, "footprints"), (3, 1.5, "opacities"), (3, -0.5, "opacities")):
        scene = random_scene(6)
        scene[index][3] = value
        with pytest.raises(ValueError, match=rf"{message}.*\[3\]"):
            splat_points(*scene, front_camera())
    scene = random_scene(6)
    scene[4] = scene[4].float()
    with pytest.raises(ValueError, match="features must be float32 or float64 like positions"):
        splat_points(*scene, front_camera())


def test_tangents_and_normal_are_orthonormal_for_every_direction():
    normals = torch.nn.functional.normalize(torch.randn(1000, 3, dtype=torch.float64), dim=1)
    normals[:2] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    frame = torch.stack([*tangent_basis(normals), normals], 1)
    identity = torch.eye(3, dtype=torch.float64).expand(1000, 3, 3)
    torch.testing.assert_close(frame @ frame.transpose(1, 2), identity, atol=1e-12, rtol=0)
