"""Reflection in surfaces of revolution: quadrics as a closed form, the law of reflection, finite differences, hard
cases; and their fit to the points of a surface."""

import numpy as np
import pytest
import torch

from catacaustics.cameras import Camera, pixel_centers
from catacaustics.geometry import look_at
from catacaustics.reflectors import quadric
from catacaustics.reflectors.fit import PROFILE, fit_body, fit_revolution
from catacaustics.reflectors.revolution import Revolution, distances, profile, ray_distances, specular_points
from catacaustics.reflectors.warps import (
    QuadricWarp,
    RevolutionWarp,
    mirror_of,
    moved_mirror,
    rotation_matrix,
    warp_from_state,
)

CENTER = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
TURN = torch.tensor([0.3, -0.4, 0.2], dtype=torch.float64)
CAMERA = torch.tensor([3.0, 1.5, 0.7], dtype=torch.float64)


def coefficients(constant, linear, quadratic, low, high, count=PROFILE):
    """Of the spline that is a quadratic, by its polar form at the knots (Ramshaw 1987)."""
    cell = (high - low) / (count - 3)
    z = low + cell * (torch.arange(count, dtype=torch.float64) - 1)
    return constant + linear * z + quadratic * (z * z - cell**2 / 3)


def ellipsoid(across=0.5, along=0.8):
    """Wider than its radii, so that its ends are closed."""
    low, high = -1.05 * along, 1.05 * along
    squared = coefficients(across**2, 0.0, -((across / along) ** 2), low, high)
    ends, radii = (torch.tensor(v, dtype=torch.float64) for v in ([low, high], [across, across, along]))
    return Revolution(CENTER, rotation_matrix(TURN), radii, ends, squared)


def radius_of_vase(z):
    """A belly, a neck and a wider mouth, for z in [-0.8, 1]."""
    return 0.3 + 0.12 * np.cos(2.4 * z) + 0.03 * z


def vase():
    """Fitted to its true profile, whose second derivative changes its sign."""
    from scipy.interpolate import BSpline

    low, high = -0.8, 1.0
    knots = low + (high - low) / (PROFILE - 3) * (np.arange(PROFILE + 4) - 3)
    z = np.linspace(low, high, 400)
    matrix = BSpline(knots, np.eye(PROFILE), 3)(z)
    squared = torch.from_numpy(np.linalg.lstsq(matrix, radius_of_vase(z) ** 2, rcond=None)[0])
    radii, ends = (torch.tensor(v, dtype=torch.float64) for v in ([0.42, 0.42, 0.8], [low, high]))
    return Revolution(CENTER, rotation_matrix(TURN), radii, ends, squared)


def random_points(count, nearest=1.2, seed=1):
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1)
    return CENTER + (nearest + 4 * torch.rand(count, 1, generator=generator, dtype=torch.float64)) * directions


def displayed(sources, camera, surface):
    found = specular_points(sources, camera, surface)
    points, sources = found.points[found.visible], sources[found.rows[found.visible]]
    ray = points - camera
    length = ray.norm(dim=1) + (sources - points).norm(dim=1)
    return camera + ray / ray.norm(dim=1, keepdim=True) * length[:, None]


def test_a_profile_is_the_quadratic_it_was_made_from_and_goes_on_in_straight_lines():
    squared = coefficients(0.4, 0.3, -0.7, -0.5, 0.9)
    surface = ellipsoid()._replace(squared=squared, ends=torch.tensor([-0.5, 0.9], dtype=torch.float64))
    z = torch.linspace(-0.5, 0.9, 50, dtype=torch.float64)
    value, slope, curvature = profile(surface, z)
    torch.testing.assert_close(value, 0.4 + 0.3 * z - 0.7 * z * z, rtol=0, atol=1e-14)
    torch.testing.assert_close(slope, 0.3 - 1.4 * z, rtol=0, atol=1e-13)
    torch.testing.assert_close(curvature, torch.full_like(z, -1.4), rtol=0, atol=1e-11)
    for end, outside in ((-0.5, -2.0), (0.9, 3.0)):
        (at, beyond), (rise, same), (_, bend) = profile(surface, torch.tensor([end, outside], dtype=torch.float64))
        torch.testing.assert_close(beyond, at + rise * (outside - end))
        assert same == rise
        assert bend == 0


def test_the_derivatives_of_a_profile_are_those_of_its_values():
    z = torch.linspace(-0.79, 0.99, 200, dtype=torch.float64, requires_grad=True)
    value, slope, curvature = profile(vase(), z)
    torch.testing.assert_close(torch.autograd.grad(value.sum(), z, retain_graph=True)[0], slope)
    torch.testing.assert_close(torch.autograd.grad(slope.sum(), z)[0], curvature)


def test_an_ellipsoid_of_revolution_shows_everything_where_the_quadric_does():
    surface, sources = ellipsoid(), random_points(2000)
    expected = quadric.specular_points(sources, CAMERA, CENTER, surface.frame * surface.radii)
    found = specular_points(sources, CAMERA, surface)
    seen, rows = found.visible, found.rows[found.visible]
    assert expected.visible.sum() > 1000
    # A thing close to the mirror, seen near its rim, may be missed; none is found twice.
    missed = torch.ones(len(sources)).index_fill(0, rows, 0) * expected.visible
    assert missed.sum() < 0.005 * expected.visible.sum()
    assert len(rows.unique()) == len(rows)
    assert expected.visible[rows].all()
    torch.testing.assert_close(found.points[seen], expected.points[rows], rtol=0, atol=1e-10)
    torch.testing.assert_close(found.jacobian[seen], expected.jacobian[rows], rtol=0, atol=1e-10)


def clear(surface, points, directions):
    """Whether rays from a mirror leave it without meeting it again: by a fine march."""
    at, ways = (points - surface.center) @ surface.frame, directions @ surface.frame
    free = torch.ones(len(points), dtype=torch.bool)
    for distance in (3 * torch.linspace(0, 1, 400, dtype=torch.float64)[1:] ** 2).tolist():
        here = at + distance * ways
        between = (here[:, 2] > surface.ends[0]) & (here[:, 2] < surface.ends[1])
        free &= ~(between & (here[:, :2].square().sum(1) < profile(surface, here[:, 2])[0]))
    return free


def mirrored(surface, camera, count=4000):
    """Random points of a mirror that a camera sees, and things farther off that are mirrored there."""
    generator = torch.Generator().manual_seed(0)
    z, turn, far = (torch.rand(count, generator=generator, dtype=torch.float64) for _ in range(3))
    z, turn = surface.ends[0] + z * (surface.ends[1] - surface.ends[0]), 2 * torch.pi * turn
    radius = profile(surface, z)[0].clamp_min(0).sqrt()
    local = torch.stack([radius * turn.cos(), radius * turn.sin(), z], 1)
    at = (surface.center + local @ surface.frame.T).requires_grad_()
    normal = torch.nn.functional.normalize(torch.autograd.grad(distances(surface, at).sum(), at)[0], dim=1)
    at = at.detach()
    to_camera = torch.nn.functional.normalize(camera - at, dim=1)
    cosine = (to_camera * normal).sum(1)
    away = 2 * cosine[:, None] * normal - to_camera
    seen = (cosine > 0.02) & clear(surface, at, to_camera) & clear(surface, at, away)
    return at[seen], (at + (0.3 + 3 * far[:, None]) * away)[seen]


@pytest.mark.parametrize("camera", [[3.0, 1.5, 0.7], [1.0, 0.3, 3.0]])
def test_what_a_vase_mirrors_is_found_wherever_it_is_seen(camera):
    surface, camera = vase(), torch.tensor(camera, dtype=torch.float64)
    at, sources = mirrored(surface, camera)
    found = specular_points(sources, camera, surface)
    rows, points = found.rows[found.visible], found.points[found.visible]
    nearest = torch.full((len(at),), 9.0, dtype=torch.float64)
    nearest.scatter_reduce_(0, rows, (points - at[rows]).norm(dim=1), "amin")
    assert len(at) > 1000
    assert (nearest < 1e-6).double().mean() > 0.985
    images = rows.bincount(minlength=len(at))
    assert (images > 1).sum() > 30  # in the belly, and in the neck or the mouth
    twice = torch.cdist(points[rows == images.argmax()], points[rows == images.argmax()])
    assert (twice + torch.eye(len(twice)) > 1e-3).all()


def test_no_image_is_seen_through_the_mirror():
    surface = vase()
    _, sources = mirrored(surface, CAMERA)
    found = specular_points(sources, CAMERA, surface)
    at = found.points[found.visible]
    for target in (CAMERA.expand_as(at), sources[found.rows[found.visible]]):
        way = torch.nn.functional.normalize(target - at, dim=1)
        assert clear(surface, at + 0.01 * way, way).double().mean() > 0.995


def test_at_a_point_of_reflection_of_a_vase_the_angles_of_incidence_and_reflection_are_equal():
    surface, sources = vase(), random_points(2000)
    found = specular_points(sources, CAMERA, surface)
    assert found.visible.sum() > 500
    x = found.points[found.visible].detach().requires_grad_()
    height = distances(surface, x)
    torch.testing.assert_close(height, torch.zeros_like(height), rtol=0, atol=1e-9)
    normal = torch.nn.functional.normalize(torch.autograd.grad(height.sum(), x)[0], dim=1)
    to_camera = torch.nn.functional.normalize(CAMERA - x, dim=1)
    to_source = torch.nn.functional.normalize(sources[found.rows[found.visible]] - x, dim=1)
    away = 2 * (to_camera * normal).sum(1, keepdim=True) * normal - to_camera
    torch.testing.assert_close(away, to_source, rtol=0, atol=1e-6)


def test_derivatives_agree_with_finite_differences_for_source_camera_place_axis_and_profile():
    surface = vase()
    sources = random_points(300)
    found = specular_points(sources, CAMERA, surface)
    sources = sources[found.rows[found.visible].unique()[:12]]

    def points(sources, camera, center, turn, squared):
        moved = surface._replace(center=center, frame=rotation_matrix(turn), squared=squared)
        return displayed(sources, camera, moved)

    arguments = (sources, CAMERA, CENTER, TURN, surface.squared)
    assert torch.autograd.gradcheck(points, [a.clone().requires_grad_() for a in arguments], atol=1e-6, rtol=1e-5)


def test_the_footprint_jacobian_is_the_derivative_of_the_displayed_point():
    surface = vase()
    sources = random_points(300)
    found = specular_points(sources, CAMERA, surface)
    one = found.visible.nonzero()[5, 0]
    source = sources[found.rows[one]]
    assert (found.rows == found.rows[one]).sum() == 1
    ray = torch.nn.functional.normalize(found.points[one] - CAMERA, dim=0)
    whole = torch.autograd.functional.jacobian(lambda p: displayed(p[None], CAMERA, surface)[0], source)
    flat = (torch.eye(3, dtype=torch.float64) - ray[:, None] * ray) @ whole
    to_source = torch.nn.functional.normalize(source - found.points[one], dim=0)
    across = flat @ (torch.eye(3, dtype=torch.float64) - to_source[:, None] * to_source)
    torch.testing.assert_close(found.jacobian[one], across, rtol=1e-6, atol=1e-9)


def test_a_solution_that_is_handed_back_saves_solving_and_changes_nothing():
    surface, sources = vase(), random_points(100)
    found = specular_points(sources, CAMERA, surface)
    again = specular_points(sources[found.rows], CAMERA, surface, found.start)
    assert torch.equal(again.points, found.points)
    assert again.visible is None


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_is_ever_nan_for_points_inside_on_behind_or_in_line_with_the_mirror(dtype):
    surface = Revolution(*(v.to(dtype) for v in vase()))
    axis, middle = surface.frame[:, 2], surface.center
    on = specular_points(random_points(50).to(dtype), CAMERA.to(dtype), surface).points
    assert len(on) > 20
    inside = middle + 0.2 * (random_points(50, nearest=0).to(dtype) - middle) / 4
    along = middle + torch.linspace(-5, 5, 41, dtype=dtype)[:, None] * axis
    behind = middle - torch.linspace(0.5, 5, 20, dtype=dtype)[:, None] * (CAMERA.to(dtype) - middle)
    far = 1e6 * random_points(20).to(dtype)
    groups = [on, inside, along, behind, far, CAMERA.to(dtype)[None]]
    for camera in (CAMERA.to(dtype), middle + 3 * axis, middle + 0.1 * axis, middle):
        sources = torch.cat(groups).detach().requires_grad_()
        squared = surface.squared.clone().requires_grad_()
        found = specular_points(sources, camera, surface._replace(squared=squared))
        found.points.square().sum().backward()
        for tensor in (found.points, found.jacobian, sources.grad, squared.grad):
            assert torch.isfinite(tensor).all()
        is_inside = distances(surface, sources.detach()) < -1e-4
        assert not found.visible[is_inside[found.rows]].any()


def test_float32_finds_the_points_of_float64():
    surface, sources = vase(), random_points(1000)
    exact = specular_points(sources, CAMERA, surface)
    rough = specular_points(sources.float(), CAMERA.float(), Revolution(*(v.float() for v in surface)))
    points, rows = exact.points[exact.visible], exact.rows[exact.visible]
    found, owners = rough.points.double()[rough.visible], rough.rows[rough.visible]
    error = torch.where(rows[:, None] == owners, torch.cdist(points, found), torch.inf).amin(1)
    assert (error < 1e-4).double().mean() > 0.99
    assert len(owners) < 1.01 * len(rows)


def test_distances_along_rays_are_a_balls_closed_form_and_nan_beside_it():
    ball = ellipsoid(0.5, 0.5)
    pose = look_at(CAMERA.numpy(), CENTER.numpy(), np.array([0.0, 0, 1]))
    camera = Camera(64, 48, 100.0, 100.0, 32.0, 24.0, pose)
    rays = torch.from_numpy(camera.ray_directions(pixel_centers(camera.viewport)).reshape(-1, 3))
    rays = torch.nn.functional.normalize(rays, dim=1)
    b, c = rays @ (CAMERA - CENTER), (CAMERA - CENTER).square().sum() - 0.25
    expected = -b - (b * b - c).sqrt()
    found = ray_distances(ball, CAMERA, rays)
    clear = (b * b - c).abs() > 0.02  # a ray that only grazes it passes between two steps
    assert torch.equal(found.isnan()[clear], expected.isnan()[clear])
    seen = ~expected.isnan() & ~found.isnan()
    torch.testing.assert_close(found[seen], expected[seen], rtol=0, atol=1e-9)
    assert ray_distances(ball, CAMERA, -rays).isnan().all()


def test_a_ray_into_the_open_end_of_a_vase_meets_no_mirror():
    surface = vase()
    axis = surface.frame[:, 2]
    above = CENTER + 5 * axis
    assert ray_distances(surface, above, -axis[None]).isnan().all()


def surface_points(count=3000, spout=0, seed=0):
    rng = np.random.default_rng(seed)
    z, angle = rng.uniform(-0.8, 1, count), rng.uniform(0, 2 * np.pi, count)
    local = np.stack([radius_of_vase(z) * np.cos(angle), radius_of_vase(z) * np.sin(angle), z], 1)
    local[:spout] = rng.uniform([0.3, -0.05, 0], [1.0, 0.05, 0.1], (spout, 3))
    frame = rotation_matrix(TURN).numpy()
    return local @ frame.T + CENTER.numpy() + 0.002 * rng.standard_normal((count, 3)), frame


def test_the_profile_of_a_vase_is_found_although_a_spout_stands_out_of_it():
    points, frame = surface_points(spout=200)
    body = fit_body(points, points.mean(0), np.diag(np.ptp(points, axis=0) / 2), sphere=False)
    surface, loss = fit_revolution(points, *body)
    axis = surface.frame[:, 2].numpy()
    assert abs(axis @ frame[:, 2]) > np.cos(np.radians(0.5))
    z = np.linspace(-0.7, 0.9, 30)
    true = CENTER.numpy() + z[:, None] * frame[:, 2] + radius_of_vase(z)[:, None] * frame[:, 0]
    assert distances(surface, torch.from_numpy(true)).abs().max() < 0.005
    assert loss < 0.6


def test_a_warp_of_revolution_is_found_again_in_its_state_and_all_of_it_learns():
    warp = RevolutionWarp(Revolution(*(v.float() for v in vase())))
    with torch.no_grad():
        for parameter in warp.parameters():
            parameter += 0.01 * torch.arange(1, len(parameter) + 1) / len(parameter)
    points, camera = random_points(200).float(), CAMERA.float()
    again = warp_from_state(warp.state_dict())(points, camera)
    shown = warp(points, camera)
    assert torch.equal(again.positions, shown.positions)
    assert torch.equal(again.visible, shown.visible)
    shown.positions[shown.visible].square().sum().backward()
    assert all(torch.isfinite(p.grad).all() and p.grad.abs().max() > 0 for p in warp.parameters())


def test_a_moved_mirror_of_revolution_shows_moved_surroundings_as_the_resting_one_shows_them():
    warp = RevolutionWarp(vase()).double()
    rotation, shift = rotation_matrix(torch.tensor([0.1, 0.7, -0.3], dtype=torch.float64)), 2 * CENTER
    moved = moved_mirror(warp, 1.5, rotation, shift).double()
    points = random_points(100)
    shown, expected = moved(1.5 * points @ rotation.T + shift, 1.5 * rotation @ CAMERA + shift), warp(points, CAMERA)
    assert torch.equal(shown.visible, expected.visible)
    seen = expected.visible
    positions = 1.5 * expected.positions @ rotation.T + shift
    torch.testing.assert_close(shown.positions[seen], positions[seen], rtol=0, atol=1e-7)
    assert mirror_of(warp) is warp
    assert not isinstance(moved, QuadricWarp)
