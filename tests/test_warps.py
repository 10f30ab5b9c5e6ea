"""The ladder of warps, and where each rung starts: closed forms and known shapes."""

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from catacaustics.cameras import Camera, pixel_centers
from catacaustics.geometry import hull_mesh, look_at, normalize
from catacaustics.reflectors.fit import (
    fit_bent_sheet,
    fit_body,
    fit_bowl,
    fit_ellipsoid,
    fit_plane,
    fit_revolution,
    fit_sphere,
    surroundings,
)
from catacaustics.reflectors.revolution import Revolution
from catacaustics.reflectors.volume import ReflectionVolume, volume_from_masks
from catacaustics.reflectors.warps import (
    MovedWarp,
    NeuralWarp,
    PlaneWarp,
    QuadricNeuralWarp,
    QuadricWarp,
    RevolutionWarp,
    StaticWarp,
    warp_from_state,
)
from catacaustics.training import mirrors
from catacaustics.training.mirrors import off_body

CENTER = torch.tensor([0.2, -0.1, 0.4])


def quadric(radii=(0.5, 0.5, 0.5), sphere=True):
    return QuadricWarp(CENTER, torch.diag(torch.tensor(radii)), sphere)


def every_warp():
    plane = PlaneWarp(torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 0.6, 0.8]), 0.5)
    neural = NeuralWarp(torch.zeros(3), torch.ones(3), 2, 16)
    ellipsoid = quadric((0.5, 0.3, 0.4), sphere=False)
    concave = QuadricWarp(CENTER, 0.5 * torch.eye(3), sphere=False, concave=True)
    turned = RevolutionWarp(
        Revolution(CENTER, torch.eye(3), torch.full((3,), 0.5), torch.tensor([-0.3, 0.4]), torch.full((8,), 0.2))
    )
    return [StaticWarp(), plane, quadric(), ellipsoid, turned, concave, neural, QuadricNeuralWarp(ellipsoid, neural)]


def tangent_planes(center, axes, count=300, seed=0):
    """Half-spaces that touch an ellipsoid: a volume as exact masks would make it."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    support = np.linalg.norm(normals @ axes, axis=1)
    halfspaces = np.c_[normals, -(normals @ center + support)]
    from catacaustics.geometry import intersect_halfspaces

    vertices, active = intersect_halfspaces(halfspaces, center)
    corners, faces = hull_mesh(vertices)
    return ReflectionVolume("thing", halfspaces[active], corners, faces)


def test_a_flat_mirrors_image_does_not_move_with_the_camera_and_is_the_mirror_image():
    warp = PlaneWarp(torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, 2.0]), 1.0)
    points = torch.tensor([[0.3, 0.2, 3.0], [-1.0, 0.5, 1.5], [0.0, 0.0, 0.5]])
    shown = [warp(points, torch.tensor(c)) for c in ([0.0, 0.0, 4.0], [2.0, -1.0, 2.0])]
    torch.testing.assert_close(shown[0].positions, shown[1].positions)
    expected = points * torch.tensor([1.0, 1.0, -1.0]) + torch.tensor([0.0, 0.0, 2.0])
    torch.testing.assert_close(shown[0].positions, expected)
    assert shown[0].visible.tolist() == [True, True, False]
    assert not warp(points, torch.tensor([0.0, 0.0, -1.0])).visible.any()


def test_a_reflection_in_a_ball_lies_on_the_ray_at_the_length_of_the_path():
    warp, camera = quadric(), torch.tensor([3.0, 0.5, 0.2])
    points = torch.randn(100, 3) * 3 + torch.tensor([3.0, 0.0, 2.0])
    shown = warp(points, camera)
    ray = torch.nn.functional.normalize(shown.positions - camera, dim=1)
    # The ray meets the ball, and mirrored there it goes through the point.
    offset = camera - CENTER
    b = ray @ offset
    t = -b - torch.sqrt(b**2 - (offset @ offset - 0.25))
    hit = camera + t[:, None] * ray
    normal = (hit - CENTER) / 0.5
    mirrored = ray - 2 * (ray * normal).sum(1, keepdim=True) * normal
    seen = shown.visible & torch.isfinite(t)
    assert seen.sum() > 50
    torch.testing.assert_close(
        mirrored[seen], torch.nn.functional.normalize(points - hit, dim=1)[seen], rtol=0, atol=2e-3
    )
    path = t + (points - hit).norm(dim=1)
    torch.testing.assert_close((shown.positions - camera).norm(dim=1)[seen], path[seen], rtol=1e-3, atol=1e-3)


def test_a_ball_makes_images_smaller_and_most_so_at_its_rim():
    warp, camera = quadric(), torch.tensor([3.2, -0.1, 0.4])
    ahead, aside = torch.tensor([[6.0, 0.2, 0.4]]), torch.tensor([[-3.0, 5.0, 0.4]])
    stretches = []
    for point in (ahead, aside):
        with torch.no_grad():
            shown = warp(point, camera)
        assert shown.visible.all()
        facing = torch.nn.functional.normalize(camera - shown.positions, dim=1)
        stretches.append((float(shown.stretch), float((shown.normals * facing).sum())))
    assert stretches[0][0] < 0.05
    assert stretches[0][1] > 0.99  # round ahead
    assert stretches[1][1] < 0.5  # squeezed at the rim


def test_a_quadric_learns_its_shape_from_where_reflections_appear():
    """Started 10 % too large and displaced, it finds centre and radius again."""
    truth, camera_ring = quadric(), torch.linspace(0, 6, 12)
    warp = QuadricWarp(CENTER + 0.04, 0.55 * torch.eye(3), sphere=True)
    sources = torch.randn(200, 3) * 2
    optimizer = torch.optim.Adam(warp.parameters(), 0.01)
    for step in range(300):
        a = camera_ring[step % 12]
        camera = CENTER + torch.stack([3 * torch.cos(a), 3 * torch.sin(a), 0.5 * torch.sin(2 * a)])
        want, got = truth(sources, camera), warp(sources, camera)
        both = want.visible & got.visible
        angle = torch.nn.functional.normalize(want.positions - camera, dim=1) - torch.nn.functional.normalize(
            got.positions - camera, dim=1
        )
        loss = (angle[both] ** 2).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    center, axes = warp.shape()
    assert float((center.detach() - CENTER).norm()) < 0.01
    assert float(axes[0, 0].detach()) == pytest.approx(0.5, rel=0.02)


def test_every_warp_is_found_again_in_its_state():
    points, camera = torch.randn(20, 3) * 2, torch.tensor([3.0, 0.5, 0.2])
    for warp in every_warp():
        with torch.no_grad():
            for parameter in warp.parameters():
                parameter += 0.01 * torch.randn_like(parameter)
        again = warp_from_state(warp.state_dict())
        assert type(again) is type(warp)
        for one, other in zip(warp(points, camera), again(points, camera), strict=True):
            assert one is None if other is None else torch.equal(one, other)


def test_every_learned_shape_gets_a_gradient():
    points, camera = torch.randn(50, 3) * 2, torch.tensor([3.0, 0.5, 0.2])
    for warp in every_warp():
        points.requires_grad_()
        warp(points, camera).positions.square().sum().backward()
        assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in warp.parameters())
        assert torch.isfinite(points.grad).all()


def test_a_sphere_is_fitted_to_the_planes_that_touch_it():
    center, radius = np.array([1.0, -2.0, 0.5]), 0.7
    volume = tangent_planes(center, radius * np.eye(3))
    fitted, size = fit_sphere(volume)
    np.testing.assert_allclose(fitted, center, atol=1e-6)
    assert size == pytest.approx(radius, rel=1e-6)
    assert np.linalg.norm(volume.vertices - center, axis=1).mean() > 1.005 * radius  # corners would not do


def test_an_ellipsoid_is_fitted_to_the_planes_that_touch_it():
    center = np.array([1.0, -2.0, 0.5])
    rotation = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    axes = rotation * [0.9, 0.5, 0.3]
    fitted, found = fit_ellipsoid(tangent_planes(center, axes))
    np.testing.assert_allclose(fitted, center, atol=1e-5)
    np.testing.assert_allclose(found @ found.T, axes @ axes.T, atol=1e-5)


def test_where_no_ellipsoid_fits_its_sphere_is_taken():
    corners = np.array([[x, y, z] for x in (0, 2.0) for y in (0, 1.0) for z in (0, 0.02)])
    hull = ConvexHull(corners)
    vertices, faces = hull_mesh(corners)
    volume = ReflectionVolume("sheet", np.unique(hull.equations.round(9), axis=0), vertices, faces)
    center, axes = fit_ellipsoid(volume)
    assert np.isfinite(center).all()
    radii = np.linalg.norm(axes, axis=0)
    assert (radii > 0).all()
    assert (radii <= volume.radius * 3).all()


@pytest.mark.parametrize("sphere", [True, False])
def test_the_body_is_found_although_a_spout_stands_out_of_it(sphere):
    rng = np.random.default_rng(0)
    center, axes = np.array([0.3, -0.2, 1.0]), np.eye(3) if sphere else np.diag([1.0, 0.7, 1.4])
    body = center + normalize(rng.normal(size=(700, 3))) @ axes.T
    spout = center + np.array([1.2, 0.3, 0.2]) + rng.uniform(-0.25, 0.25, (250, 3))
    points = np.concatenate([body, spout]) + 0.003 * rng.normal(size=(950, 3))
    found, size = fit_body(points, center + [0.2, 0.1, 0], 1.2 * np.eye(3), sphere)
    np.testing.assert_allclose(found, center, atol=0.01)
    np.testing.assert_allclose(np.sort(np.linalg.norm(size, axis=0)), np.sort(np.diag(axes)), rtol=0.02)


def test_points_that_lie_on_no_body_leave_the_start_as_it_is():
    line = np.linspace(-1, 1, 200)[:, None] * np.array([1.0, 0, 0])
    found, size = fit_body(line, np.zeros(3), np.eye(3), sphere=False)
    assert np.array_equal(found, np.zeros(3))
    assert np.array_equal(size, np.eye(3))


def test_the_plane_of_a_thin_volume_is_its_face_towards_the_cameras():
    corners = np.array([[x, y, z] for x in (0, 2.0) for y in (0, 1.0) for z in (-0.02, 0.0)])
    vertices, faces = hull_mesh(corners)
    volume = ReflectionVolume("mirror", np.unique(ConvexHull(corners).equations.round(9), axis=0), vertices, faces)
    for side in (1, -1):
        cameras = np.array([[1.0, 0.5, 3.0 * side], [0.0, 0.0, 2.0 * side]])
        point, normal = fit_plane(volume, cameras)
        assert abs(normal[2] * side - 1) < 1e-3
        assert point[2] == pytest.approx(0.0 if side > 0 else -0.02, abs=2e-3)


def test_a_flat_mirror_seen_from_the_front_alone_is_found_inside_its_thick_volume():
    """Masks from the front leave a double pyramid; the mirror is its widest section, 20 degrees oblique here."""
    turn = look_at(np.zeros(3), np.array([0.3, 0.2, 1.0]), np.array([0.0, 1.0, 0.1]))[:3, :3]
    across, along, normal = turn
    corners = np.array([0.6 * i * across + 0.4 * j * along for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    masks, centers = [], []
    for k, angle in enumerate(np.linspace(-0.7, 0.7, 6)):
        eye = -3 * (np.cos(angle) * normal + np.sin(angle) * across) + (0.8 if k % 2 else -0.5) * along
        camera = Camera(300, 200, 330.0, 330.0, 150.0, 100.0, look_at(eye, np.zeros(3), np.array([0.0, -1.0, 0.0])))
        outline = camera.project(corners)[0]
        edges = [(outline[i], outline[(i + 1) % 4] - outline[i]) for i in range(4)]
        offsets = pixel_centers(camera.viewport)[..., None, :] - [a for a, _ in edges]
        side = np.stack([e[0] * offsets[..., i, 1] - e[1] * offsets[..., i, 0] for i, (_, e) in enumerate(edges)])
        masks.append((f"view{k}", camera, (side > 0).all(0) | (side < 0).all(0)))
        centers.append(eye)
    point, found = fit_plane(volume_from_masks("mirror", masks), np.array(centers))
    assert np.degrees(np.arccos(-found @ normal)) < 0.5
    assert abs(point @ normal) < 0.003


def hull_volume(points):
    vertices, faces = hull_mesh(points)
    return ReflectionVolume("hull", np.unique(ConvexHull(points).equations.round(9), axis=0), vertices, faces)


def test_the_inner_side_of_a_bowl_is_found_from_its_outside():
    """A cap of 68 degrees of a sphere of radius 0.27, open to the cameras above."""
    polar, turn = (a.ravel() for a in np.meshgrid(np.linspace(0, np.radians(68), 20), np.linspace(0, 2 * np.pi, 40)))
    down = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), -np.cos(polar)], 1)
    cameras = np.array([[0.5, 0, 1.0], [-0.4, 0.3, 1.2], [0.1, -0.5, 0.9]])
    center, radius = fit_bowl(hull_volume(0.27 * down + [1.0, 2.0, 3.0]), cameras + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(center, [1.0, 2.0, 3.0], atol=0.01)
    assert radius == pytest.approx(0.27, rel=0.03)


@pytest.mark.parametrize("side", [1, -1])
def test_a_bent_sheet_is_found_as_a_cylinder_with_its_convex_side(side):
    """An arc of 95 degrees and radius 0.34, 0.4 high, bulging to `side` of x."""
    angle = np.radians(np.linspace(-47.5, 47.5, 30))
    arc = np.stack([side * 0.34 * np.cos(angle), 0.34 * np.sin(angle)], 1)
    volume = hull_volume(np.concatenate([np.c_[arc, np.full(30, z)] for z in (-0.2, 0.2)]))
    cylinders = fit_bent_sheet(volume)
    center, axes = cylinders[np.argmax([abs(a[2, 0]) for _, a in cylinders])]
    np.testing.assert_allclose(center, 0, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=0)[1:], 0.34, rtol=0.05)
    assert side * axes[0, 2] > 0.32
    assert fit_bent_sheet(tangent_planes(np.zeros(3), 0.3 * np.eye(3))) == []


def test_a_bent_sheet_starts_as_a_cylinder_alone_and_a_flat_ellipsoid_does_not():
    rng = np.random.default_rng(0)
    angle, z = np.radians(rng.uniform(-47.5, 47.5, 2000)), rng.uniform(-0.2, 0.2, 2000)
    sheet = np.stack([0.34 * np.cos(angle), 0.34 * np.sin(angle), z], 1)
    axes = np.diag([0.1, 0.4, 0.5])
    pebble = normalize(rng.normal(size=(2000, 3))) @ axes
    for points, volume, starts in (
        (sheet, hull_volume(sheet), 2),
        (pebble, tangent_planes(np.zeros(3), axes), 4),
    ):
        assert len(fit_bent_sheet(volume)) == 2  # both are flat
        center, axes = (torch.from_numpy(v).float() for v in fit_ellipsoid(volume))
        body = mirrors.nearest_ellipsoid(points, volume)
        found = mirrors._starts(QuadricWarp(center, axes, sphere=False), volume, body)
        assert len(found) == starts
        longest = max(float(axes.norm(dim=0).max()) for _, axes, _ in found)
        assert (longest > 1.5) == (starts == 2)  # a cylinder is a long ellipsoid


def test_surroundings_are_spread_evenly_and_show_the_nearest_known_point():
    volume = tangent_planes(np.zeros(3), 0.3 * np.eye(3))
    rng = np.random.default_rng(0)
    shell = rng.standard_normal((20_000, 3))
    shell = 2 * shell / np.linalg.norm(shell, axis=1, keepdims=True)
    shell = shell[shell[:, 2] < 0.5]
    wall = np.concatenate([shell, 1.5 * shell[:5000]])  # farther points in the same directions
    colors = np.concatenate([np.tile([1.0, 0, 0], (len(shell), 1)), np.tile([0, 0, 1.0], (5000, 1))])
    positions, found = surroundings(wall, colors, volume, 1500, 10.0, np.array([0.2, 0.2, 0.2]), rng)
    distance = np.linalg.norm(positions, axis=1)
    known = positions[:, 2] / distance < 0.2
    assert (np.abs(distance[known] - 2) < 1e-3).mean() > 0.97
    assert (found[known, 0] > 0.9).mean() > 0.97
    top = positions[:, 2] / distance > 0.8
    np.testing.assert_allclose(distance[top], 10.0, rtol=1e-3)
    np.testing.assert_allclose(found[top], 0.2)
    assert abs((positions[:, 0] > 0).mean() - 0.5) < 0.02


def test_a_reflector_moved_with_its_surroundings_shows_the_moved_image():
    """For the camera that moved along, the picture is the old one, moved."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
    turn = turn * torch.sign(torch.linalg.det(turn))
    scale, shift = 1.7, torch.tensor([0.4, -2.0, 1.1])
    points, camera = torch.randn(30, 3) * 2, torch.tensor([3.0, 0.5, 0.2])
    for warp in every_warp():
        with torch.no_grad():
            old, new = warp(points, camera), MovedWarp(warp, scale, turn, shift)(points, scale * turn @ camera + shift)
        seen = torch.ones(len(points), dtype=torch.bool) if old.visible is None else old.visible
        expected = scale * old.positions @ turn.T + shift
        torch.testing.assert_close(new.positions[seen], expected[seen], rtol=1e-3, atol=2e-3)
        again = warp_from_state(MovedWarp(warp, scale, turn, shift).state_dict())
        assert isinstance(again, MovedWarp)
        assert type(again.warp) is type(warp)


def test_the_distance_from_a_body_has_a_gradient_that_moves_a_mirror_onto_the_points():
    rng = np.random.default_rng(0)
    points = torch.from_numpy(normalize(rng.normal(size=(500, 3))) * [1.0, 0.8, 1.3])
    true = QuadricWarp(torch.zeros(3), torch.diag(torch.tensor([1.0, 0.8, 1.3])), sphere=False).double()
    assert off_body(points, true) < 1e-8
    mirror = QuadricWarp(torch.tensor([0.03, 0, -0.02]), torch.diag(torch.tensor([1.03, 0.82, 1.28])), False).double()
    optimizer = torch.optim.Adam(mirror.parameters(), 2e-3)
    for _ in range(100):
        optimizer.zero_grad()
        off_body(points, mirror).backward()
        optimizer.step()
    center, axes = (value.detach().numpy() for value in mirror.shape())
    np.testing.assert_allclose(center, 0, atol=3e-3)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=0), [1.0, 0.8, 1.3], atol=3e-3)


def test_the_distance_from_a_turned_body_has_a_gradient_that_moves_its_profile_onto_the_points():
    rng = np.random.default_rng(0)
    points = normalize(rng.normal(size=(1000, 3))) * [1.0, 1.0, 1.3]
    surface, loss = fit_revolution(points, np.zeros(3), np.diag([1.0, 1.0, 1.3]))
    mirror = RevolutionWarp(surface._replace(squared=surface.squared + 0.05)).double()
    before = float(off_body(torch.from_numpy(points), mirror).detach())
    optimizer = torch.optim.Adam(mirror.parameters(), 2e-2)
    for _ in range(150):
        optimizer.zero_grad()
        off_body(torch.from_numpy(points), mirror).backward()
        optimizer.step()
    assert float(off_body(torch.from_numpy(points), mirror).detach()) < 0.05 * before
    assert loss < 0.02
