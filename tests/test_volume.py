"""Reflection volumes against bodies whose shape is known."""

import time
from dataclasses import replace

import numpy as np
import pytest

from catacaustics.cameras import Camera, Viewport
from catacaustics.capture.dataset import View, open_capture, write_capture
from catacaustics.errors import UserError
from catacaustics.geometry import chebyshev_center, hull_mesh, intersect_halfspaces, is_bounded, look_at, rigid
from catacaustics.images import write_image
from catacaustics.reflectors.volume import (
    ReflectionVolume,
    build_volume,
    lift_halfplanes,
    mask_halfplanes,
    partly_hidden,
    volume_from_masks,
)

CUBE = np.concatenate([np.c_[np.eye(3), -np.ones(3)], np.c_[-np.eye(3), -np.ones(3)]])
UP = np.array([0, -1.0, 0.1])


def camera_at(eye, target=(0, 0, 0), width=160, height=120, focal=130.0) -> Camera:
    pose = look_at(np.asarray(eye, float), np.asarray(target, float), UP)
    return Camera(width, height, focal, focal, width / 2 + 3, height / 2 - 2, pose)


def random_cameras(rng, n, target=(0, 0, 0), distance=4.0, **kwargs) -> list[Camera]:
    """Cameras around a target, at least 40 degrees apart."""
    directions = []
    while len(directions) < n:
        d = rng.normal(size=3)
        d /= np.linalg.norm(d)
        if all(abs(d @ other) < np.cos(np.radians(40)) for other in directions):
            directions.append(d)
    return [camera_at(target + distance * rng.uniform(0.9, 1.3) * d, target, **kwargs) for d in directions]


def silhouette(vertices: np.ndarray, camera: Camera, touched: bool) -> np.ndarray:
    """Mask of a convex body: pixels whose centres it covers, or all that it touches (and a few at sharp corners)."""
    from scipy.spatial import ConvexHull

    pixels, depth = camera.project(vertices)
    assert (depth > 0).all()
    lines = ConvexHull(pixels).equations
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    reach = np.abs(lines[:, :2]).sum(-1) / 2 if touched else 0
    return (x[..., None] * lines[:, 0] + y[..., None] * lines[:, 1] + lines[:, 2] <= reach).all(-1)


def random_body(rng) -> np.ndarray:
    points = rng.normal(size=(rng.integers(5, 30), 3)) * rng.uniform(0.1, 0.4, 3)
    return points @ np.linalg.qr(rng.normal(size=(3, 3)))[0]


def inside_points(vertices: np.ndarray, rng, n: int = 300) -> np.ndarray:
    weights = rng.exponential(size=(n, len(vertices))) ** 3
    return weights / weights.sum(-1, keepdims=True) @ vertices


def masks_of(vertices, cameras, touched=True):
    return [(f"view{i}", c, silhouette(vertices, c, touched)) for i, c in enumerate(cameras)]


def ball(n: int = 400) -> np.ndarray:
    """Points spread evenly over the unit sphere."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.arange(n) * np.pi * (3 - np.sqrt(5))
    return np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], -1)


def four_views():
    return random_cameras(np.random.default_rng(5), 4)


# Convex polyhedra ----------------------------------------------------------------------------------------------------


def test_the_largest_ball_in_a_cube_is_its_inscribed_ball():
    center, radius = chebyshev_center(CUBE)
    np.testing.assert_allclose(center, 0, atol=1e-9)
    assert radius == pytest.approx(1)


def test_an_empty_intersection_has_a_negative_radius_and_an_open_one_an_infinite_radius():
    apart = np.array([[1.0, 0, 0, 1], [-1, 0, 0, 1]])  # x <= -1 and x >= 1
    assert chebyshev_center(np.concatenate([CUBE, apart]))[1] == pytest.approx(-1)
    assert chebyshev_center(CUBE[:3])[1] == np.inf


def test_only_closed_sets_of_normals_bound_a_volume():
    assert is_bounded(CUBE[:, :3])
    assert not is_bounded(CUBE[:5, :3])
    assert not is_bounded(CUBE[[0, 1, 3, 4], :3])  # an endless prism


def test_a_cube_is_found_from_its_half_spaces_and_redundant_ones_are_left_out():
    far = np.concatenate([CUBE, [[1.0, 0, 0, -5]]])
    points, active = intersect_halfspaces(far, np.array([0.1, 0.2, 0.3]))
    vertices, faces = hull_mesh(points)
    assert active.tolist() == [0, 1, 2, 3, 4, 5]
    assert len(vertices) == 8
    np.testing.assert_allclose(np.abs(vertices), 1)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    outward = np.cross(b - a, c - a)
    assert ((outward * (a + b + c)).sum(-1) > 0).all()
    assert np.linalg.norm(outward, axis=-1).sum() / 2 == pytest.approx(24)


# Outlines ------------------------------------------------------------------------------------------------------------


def squares_inside(mask, planes) -> bool:
    """Whether the corners of all the mask's pixels satisfy the half-planes."""
    y, x = np.nonzero(mask)
    corners = np.concatenate([np.stack([x + i, y + j, np.ones_like(x)], -1) for i in (0, 1) for j in (0, 1)])
    return bool((corners @ planes.T <= 1e-5).all())


def random_masks():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:90, :120]
    for _ in range(30):
        cx, cy, a, b, t = rng.uniform([0, 0, 1, 1, 0], [120, 90, 50, 40, np.pi])
        u, v = (x - cx) * np.cos(t) + (y - cy) * np.sin(t), (y - cy) * np.cos(t) - (x - cx) * np.sin(t)
        yield (u / a) ** 2 + (v / b) ** 2 < 1
    for density in (1e-4, 1e-3, 1e-2):
        for _ in range(5):
            yield rng.random((90, 120)) < density


@pytest.mark.parametrize("tolerance", [0.5, 3.0, 20.0])
def test_a_simplified_outline_never_cuts_into_its_mask(tolerance):
    for mask in filter(np.any, random_masks()):
        assert squares_inside(mask, mask_halfplanes(mask, tolerance))


def test_a_simplified_outline_has_few_edges_and_stays_close():
    y, x = np.mgrid[:300, :300] + 0.5
    distance = np.hypot(x - 150, y - 150)
    planes = mask_halfplanes(distance < 100)
    assert len(planes) < 60
    offset = -(planes[:, 2] + planes[:, :2] @ [150, 150])
    assert offset.max() < 102


def test_an_outline_on_the_image_border_is_open_there():
    mask = np.zeros((90, 120), bool)
    mask[20:40, 0:30] = True
    # Top and bottom turned outwards by a pixel over their length of 30, and the right side.
    planes = mask_halfplanes(mask)
    planes /= np.abs(planes[:, :2]).max(-1, keepdims=True)
    expected = [[1 / 30, -1, 19], [1 / 30, 1, -41], [1, 0, -30]]
    np.testing.assert_allclose(sorted(planes.tolist()), expected, atol=1e-12)
    mask = np.zeros((90, 120), bool)
    mask[:, 50:] = True
    planes = mask_halfplanes(mask)
    assert (planes[:, 0] < -0.99).all()
    assert (planes @ [200, 45, 1] < 0).all()


@pytest.mark.parametrize("seed", range(20))
def test_an_outline_cut_by_the_image_border_holds_the_convex_shape_outside_too(seed):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-100:200, -100:250] + 0.5
    t = rng.uniform(0, np.pi)
    center, (a, b) = rng.uniform([-10, -10], [130, 100]), rng.uniform(25, 70, 2)
    u = (x - center[0]) * np.cos(t) + (y - center[1]) * np.sin(t)
    v = (y - center[1]) * np.cos(t) - (x - center[0]) * np.sin(t)
    whole = (u / a) ** 2 + (v / b) ** 2 < 1
    planes = mask_halfplanes(whole[100:190, 100:220])
    inside = (np.stack([x, y, np.ones_like(x)], -1) @ planes.T <= 0).all(-1)
    assert inside[whole].all()


def test_the_pyramid_over_a_polygon_holds_the_points_that_project_into_it():
    rng, camera = np.random.default_rng(2), camera_at([1, 2, -3])
    planes = mask_halfplanes(np.pad(np.ones((30, 40), bool), ((20, 70), (50, 70))))
    points = rng.uniform(-6, 6, (4000, 3))
    pixels, depth = camera.project(points)
    expected = (np.c_[pixels, np.ones(len(pixels))] @ planes.T <= 0).all(-1) & (depth > 0)
    halfspaces = lift_halfplanes(camera, planes)
    np.testing.assert_allclose(np.linalg.norm(halfspaces[:, :3], axis=-1), 1)
    result = (points @ halfspaces[:, :3].T + halfspaces[:, 3] <= 0).all(-1)
    assert 0 < expected.sum() < 4000
    assert np.array_equal(result, expected)


# Volumes -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(100))
def test_a_volume_contains_the_body_and_covers_its_pictures(seed):
    rng = np.random.default_rng(seed)
    offset = rng.uniform(-1, 1, 3) * 10.0 ** rng.integers(0, 4)
    body = random_body(rng) + offset
    cameras = random_cameras(rng, rng.integers(3, 7), offset)
    volume = volume_from_masks("body", masks_of(body, cameras))
    assert volume.contains(inside_points(body, rng)).all()
    assert volume.contains(body).all()
    assert volume.contains(volume.vertices).all()
    for camera in cameras:
        covered = silhouette(body, camera, touched=False)
        assert (volume.project_mask(camera) >= covered).all()
    # Not much larger in the views that made it: the mask's hull, and the simplification's tolerance.
    for _, camera, mask in masks_of(body, cameras):
        planes = mask_halfplanes(mask)
        y, x = np.nonzero(volume.project_mask(camera))
        assert (np.c_[x + 0.5, y + 0.5, np.ones(len(x))] @ planes.T < 1e-3).all()


def test_a_sphere_seen_by_many_cameras_gives_its_radius_quickly():
    rng = np.random.default_rng(0)
    directions, offset = ball(60) * rng.uniform(3.5, 5, (60, 1)), np.array([0.3, 0, 0])
    cameras = [camera_at(d + offset, width=600, height=450, focal=600.0) for d in directions]
    masks = []
    for i, camera in enumerate(cameras):  # rays that pass the origin within 0.5
        rays = camera.ray_directions(np.stack(np.meshgrid(np.arange(600) + 0.5, np.arange(450) + 0.5), -1))
        along = (rays @ camera.center)[..., None] / (rays**2).sum(-1, keepdims=True)
        masks.append((f"view{i}", camera, np.linalg.norm(camera.center - along * rays, axis=-1) < 0.5))
    start = time.perf_counter()
    volume = volume_from_masks("ball", masks)
    assert time.perf_counter() - start < 2
    assert volume.radius == pytest.approx(0.5, rel=0.05)
    assert volume.area == pytest.approx(np.pi, rel=0.05)
    np.testing.assert_allclose(volume.center, 0, atol=0.01)


def cube() -> ReflectionVolume:
    points, active = intersect_halfspaces(CUBE, np.zeros(3))
    return ReflectionVolume("cube", CUBE[active], *hull_mesh(points))


def test_measures_of_a_cube():
    volume = cube()
    assert volume.area == pytest.approx(24)
    assert volume.radius == pytest.approx(np.sqrt(3))
    np.testing.assert_allclose(volume.center, 0, atol=1e-12)
    points = np.array([[0.9, -0.9, 0.9], [1, 1, 1], [1.01, 0, 0], [0, 0, -3]])
    assert volume.contains(points).tolist() == [True, True, False, False]
    many = np.random.default_rng(0).uniform(-2, 2, (3, 5000, 3))
    assert np.array_equal(volume.contains(many), (np.abs(many) <= 1).all(-1))


def test_the_centre_is_that_of_the_solid_not_of_the_corners():
    # A pyramid's centre of mass lies at a quarter of its height, its corners' mean at a fifth.
    points = np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0], [0, 0, 1]])
    volume = ReflectionVolume("pyramid", CUBE, *hull_mesh(points))
    np.testing.assert_allclose(volume.center, [0, 0, 0.25], atol=1e-12)


def test_surface_samples_are_uniform_by_area_with_outward_normals():
    volume, n = cube(), 12000
    points, normals = volume.sample_surface(n, np.random.default_rng(0))
    axis = np.abs(normals).argmax(-1)
    np.testing.assert_allclose(np.abs(normals).max(-1), 1)
    np.testing.assert_allclose((points * normals).sum(-1), 1)  # on the face, which looks outwards
    side = axis * 2 + (normals[np.arange(n), axis] > 0)
    np.testing.assert_allclose(np.bincount(side, minlength=6), n / 6, rtol=0.1)
    flat = points[side == 0][:, 1:]
    np.testing.assert_allclose(np.histogramdd(flat, 4, [(-1, 1), (-1, 1)])[0], len(flat) / 16, rtol=0.35)


def test_a_projected_cube_covers_exactly_the_pixels_whose_rays_hit_it():
    volume = cube()
    for camera in [camera_at([4, 1, -3]), camera_at([0.5, -1.3, 2.2], [0.9, 0, 0]), camera_at([9, 0, 1], [9, 5, 1])]:
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = camera.ray_directions(np.stack([x, y], -1))
        with np.errstate(divide="ignore"):
            near, far = (-1 - camera.center) / rays, (1 - camera.center) / rays
        enter, leave = np.minimum(near, far).max(-1), np.maximum(near, far).min(-1)
        hit = (enter <= leave) & (leave > 0)
        assert np.array_equal(volume.project_mask(camera), hit)
        view = Viewport(-5, 33, 70, 40)
        padded = np.pad(hit, ((0, 0), (5, 0)))[33:73, :70]
        got = volume.project_mask(camera, view)
        assert np.array_equal(got[:, 5:], padded[:, 5:])


def test_a_camera_inside_the_volume_sees_it_everywhere_and_one_that_looks_away_nowhere():
    assert cube().project_mask(camera_at([0.2, 0, -0.9], [0, 3, 0])).all()
    assert not cube().project_mask(camera_at([0, 0, -3], [0, 0.1, -9])).any()


def test_a_volume_that_reaches_behind_the_camera_is_cut_there():
    # 1 mm outside the face x = 1, looking along it: everything on one side of the face's plane.
    camera = replace(camera_at([1.001, 0, 0], [1.001, 0, 5]), cx=80.0)
    seen = cube().project_mask(camera)
    rays = camera.ray_directions(np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5), -1))
    assert seen[rays[..., 0] < -0.01].all()
    assert not seen[rays[..., 0] > 0].any()


def test_a_saved_volume_is_the_same_when_loaded(tmp_path):
    volume = volume_from_masks("body", masks_of(0.5 * ball(), four_views()))
    volume.save(tmp_path / "body.json")
    loaded = ReflectionVolume.load(tmp_path / "body.json")
    assert loaded.name == "body"
    for part in ("halfspaces", "vertices", "faces"):
        assert np.array_equal(getattr(loaded, part), getattr(volume, part))


def test_a_file_that_is_not_a_volume_is_refused(tmp_path):
    (tmp_path / "a.json").write_text('{"name": "x", "halfspaces": [[1, 2]], "vertices": [], "faces": []}')
    with pytest.raises(UserError, match=r"a\.json is not a reflection volume"):
        ReflectionVolume.load(tmp_path / "a.json")


def test_the_exported_mesh_holds_the_same_triangles(tmp_path):
    from plyfile import PlyData

    volume = cube()
    volume.write_mesh(tmp_path / "cube.ply")
    mesh = PlyData.read(tmp_path / "cube.ply")
    np.testing.assert_allclose(np.stack([mesh["vertex"][a] for a in "xyz"], -1), volume.vertices, rtol=1e-6)
    assert np.array_equal(np.stack(mesh["face"]["vertex_indices"]), volume.faces)


# Masks that do not make a volume -------------------------------------------------------------------------------------


def test_a_mask_that_is_all_black_or_all_white_or_of_another_size_is_refused_by_name():
    masks = masks_of(0.5 * ball(), four_views())
    shape = masks[1][2].shape
    for bad, reason in [
        (np.zeros(shape, bool), "all black"),
        (np.ones(shape, bool), "all white"),
        (np.ones((7, 9), bool), "9 x 7 pixels"),
    ]:
        with pytest.raises(UserError, match=f"mask of ball in view view1 .*{reason}"):
            volume_from_masks("ball", [masks[0], (*masks[1][:2], bad), *masks[2:]])


def test_a_reflector_without_masks_is_refused_by_name():
    with pytest.raises(UserError, match="ball has no masks"):
        volume_from_masks("ball", [])


def test_one_view_alone_leaves_the_volume_open_and_is_named():
    with pytest.raises(UserError, match=r"open.*view0"):
        volume_from_masks("ball", masks_of(0.5 * ball(), [camera_at([0, 0, -4])]))


def test_two_views_from_one_place_leave_the_volume_open_and_are_named():
    cameras = [camera_at([3, 0, -4]), camera_at([3, 0, -4], [0.2, 0.1, 0])]
    with pytest.raises(UserError, match=r"open.*view0, view1"):
        volume_from_masks("ball", masks_of(0.5 * ball(), cameras))
    volume_from_masks("ball", masks_of(0.5 * ball(), [cameras[0], camera_at([-3, 0, -4])]))  # apart: it is closed


def test_masks_on_the_image_border_bound_nothing_there_and_are_named_when_that_leaves_it_open():
    cameras = [camera_at([0, 0.2, -2], [1, 0, 0], focal=130.0), camera_at([0.5, 0.2, -2], [1, 0, 0], focal=130.0)]
    masks = masks_of(0.5 * ball(), cameras)
    assert all(m[:, 0].any() or m[:, -1].any() for _, _, m in masks)
    with pytest.raises(UserError, match=r"view0, view1 touch the image border"):
        volume_from_masks("ball", masks)
    closing = masks_of(0.5 * ball(), four_views())
    volume = volume_from_masks("ball", [*masks, *[("x" + n, c, m) for n, c, m in closing]])
    assert volume.contains(0.5 * ball()).all()


def test_a_mask_that_contradicts_the_others_is_named():
    masks = masks_of(0.5 * ball(), four_views())
    wrong = np.zeros_like(masks[2][2])
    wrong[2:8, 2:8] = True
    masks[2] = (*masks[2][:2], wrong)
    with pytest.raises(UserError, match=r"contradict.*\n.*\n.*masks of view2$"):
        volume_from_masks("ball", masks)


def test_two_masks_that_contradict_each_other_are_both_named():
    cameras = four_views()[:2]
    masks = [*masks_of(0.3 * ball(), cameras[:1]), ("other", cameras[1], np.zeros((120, 160), bool))]
    masks[1][2][2:8, 2:8] = True
    with pytest.raises(UserError, match=r"masks of view0, other"):
        volume_from_masks("ball", masks)


def test_several_wrong_masks_are_named():
    masks = masks_of(0.3 * ball(), random_cameras(np.random.default_rng(1), 6))
    for i in (1, 4):
        wrong = np.zeros_like(masks[i][2])
        wrong[2:8, 2:8] = True
        masks[i] = (*masks[i][:2], wrong)
    with pytest.raises(UserError, match=r"masks of view1, view4$"):
        volume_from_masks("ball", masks)


def test_a_mask_of_one_pixel_or_a_line_is_taken_as_it_is():
    for rows, columns in [(1, 1), (1, 20), (20, 1)]:
        masks = []
        for i, camera in enumerate(four_views()):
            x, y = camera.project(np.zeros(3))[0].astype(int)
            mask = np.zeros((120, 160), bool)
            mask[y : y + rows, x : x + columns] = True
            masks.append((f"view{i}", camera, mask))
        volume = volume_from_masks("speck", masks)
        assert volume.contains(np.zeros((1, 3)))[0]
        assert volume.radius < 0.06 * max(rows, columns)


def test_a_mask_in_two_parts_counts_as_its_hull():
    masks = masks_of(0.5 * ball(), four_views())
    split = masks[0][2].copy()
    split[:, 80:86] = False  # something thin stands in front
    volume = volume_from_masks("ball", [(*masks[0][:2], split), *masks[1:]])
    whole = volume_from_masks("ball", masks)
    assert volume.area == pytest.approx(whole.area, rel=0.01)


def ring_masks(body: np.ndarray, hidden: dict[int, slice]) -> list:
    """Masks of a body in 12 views around it; in some of them columns are hidden by something that stands before it."""
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    cameras = [camera_at((4 * np.cos(a), 1.5 * (-1) ** i, 4 * np.sin(a))) for i, a in enumerate(angles)]
    masks = masks_of(body, cameras)
    for i, columns in hidden.items():
        masks[i][2][:, columns] = False
    return masks


@pytest.mark.parametrize("hidden", [{}, {4: slice(0, 80)}, {4: slice(0, 82), 5: slice(0, 84)}, {1: slice(85, 160)}])
def test_masks_of_views_where_something_stands_before_the_object_are_found(hidden):
    masks = ring_masks(0.6 * ball(), hidden)
    assert sorted(partly_hidden(masks)) == sorted(masks[i][0] for i in hidden)


def test_a_flat_mirror_seen_from_its_side_is_not_taken_for_a_hidden_one():
    sheet = np.array([[x, y, z] for x in (-0.7, 0.7) for y in (-0.5, 0.5) for z in (-0.002, 0.002)])
    angles = np.radians(np.linspace(15, 165, 13))
    cameras = [camera_at((4 * np.cos(a), 0.8 * (-1) ** i, 4 * np.sin(a))) for i, a in enumerate(angles)]
    assert partly_hidden(masks_of(sheet, cameras)) == []


def test_masks_that_contradict_each_other_are_named_with_their_reflector_however_many_there_are():
    masks = ring_masks(0.6 * ball(), {})
    elsewhere = np.zeros_like(masks[3][2])
    elsewhere[5:12, 5:12] = True
    masks[3] = (*masks[3][:2], elsewhere)
    assert partly_hidden(masks) == []
    with pytest.raises(UserError, match="The masks of ball contradict"):
        volume_from_masks("ball", masks)


def test_few_masks_are_all_believed():
    masks = ring_masks(0.6 * ball(), {4: slice(0, 80)})
    assert partly_hidden(masks[:6]) == []


# Captures ------------------------------------------------------------------------------------------------------------


def test_each_reflector_of_a_capture_has_its_own_volume_from_training_masks(tmp_path):
    cameras = random_cameras(np.random.default_rng(3), 6, distance=6)
    views = [View(f"{i}.png", c) for i, c in enumerate(cameras)]
    near, far = 0.3 * ball(), 0.3 * ball() + [0.9, 0, 0]
    for view in views:
        write_image(tmp_path / "images" / view.name, np.zeros((120, 160, 3), np.uint8))
        for name, body in (("near", near), ("far", far)):
            mask = silhouette(body, view.camera, touched=True)
            if view.name == "0.png":
                mask = np.zeros_like(mask)  # a held-out view's mask is not looked at
            write_image(tmp_path / "masks" / name / view.name, mask)
    write_capture(tmp_path, views, {"train": [f"{i}.png" for i in range(1, 6)], "held_out": ["0.png"]})
    capture = open_capture(tmp_path)
    np.testing.assert_allclose(build_volume(capture, "near").center, 0, atol=0.05)
    np.testing.assert_allclose(build_volume(capture, "far").center, [0.9, 0, 0], atol=0.05)
    with pytest.raises(UserError, match=r"reflector chrome[\s\S]*one of: far, near"):
        build_volume(capture, "chrome")


def test_a_mask_that_shows_part_of_the_object_is_named_and_left_out_of_its_volume(tmp_path, capsys):
    masks = ring_masks(0.6 * ball(), {4: slice(0, 80)})
    views = [View(f"{i}.png", camera) for i, (_, camera, _) in enumerate(masks)]
    for view, (_, _, mask) in zip(views, masks, strict=True):
        write_image(tmp_path / "images" / view.name, np.zeros((120, 160, 3), np.uint8))
        write_image(tmp_path / "masks" / "ball" / view.name, mask)
    write_capture(tmp_path, views, {"train": [v.name for v in views], "held_out": []})
    volume = build_volume(open_capture(tmp_path), "ball")
    assert "4.png" in capsys.readouterr().out
    assert volume.contains(0.6 * ball()).all()
    assert not volume_from_masks("ball", masks).contains(0.6 * ball()).all()


def test_the_volume_moves_with_the_world():
    cameras, body = four_views(), 0.5 * ball()
    volume = volume_from_masks("ball", masks_of(body, cameras))
    rng = np.random.default_rng(0)
    turn, shift = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3) * 100
    turn *= np.sign(np.linalg.det(turn))
    moved = [replace(c, camera_from_world=c.camera_from_world @ rigid(turn.T, -turn.T @ shift)) for c in cameras]
    masks = [(n, m, mask) for (n, _, mask), m in zip(masks_of(body, cameras), moved, strict=True)]
    other = volume_from_masks("ball", masks)
    np.testing.assert_allclose(other.center, turn @ volume.center + shift, atol=1e-6)
    assert other.area == pytest.approx(volume.area)
