"""Conventions: OpenCV axes, pixel centres at +0.5, camera_from_world."""

import numpy as np
import pytest
from toy import toy_cameras

from catacaustics.cameras import Camera, Viewport, interpolate_path, pixel_centers


def test_a_point_ahead_right_and_below_lands_right_and_below_the_principal_point():
    camera = Camera(640, 480, 500.0, 510.0, 320.0, 240.0, np.eye(4))
    pixel, depth = camera.project(np.array([1.0, 0.5, 2.0]))
    np.testing.assert_allclose(pixel, [320 + 250, 240 + 127.5])
    assert depth == 2


def test_the_first_pixel_centre_is_at_one_half():
    np.testing.assert_array_equal(pixel_centers(Viewport(0, 0, 3, 2))[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(pixel_centers(Viewport(-2, 5, 3, 2))[1, 2], [0.5, 6.5])


def test_unprojecting_a_projected_point_returns_it():
    points = np.random.default_rng(0).standard_normal((50, 3)) * 0.3
    for camera in toy_cameras(5, 64, 48):
        pixels, depth = camera.project(points)
        np.testing.assert_allclose(camera.unproject(pixels, depth), points, atol=1e-12)
        np.testing.assert_allclose(camera.project(camera.center[None])[1], 0, atol=1e-12)


def test_a_resized_camera_sees_the_same_at_the_same_relative_place():
    camera = toy_cameras(1, 64, 48)[0]
    half = camera.resized(32, 24)
    points = np.random.default_rng(0).standard_normal((9, 3)) * 0.2
    np.testing.assert_allclose(half.project(points)[0] * 2, camera.project(points)[0])


def test_a_path_needs_two_keys():
    with pytest.raises(ValueError, match="2 or more"):
        interpolate_path(toy_cameras(1, 4, 3), 10)
