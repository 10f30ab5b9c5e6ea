import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from catacaustics.cameras import Camera, pixel_centers
from catacaustics.capture import fusion, stereo
from catacaustics.capture.dataset import Capture, View, open_capture, write_capture
from catacaustics.capture.plane_sweep import GrayView, SweepConfig, _box_mean, estimate_depth, plane_count
from catacaustics.capture.truth import Truth, write_truth
from catacaustics.errors import UserError
from catacaustics.geometry import look_at, normalize
from catacaustics.images import write_image
from catacaustics.points import PointCloud

WIDTH, HEIGHT = 160, 120
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Images this small are slower on several threads, much slower where the cores are busy."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def texture(points: np.ndarray, seed: int = 0) -> np.ndarray:
    """A solid texture of random waves, band-limited to a few pixels of the test cameras."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(3, 60)) * rng.uniform(6, 22, 60)
    return 0.5 + 0.055 * np.cos(points @ waves + rng.uniform(0, 2 * np.pi, 60)).sum(-1)


def plane(normal, offset):
    """Ray parameter and normals of the plane normal . x = offset."""
    normal = normalize(np.array(normal, float))

    def hit(origin, directions):
        t = (offset - origin @ normal) / (directions @ normal)
        return np.where(t > 0, t, np.inf), np.broadcast_to(normal, directions.shape)

    return hit


def sphere(center, radius):
    center = np.array(center, float)

    def hit(origin, directions):
        a, b = (directions**2).sum(-1), directions @ (origin - center)
        root = b * b - a * (((origin - center) ** 2).sum() - radius**2)
        t = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        return t, normalize(origin + np.where(root > 0, t, 0)[..., None] * directions - center)

    return hit


def render(camera: Camera, surfaces, shade=texture):
    """Image, depth and world normals facing the camera, by ray casting; directions have z = 1, so t is depth."""
    directions = camera.ray_directions(pixel_centers(camera.viewport))
    hits = [surface(camera.center, directions) for surface in surfaces]
    depth = np.stack([t for t, _ in hits])
    index = depth.argmin(0)[None, ..., None]
    normals = np.take_along_axis(np.stack([n for _, n in hits]), index, 0)[0]
    normals = np.where((normals * directions).sum(-1, keepdims=True) > 0, -normals, normals)
    depth = depth.min(0)
    points = camera.center + np.where(np.isfinite(depth), depth, 0)[..., None] * directions
    image = np.where(np.isfinite(depth), shade(points), 0.5)
    return np.clip(image, 0, 1).astype(np.float32), depth, normals


def camera_at(eye, target=(0, 0, 0), width=WIDTH, height=HEIGHT) -> Camera:
    pose = look_at(np.array(eye, float), np.array(target, float), UP)
    return Camera(width, height, 1.1 * width, 1.1 * width, width / 2, height / 2, pose)


def cross(distance: float = 3.0, step: float = 0.45) -> list[Camera]:
    """A camera on the y axis that looks at the origin, and four about it."""
    offsets = [(0, 0), (step, 0), (-step, 0), (0, step), (0, -step)]
    return [camera_at((x, -distance, z)) for x, z in offsets]


def estimate(cameras, surfaces, inverse_range=(0.2, 0.7), config=None, shade=texture):
    """The estimate for the first camera, in world normals, and the truth."""
    views = [GrayView(torch.tensor(render(c, surfaces, shade)[0]), c) for c in cameras]
    with torch.inference_mode():
        found = estimate_depth(views[0], views[1:], inverse_range, config or SweepConfig())
    _, depth, normals = render(cameras[0], surfaces)
    return found._replace(normals=found.normals @ cameras[0].camera_from_world[:3, :3]), depth, normals


def angles(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def test_box_mean_is_the_mean_over_the_window():
    x = torch.rand(2, 14, 17, dtype=torch.float64)
    for radius in (1, 2, 3, 5):
        expected = torch.nn.functional.avg_pool2d(x[:, None], 2 * radius + 1, 1)[:, 0]
        assert torch.allclose(_box_mean(x, radius), expected)


SPHERE, SLANTED = sphere((0, 0, 0), 0.9), plane((0.5, -0.7, 0.4), 0.0)


@pytest.mark.parametrize(
    ("surfaces", "shape"), [([SLANTED], SLANTED), ([SPHERE, plane((0, 1, 0), 1.2)], SPHERE)], ids=["plane", "sphere"]
)
def test_a_textured_surface_is_recovered_to_one_percent_with_its_normals(surfaces, shape):
    cameras = cross()
    found, depth, normals = estimate(cameras, surfaces)
    # Within about a window of a silhouette the window straddles two surfaces.
    inner = np.isfinite(render(cameras[0], [shape])[1]) & (normals @ cameras[0].camera_from_world[2, :3] < -0.5)
    kept = (found.depth > 0) & inner
    assert kept.sum() > 0.9 * inner.sum()
    assert (np.abs(found.depth / depth - 1)[kept] < 0.01).mean() > 0.97
    assert (angles(found.normals, normals)[kept] < 10).mean() > 0.9
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=-1), 1, atol=1e-4)


def test_refinement_beats_the_spacing_of_the_planes():
    cameras, inverse_range = cross(), (0.2, 0.7)
    found, depth, _ = estimate(cameras, [plane((0.2, -1, 0.1), 0.13)], inverse_range)
    count = plane_count(cameras[0], cameras[1:], inverse_range, SweepConfig())
    spacing = (inverse_range[1] - inverse_range[0]) / (count - 1)
    kept = found.depth > 0
    # The nearest plane alone would be off by a quarter of the spacing.
    assert np.median(np.abs(1 / found.depth[kept] - 1 / depth[kept])) < spacing / 20


def test_a_surface_hidden_from_half_of_the_neighbors_is_found_by_the_other_half():
    cameras, surfaces = cross(), [sphere((0, -0.8, 0), 0.35), plane((0, 1, 0), 0.8)]
    points = cameras[0].unproject(pixel_centers(cameras[0].viewport), render(cameras[0], surfaces)[1])
    hidden = np.zeros((HEIGHT, WIDTH), int)
    for camera in cameras[1:]:
        _, z = camera.project(points)
        sight = points - camera.center
        first = np.min([surface(camera.center, sight / z[..., None])[0] for surface in surfaces], 0)
        hidden += first < 0.99 * z
    background = render(cameras[0], surfaces)[1] > 3
    half_hidden = background & (hidden >= 1) & (hidden <= 2)
    assert half_hidden.sum() > 100

    def right(best):
        found, depth, _ = estimate(cameras, surfaces, config=SweepConfig(best=best))
        return (np.abs(found.depth / depth - 1) < 0.01)[half_hidden].mean()

    assert right(2) > 0.75
    assert right(2) > right(4) + 0.2


def test_a_surface_without_texture_is_left_empty():
    def shade(points):
        noise = np.random.default_rng(int(1e6 * abs(points[0, 0, 0]))).normal(0, 0.3 / 255, points.shape[:-1])
        return np.where(points[..., 0] > 0, texture(points), 0.5) + noise

    found, depth, _ = estimate(cross(), [plane((0, 1, 0), 0.0)], shade=shade)
    columns = np.arange(WIDTH)
    assert (found.depth[:, columns < WIDTH // 2 - 8] > 0).mean() < 0.01
    textured = found.depth[:, columns > WIDTH // 2 + 4]
    assert (np.abs(textured / depth[:, columns > WIDTH // 2 + 4] - 1) < 0.01).mean() > 0.9


def test_neighbors_see_the_same_points_at_useful_angles():
    ring = [camera_at((3 * np.cos(a), 3 * np.sin(a), 0.5)) for a in np.radians(np.arange(0, 360, 12))]
    away = camera_at((3, 0.2, 0.5), (6, 0.2, 0.5))
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    neighbors = stereo.choose_neighbors([*ring, away], points, count=4)
    assert set(neighbors[5]) == {3, 4, 6, 7}
    assert all(len(ring) not in chosen for chosen in neighbors)
    assert neighbors[-1] == []


def test_the_depth_range_holds_the_points_and_withstands_outliers():
    camera = camera_at((0, -4, 0))
    points = np.random.default_rng(0).uniform(-1, 1, (1000, 3))
    points[:3] = [0, -3.999, 0]
    low, high = stereo.depth_range(camera, points)
    assert 1 / 10 < low < 1 / 5
    assert 1 / 3 < high < 1 / 2
    assert stereo.depth_range(camera, points - np.array([0, 100, 0])) is None


def test_maps_are_in_colmap_format(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    rng = np.random.default_rng(0)
    depth, normals = rng.random((5, 7), dtype=np.float32), rng.random((5, 7, 3), dtype=np.float32)
    fusion.write_map(tmp_path / "depth.bin", depth)
    fusion.write_map(tmp_path / "normals.bin", normals)
    depth_map = pycolmap.DepthMap()
    depth_map.read(tmp_path / "depth.bin")
    np.testing.assert_array_equal(depth_map.to_array(), depth)
    # COLMAP's own script read_write_dense.py reads arrays in this order.
    header, values = (tmp_path / "normals.bin").read_bytes().split(b"&", 3)[:3], (tmp_path / "normals.bin").read_bytes()
    assert header == [b"7", b"5", b"3"]
    column_major = np.frombuffer(values[6:], np.float32).reshape((7, 5, 3), order="F")
    np.testing.assert_array_equal(column_major.transpose(1, 0, 2), normals)
    np.testing.assert_array_equal(fusion.read_map(tmp_path / "depth.bin"), depth)
    np.testing.assert_array_equal(fusion.read_map(tmp_path / "normals.bin"), normals)


def test_a_map_that_was_cut_short_is_refused_by_name(tmp_path):
    path = tmp_path / "view.bin"
    fusion.write_map(path, np.ones((4, 4)))
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(UserError, match=r"view\.bin"):
        fusion.read_map(path)


def ring_capture(root: Path, shade=texture, count: int = 8) -> Capture:
    """A sphere on a floor before a wall, seen from an arc; view 4 is held out and its photograph is no image."""
    surfaces = [sphere((0, 0, 0.5), 0.5), plane((0, 0, 1), 0.0), plane((0, 1, 0), 1.5)]
    views = []
    for index, angle in enumerate(np.radians(np.linspace(-40, 40, count))):
        camera = camera_at((3 * np.sin(angle), -3 * np.cos(angle), 1.6), (0, 0, 0.3), 128, 96)
        name = f"arc/{index}.png"
        image, depth, normals = render(camera, surfaces, shade)
        write_image(root / "images" / name, np.repeat(image[..., None], 3, -1))
        no_source = np.full((*depth.shape, 3), np.nan)
        write_truth(root, name, Truth(depth, normals, no_source, np.zeros(depth.shape, bool)))
        views.append(View(name, camera))
    (root / "images" / "arc" / "4.png").write_bytes(b"held out")
    names = [view.name for view in views]
    write_capture(root, views, {"train": names[:4] + names[5:], "held_out": names[4:5]})
    return open_capture(root)


@pytest.fixture(scope="module")
def fused(tmp_path_factory):
    capture = ring_capture(tmp_path_factory.mktemp("ring"))
    return capture, stereo.fuse_capture(capture)[0]


def surface_distance(points):
    """Distance to the sphere, the floor and the wall of `ring_capture`."""
    ball = np.abs(np.linalg.norm(points - [0, 0, 0.5], axis=1) - 0.5)
    return np.min([ball, np.abs(points[:, 2]), np.abs(points[:, 1] - 1.5)], 0)


def check_stereo():
    path = Path(__file__).parents[1] / "tools" / "check_stereo.py"
    spec = importlib.util.spec_from_file_location("check_stereo", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_fused_cloud_lies_on_the_surfaces_and_covers_them(fused):
    capture, cloud = fused
    assert len(cloud) > 3000
    assert (surface_distance(cloud.positions) < 0.03).mean() > 0.95
    summary = check_stereo().check_cloud(capture, cloud)["summary"]
    assert summary["within_1_percent"] > 0.9
    assert summary["textured_coverage"] > 0.7
    assert summary["normals_within_10_degrees"] > 0.85


def test_the_check_finds_a_cloud_that_is_off(fused):
    capture, cloud = fused
    tool = check_stereo()
    exact = tool.check_cloud(capture, cloud)["summary"]
    moved = dataclasses.replace(cloud, positions=cloud.positions + np.float32([0, -0.2, 0.2]))
    below = dataclasses.replace(cloud, positions=cloud.positions - np.float32([0, 0, 2]))
    moved, below = (tool.check_cloud(capture, c)["summary"] for c in (moved, below))
    assert moved["within_1_percent"] < 0.1 < exact["within_1_percent"]
    assert below["seen_by_no_view"] == 1


def test_held_out_photographs_are_not_read_and_images_get_their_colors(fused):
    capture, cloud = fused
    workspace = next((capture.root / "work" / "stereo").iterdir())
    assert not (workspace / "images" / "arc" / "4.png").exists()
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-3)
    expected = np.clip(texture(cloud.positions.astype(float)), 0, 1)
    assert np.abs(cloud.colors[:, 0] - expected).mean() < 0.08


def test_finished_views_are_skipped_and_only_a_missing_one_is_made_again(fused):
    capture, cloud = fused
    folder = next((capture.root / "work" / "stereo").iterdir()) / "stereo" / "depth_maps" / "arc"
    lost = folder / "2.png.photometric.bin"
    content = lost.read_bytes()
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    lost.unlink()
    again, _ = stereo.fuse_capture(capture)
    after = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert {path for path in before if before[path] != after[path]} == {lost}
    assert lost.read_bytes() == content
    np.testing.assert_array_equal(again.positions, cloud.positions)


def test_masked_pixels_yield_no_points(fused):
    capture, cloud = fused
    on_sphere = np.linalg.norm(cloud.positions - [0, 0, 0.5], axis=1) < 0.52
    assert on_sphere.sum() > 300
    for view in capture.train:
        mask = np.isfinite(render(view.camera, [sphere((0, 0, 0.5), 0.5)])[1])
        write_image(capture.mask_path(view, "ball"), mask)
    try:
        masked, guesses = stereo.fuse_capture(open_capture(capture.root))
    finally:
        for path in (capture.root / "masks" / "ball" / "arc").iterdir():
            path.unlink()
    assert len(masked) > 500
    for points in (masked.positions, guesses.positions):
        radius = np.linalg.norm(points - [0, 0, 0.5], axis=1)
        assert ((radius < 0.51) & (points[:, 2] > 0.1)).sum() == 0


def fuse_exact_maps(folder: Path, normal, scales=(1, 1, 1, 1, 1)) -> PointCloud:
    """Fuse true maps of a plane through the origin, the depths of each view multiplied by its scale."""
    cameras = cross()
    points = []
    for index, (camera, scale) in enumerate(zip(cameras, scales, strict=True)):
        image, depth, normals = render(camera, [plane(normal, 0.0)])
        write_image(folder / "images" / f"{index}.png", image)
        depth_path, normal_path = fusion.map_paths(folder, f"{index}.png")
        fusion.write_map(depth_path, scale * depth)
        fusion.write_map(normal_path, normals @ camera.camera_from_world[:3, :3].T)
        points.append(camera.unproject(pixel_centers(camera.viewport)[::20, ::20], depth[::20, ::20]).reshape(-1, 3))
    fusion.write_overlap_model(folder, [(f"{i}.png", c) for i, c in enumerate(cameras)], np.concatenate(points))
    return fusion.fuse_maps(folder, "photometric", 3, 0.01, 20.0)


def test_guesses_that_other_views_see_in_another_colour_are_dropped(fused):
    capture, cloud = fused
    rng = np.random.default_rng(0)
    right = cloud.select(rng.choice(len(cloud), 400, replace=False))
    eyes = np.array([v.camera.center for v in capture.train])[rng.integers(0, len(capture.train), 400)]
    floating = eyes + rng.uniform(0.3, 0.8, (400, 1)) * (right.positions - eyes)
    both = right.joined(dataclasses.replace(right, positions=floating.astype(np.float32)))
    kept = stereo._Stereo(capture, 800, None).colors_agree(both, "photometric")
    assert kept[:400].mean() > 0.3
    assert kept[:400].mean() > 4 * kept[400:].mean()


def test_holes_of_a_cloud_are_filled_and_its_own_points_stay_first():
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0), [0.0]), -1).reshape(-1, 3).astype(np.float32)
    cloud = PointCloud(grid[grid[:, 0] < 10], *(2 * [grid[grid[:, 0] < 10]]))
    filled = fusion.fill_holes(cloud, PointCloud(grid, grid, grid))
    np.testing.assert_array_equal(filled.positions[: len(cloud)], cloud.positions)
    assert filled.positions[len(cloud) :, 0].min() > 10
    assert filled.positions[:, 0].max() == 19


def test_fusion_of_exact_maps_returns_the_surface(tmp_path):
    normal = normalize(np.array([0.3, -1, 0.2]))
    cloud = fuse_exact_maps(tmp_path, normal)
    assert len(cloud) > WIDTH * HEIGHT // 4
    assert np.abs(cloud.positions @ normal).mean() < 2e-3
    assert np.abs(cloud.positions @ normal).max() < 1e-2
    assert angles(cloud.normals, normal).max() < 0.5


def test_fusion_of_maps_that_contradict_each_other_returns_nothing(tmp_path):
    assert len(fuse_exact_maps(tmp_path, [0.3, -1, 0.2], scales=(1, 1.1, 1.2, 1.3, 1.4))) == 0


def test_points_in_empty_space_are_removed_and_points_of_hidden_surfaces_stay(tmp_path):
    cameras = [(f"{index}.png", camera) for index, camera in enumerate(cross())]
    for name, camera in cameras:
        fusion.write_map(fusion.map_paths(tmp_path, name)[0], render(camera, [plane((0, 1, 0), 0.0)])[1])
    positions = np.float32([[0, 0, 0], [0, -0.5, 0], [0, 0.5, 0], [50, 0, 0], [0, -9, 0]])
    cloud = PointCloud(positions, np.zeros_like(positions), np.zeros_like(positions))
    kept = fusion.remove_contradicted(cloud, tmp_path, "photometric", cameras)
    np.testing.assert_array_equal(kept.positions, positions[[0, 2, 3, 4]])


def test_lone_points_are_removed_with_open3d_and_without(monkeypatch):
    rng = np.random.default_rng(0)
    positions = np.concatenate([rng.uniform(0, 1, (2000, 3)) * [1, 1, 0], [[0.5, 0.5, 3.0]]]).astype(np.float32)
    cloud = PointCloud(positions, np.tile(np.float32([0, 0, 1]), (2001, 1)), np.zeros_like(positions))
    kept = fusion.remove_outliers(cloud)
    assert kept.positions[:, 2].max() == 0
    assert len(kept) > 1900
    monkeypatch.setitem(sys.modules, "open3d", None)
    np.testing.assert_array_equal(fusion.remove_outliers(cloud).positions, kept.positions)


def test_a_capture_of_one_view_is_refused(tmp_path):
    capture = ring_capture(tmp_path, count=5)
    with pytest.raises(UserError, match="1 training view"):
        stereo.fuse_capture(dataclasses.replace(capture, train=capture.train[:1]))


def test_photographs_without_texture_are_refused_with_advice(tmp_path):
    capture = ring_capture(tmp_path, shade=lambda points: np.full(points.shape[:-1], 0.5), count=5)
    with pytest.raises(UserError, match="No depth was found in any of the 4"):
        stereo.fuse_capture(capture)


def test_sparse_points_take_the_place_of_the_search_for_depth(tmp_path):
    capture = ring_capture(tmp_path, count=6)
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [rng.uniform(-1, 1, (300, 3)) * [1, 1, 0], normalize(rng.normal(size=(300, 3))) / 2 + 0.5 * UP]
    )
    cloud, _ = stereo.fuse_capture(capture, sparse_points=points)
    assert not any((capture.root / "work" / "stereo").rglob("coarse"))
    assert (surface_distance(cloud.positions) < 0.03).mean() > 0.95


def test_photographs_from_one_place_are_refused(tmp_path):
    capture = ring_capture(tmp_path, count=5)
    train = [View(view.name, capture.train[0].camera) for view in capture.train]
    with pytest.raises(UserError, match="from the same place"):
        stereo.fuse_capture(dataclasses.replace(capture, train=train))
