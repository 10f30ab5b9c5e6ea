"""The visual hull against bodies that are not convex, from their outlines."""

import numpy as np
import pytest

from catacaustics.cameras import Camera, pixel_centers
from catacaustics.geometry import look_at
from catacaustics.reflectors.visual_hull import carve_visual_hull
from catacaustics.reflectors.volume import volume_from_masks

CENTERS, RADIUS = np.array([[0, 0, -0.6], [0, 0, 0.6]]), 0.45


def camera_at(angle: float, height: float = 0.0, cx: float = 120.0) -> Camera:
    eye = 4 * np.array([np.cos(angle), np.sin(angle), height])
    return Camera(240, 240, 300.0, 300.0, cx, 120.0, look_at(eye, np.zeros(3), np.array([0, 0, 1.0])))


def outline(camera: Camera) -> np.ndarray:
    """Pixels whose rays meet one of two separate balls."""
    rays = camera.ray_directions(pixel_centers(camera.viewport))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    away = [np.linalg.norm(np.cross(c - camera.center, rays), axis=-1) for c in CENTERS]
    return np.min(away, axis=0) < RADIUS


def masks_of(cameras: list[Camera]) -> list[tuple[str, Camera, np.ndarray]]:
    return [(f"view_{i}", camera, outline(camera)) for i, camera in enumerate(cameras)]


@pytest.fixture(scope="module")
def sampled():
    masks = masks_of([camera_at(a) for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)])
    volume = volume_from_masks("balls", masks)
    return volume, masks, carve_visual_hull(volume, masks).sample(4000, np.random.default_rng(0))


def test_points_lie_on_two_balls_and_none_in_the_gap_between_them(sampled):
    volume, _, (points, _) = sampled
    assert volume.contains(np.array([0.2, 0, 0]))  # the convex volume fills the gap
    off = np.abs(np.linalg.norm(points[:, None] - CENTERS, axis=2) - RADIUS).min(1)
    pixel = 4 / 300
    assert np.quantile(off, 0.99) < 3 * pixel
    assert np.median(off) < 1.5 * pixel


def test_normals_point_outwards(sampled):
    _, _, (points, normals) = sampled
    offsets = points[:, None] - CENTERS
    nearest = np.linalg.norm(offsets, axis=2).argmin(1)
    radial = offsets[np.arange(len(points)), nearest]
    cosine = (normals * radial).sum(1) / np.linalg.norm(radial, axis=1)
    assert np.median(cosine) > np.cos(np.radians(10))
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1)


def test_points_are_spread_evenly_over_the_surface(sampled):
    _, _, (points, _) = sampled
    height = (points[:, 2] + np.where(points[:, 2] < 0, 0.6, -0.6)) / RADIUS
    middle = np.mean(np.abs(height) < 0.5)  # of a sphere half, by Archimedes
    assert middle == pytest.approx(0.5, abs=0.06)
    assert np.mean(points[:, 2] > 0) == pytest.approx(0.5, abs=0.05)


def test_a_picture_that_shows_a_part_says_nothing_about_the_rest(sampled):
    volume, masks, _ = sampled
    beside = camera_at(0.3, cx=20.0)  # the balls reach beyond its left border
    assert outline(beside)[:, 0].any()
    masks = [*masks, ("beside", beside, outline(beside))]
    points, _ = carve_visual_hull(volume, masks).sample(2000, np.random.default_rng(0))
    pixels, _ = beside.project(points)
    assert (pixels[:, 0] < 0).mean() > 0.1


def test_where_the_masks_leave_nothing_the_volume_is_taken(sampled):
    volume, masks, _ = sampled
    _, camera, mask = masks[0]
    masks = [*masks, ("empty", camera, np.zeros_like(mask))]
    points, normals = carve_visual_hull(volume, masks).sample(500, np.random.default_rng(0))
    expected = volume.sample_surface(500, np.random.default_rng(0))
    np.testing.assert_array_equal(points, expected[0])
    np.testing.assert_array_equal(normals, expected[1])
