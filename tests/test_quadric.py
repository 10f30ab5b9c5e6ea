"""Reflection in spheres and ellipsoids: closed forms, brute force, finite differences, hard cases."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from catacaustics.reflectors.fermat import tilted_disks
from catacaustics.reflectors.quadric import specular_points, sphere_angle

CENTER = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
RADII = {"sphere": (0.5, 0.5, 0.5), "ellipsoid": (0.5, 0.3, 0.7), "pancake": (0.8, 0.8, 0.2)}


def axes_of(radii, seed=0):
    torch.manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    return rotation @ torch.diag(torch.tensor(radii, dtype=torch.float64))


def outside_points(count, axes, seed=1, nearest=1.3):
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1)
    distance = nearest + 4 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    return CENTER + distance * axes.norm(dim=0).max() * directions


def displayed(sources, camera, center, axes, concave=False):
    points = specular_points(sources, camera, center, axes, concave).points
    ray = points - camera
    length = ray.norm(dim=1) + (sources - points).norm(dim=1)
    return camera + ray / ray.norm(dim=1, keepdim=True) * length[:, None]


def unit(vectors):
    return torch.nn.functional.normalize(vectors, dim=1)


@pytest.mark.parametrize("concave", [False, True])
@pytest.mark.parametrize("shape", RADII)
def test_at_a_point_of_reflection_the_angles_of_incidence_and_reflection_are_equal(shape, concave):
    axes = axes_of(RADII[shape])
    sources, camera = outside_points(300, axes), outside_points(1, axes, seed=7)[0]
    found = specular_points(sources, camera, CENTER, axes, concave)
    assert found.visible.sum() > 100
    x = found.points[found.visible]
    normal = unit((x - CENTER) @ torch.linalg.inv(axes @ axes.T)) * (-1 if concave else 1)
    to_camera, to_source = unit(camera - x), unit(sources[found.visible] - x)
    mirrored = 2 * (to_camera * normal).sum(1, keepdim=True) * normal - to_camera
    torch.testing.assert_close(mirrored, to_source, rtol=0, atol=1e-10)
    on_surface = ((x - CENTER) @ torch.linalg.inv(axes).T).norm(dim=1)
    torch.testing.assert_close(on_surface, torch.ones_like(on_surface), rtol=0, atol=1e-12)


def test_on_a_convex_mirror_the_path_is_the_shortest_over_the_surface_that_both_see():
    axes = axes_of(RADII["ellipsoid"])
    sources, camera = outside_points(40, axes), outside_points(1, axes, seed=7)[0]
    found = specular_points(sources, camera, CENTER, axes)
    generator = torch.Generator().manual_seed(0)
    u = unit(torch.randn(200_000, 3, generator=generator, dtype=torch.float64))
    surface, normals = CENTER + u @ axes.T, u @ torch.linalg.inv(axes)
    seen = ((camera - surface) * normals).sum(1) > 0
    for source, point, visible in zip(sources, found.points, found.visible, strict=True):
        both = seen & (((source - surface) * normals).sum(1) > 0)
        length = (camera - surface).norm(dim=1) + (source - surface).norm(dim=1)
        shortest = length[both].min() if both.any() else math.inf
        if visible:
            own = (camera - point).norm() + (source - point).norm()
            assert own <= shortest + 1e-12
            assert own > shortest - 2e-3


def test_a_source_that_no_ray_reaches_is_not_visible():
    """Behind the ball, in the cone that it hides from the camera."""
    axes = 0.5 * torch.eye(3, dtype=torch.float64)
    camera = CENTER + torch.tensor([3.0, 0, 0], dtype=torch.float64)
    behind = CENTER - torch.tensor([[1.0, 0, 0], [2.0, 0.1, 0], [1.0, 0, 0.2]], dtype=torch.float64)
    assert not specular_points(behind, camera, CENTER, axes).visible.any()
    beside = CENTER + torch.tensor([[-1.0, 3.0, 0], [-1.0, 0, 5.0]], dtype=torch.float64)
    assert specular_points(beside, camera, CENTER, axes).visible.all()


@pytest.mark.parametrize("concave", [False, True])
@pytest.mark.parametrize("shape", RADII)
def test_derivatives_agree_with_finite_differences_for_source_camera_centre_and_axes(shape, concave):
    axes = axes_of(RADII[shape])
    sources, camera = outside_points(8, axes, seed=3), outside_points(1, axes, seed=7)[0]
    keep = specular_points(sources, camera, CENTER, axes, concave).visible
    arguments = [t.clone().requires_grad_() for t in (sources[keep], camera, CENTER, axes)]
    assert keep.sum() >= 3
    assert torch.autograd.gradcheck(lambda *a: displayed(*a, concave), arguments, eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("concave", [False, True])
@pytest.mark.parametrize("shape", RADII)
def test_the_footprint_jacobian_is_the_derivative_of_the_displayed_point(shape, concave):
    axes = axes_of(RADII[shape])
    sources, camera = outside_points(8, axes, seed=3), outside_points(1, axes, seed=7)[0]
    found = specular_points(sources, camera, CENTER, axes, concave)
    whole = torch.autograd.functional.jacobian(lambda s: displayed(s, camera, CENTER, axes, concave), sources)
    own = torch.stack([whole[i, :, i] for i in range(len(sources))])
    a, b = unit(camera - found.points), unit(sources - found.points)
    eye = torch.eye(3, dtype=torch.float64)
    across = (eye - a[:, :, None] * a[:, None, :]) @ own @ (eye - b[:, :, None] * b[:, None, :])
    torch.testing.assert_close(found.jacobian[found.visible], across[found.visible], rtol=1e-8, atol=1e-8)


def test_magnification_by_a_sphere_is_coddingtons():
    radius, axes = 0.5, 0.5 * torch.eye(3, dtype=torch.float64)
    sources, camera = outside_points(50, axes), outside_points(1, axes, seed=7)[0]
    found = specular_points(sources, camera, CENTER, axes)
    d1, d2 = (camera - found.points).norm(dim=1), (sources - found.points).norm(dim=1)
    cosine = (unit(camera - found.points) * unit(found.points - CENTER)).sum(1)
    sagittal = 1 / (1 + 2 * d1 * d2 * cosine / (radius * (d1 + d2)))
    tangential = 1 / (1 + 2 * d1 * d2 / (radius * cosine * (d1 + d2)))
    values = torch.linalg.svdvals(found.jacobian)
    seen = found.visible
    torch.testing.assert_close(values[seen, 0], sagittal[seen])
    torch.testing.assert_close(values[seen, 1], tangential[seen])


def test_near_the_axis_a_sphere_obeys_the_mirror_equation():
    """1/d_o - 1/d_i = -2/R for a convex mirror: the image of a small object, seen from far, is d_i behind it."""
    radius, distance = 0.5, 2.0
    axes = radius * torch.eye(3, dtype=torch.float64)
    vertex = CENTER + torch.tensor([radius, 0, 0], dtype=torch.float64)
    height = 1e-5
    source = vertex + torch.tensor([[distance, height, 0]], dtype=torch.float64)
    image_distance = 1 / (1 / distance + 2 / radius)
    image_height = height * image_distance / distance
    for far in (10.0, 100.0):
        camera = vertex + torch.tensor([far, 0, 0], dtype=torch.float64)
        point = specular_points(source, camera, CENTER, axes).points[0]
        angle = (point[1] - CENTER[1]) / (camera[0] - point[0])
        assert float(angle) == pytest.approx(image_height / (far + image_distance), rel=1e-6)


def test_a_huge_sphere_is_a_flat_mirror():
    radius = 1e5
    center = torch.tensor([0, 0, -radius], dtype=torch.float64)
    axes = radius * torch.eye(3, dtype=torch.float64)
    sources = torch.rand(50, 3, dtype=torch.float64) * 2 + torch.tensor([0, 0, 0.5], dtype=torch.float64)
    camera = torch.tensor([1.0, -1.0, 1.5], dtype=torch.float64)
    flat = sources * torch.tensor([1, 1, -1], dtype=torch.float64)
    torch.testing.assert_close(displayed(sources, camera, center, axes), flat, rtol=0, atol=1e-3)


def test_a_concave_mirror_shows_far_sources_upside_down_and_near_ones_upright():
    """Inside a sphere of radius 1 the focus lies at half the radius from the mirror."""
    axes = torch.eye(3, dtype=torch.float64)
    center = torch.zeros(3, dtype=torch.float64)
    camera = torch.tensor([0, 0, 6.0], dtype=torch.float64)

    def height_seen(depth):
        source = torch.tensor([[1e-4, 0, depth]], dtype=torch.float64)
        found = specular_points(source, camera, center, axes, concave=True)
        assert found.visible.all()
        assert float(found.points[0, 2]) == pytest.approx(-1, abs=1e-6)
        return float(found.points[0, 0])

    assert height_seen(-0.9) > 0
    assert height_seen(-0.6) > 0
    assert height_seen(4.0) < 0


def test_a_sphere_given_as_an_ellipsoid_of_almost_equal_radii_gives_the_same_points():
    sphere = 0.5 * torch.eye(3, dtype=torch.float64)
    nearly = torch.diag(torch.tensor([0.5, 0.5, 0.5 + 2e-6], dtype=torch.float64))
    sources, camera = outside_points(200, sphere), outside_points(1, sphere, seed=7)[0]
    exact, close = (specular_points(sources, camera, CENTER, a) for a in (sphere, nearly))
    assert (exact.visible == close.visible).float().mean() > 0.98
    both = exact.visible & close.visible
    torch.testing.assert_close(exact.points[both], close.points[both], rtol=0, atol=2e-5)


@pytest.mark.parametrize("concave", [False, True])
@pytest.mark.parametrize("shape", RADII)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_is_ever_nan_for_points_inside_on_behind_or_in_line_with_the_mirror(shape, concave, dtype):
    axes = axes_of(RADII[shape]).to(dtype)
    center = CENTER.to(dtype)
    line = torch.linspace(-3, 3, 61, dtype=dtype)[:, None] * unit(axes.T)[:1]
    far, near = center + 1e12 * unit(axes.T), (center + 1e-30)[None]
    sources = torch.cat([center + line, center + axes.T, center[None], near, far])
    sources.requires_grad_()
    for camera in (center, center + axes[:, 0], center + 2 * axes[:, 0], center + 1e-7, center + 1e9, sources[3]):
        camera = camera.detach().clone().requires_grad_()
        found = specular_points(sources, camera, center, axes, concave)
        normals, stretch = tilted_disks(found.jacobian, unit(camera.detach() - found.points.detach()))
        for tensor in (found.points, found.jacobian, normals, stretch):
            assert torch.isfinite(tensor).all()
        found.points.sum().backward()
        assert torch.isfinite(sources.grad).all()
        assert torch.isfinite(camera.grad).all()


@settings(max_examples=60, deadline=None)
@given(
    camera=st.floats(1.0001, 1e4),
    source=st.floats(1.0001, 1e4),
    between=st.floats(0, math.pi),
    concave=st.booleans(),
)
def test_the_root_on_a_sphere_is_found_from_the_axis_to_grazing(camera, source, between, concave):
    radius = torch.tensor(-1.0 if concave else 1.0, dtype=torch.float64)
    d1, d2, phi = (torch.tensor([v], dtype=torch.float64) for v in (camera, source, between))
    angle = sphere_angle(d1, d2, phi, radius)

    def incidence(distance, turn):
        return torch.atan2(distance * torch.sin(turn), distance * torch.cos(turn) - radius)

    grid = torch.linspace(0, 1, 100_001, dtype=torch.float64) * phi
    values = incidence(d1, grid) - incidence(d2, phi - grid)
    below = grid[values <= 1e-9]
    assert 0 <= float(angle) <= between
    assert float(angle) == pytest.approx(float(below.max() if len(below) else 0), abs=between * 1e-5 + 1e-7)


def test_float32_finds_the_points_of_float64():
    axes = axes_of(RADII["ellipsoid"])
    sources, camera = outside_points(500, axes), outside_points(1, axes, seed=7)[0]
    exact = specular_points(sources, camera, CENTER, axes)
    rounded = specular_points(sources.float(), camera.float(), CENTER.float(), axes.float())
    both = exact.visible & rounded.visible
    assert (exact.visible == rounded.visible).float().mean() > 0.99
    error = (exact.points - rounded.points.double()).norm(dim=1)[both]
    assert float(error.max()) < 2e-4
    assert float(error.median()) < 2e-6


def test_a_tilted_disk_looks_like_the_ellipse_of_the_jacobian():
    generator = np.random.default_rng(0)
    ray = unit(torch.from_numpy(generator.standard_normal((20, 3))))
    eye = torch.eye(3, dtype=torch.float64)
    across = eye - ray[:, :, None] * ray[:, None, :]
    jacobian = across @ torch.from_numpy(generator.standard_normal((20, 3, 3)))
    normals, stretch = tilted_disks(jacobian, ray)
    disk = stretch[:, None, None] * (eye - normals[:, :, None] * normals[:, None, :])
    seen = across @ disk @ across  # the disk, flattened along the ray
    torch.testing.assert_close(seen, jacobian @ jacobian.transpose(1, 2))
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(20, dtype=torch.float64))
