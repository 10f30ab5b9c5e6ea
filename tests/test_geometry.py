"""Transforms against known answers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catacaustics.geometry import (
    fit_similarity,
    look_at,
    normalize,
    rigid,
    rigid_inverse,
    rotation_angle,
    transform,
)


def random_rigid(rng):
    return rigid(Rotation.random(random_state=rng).as_matrix(), rng.standard_normal(3))


def test_a_rigid_transform_and_its_inverse_cancel():
    rng = np.random.default_rng(0)
    pose, points = random_rigid(rng), rng.standard_normal((20, 3))
    np.testing.assert_allclose(transform(rigid_inverse(pose), transform(pose, points)), points, atol=1e-12)


def test_a_camera_that_looks_at_a_point_has_it_straight_ahead_with_up_pointing_up():
    eye, target, up = np.array([1.0, 2, 3]), np.array([-2.0, 0.5, 1]), np.array([0.0, 0, 1])
    pose = look_at(eye, target, up)
    np.testing.assert_allclose(transform(pose, eye), 0, atol=1e-12)
    np.testing.assert_allclose(transform(pose, target), [0, 0, np.linalg.norm(target - eye)], atol=1e-12)
    assert (pose[:3, :3] @ up)[1] < 0  # y points down
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


def test_looking_along_up_is_refused():
    with pytest.raises(ValueError, match="general position"):
        look_at(np.zeros(3), np.array([0.0, 0, 1]), np.array([0.0, 0, 1]))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-6, np.pi])
def test_the_angle_of_a_rotation_is_exact_near_zero_and_near_pi(angle):
    rotation = Rotation.from_rotvec(angle * np.array([2.0, -1, 2]) / 3).as_matrix()
    assert rotation_angle(rotation) == pytest.approx(angle, abs=1e-7 if angle > 3 else 1e-15, rel=1e-6)


def test_a_similarity_is_recovered_from_points_and_is_never_a_mirror_image():
    rng = np.random.default_rng(1)
    for scale in (0.01, 1.0, 300.0):
        rotation, shift = Rotation.random(random_state=rng).as_matrix(), rng.standard_normal(3)
        points = rng.standard_normal((4, 3))
        found = fit_similarity(points, scale * points @ rotation.T + shift)
        assert found.scale == pytest.approx(scale)
        np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
        np.testing.assert_allclose(found.apply(points), scale * points @ rotation.T + shift, atol=1e-9)
    mirrored = fit_similarity(points, points * [1, 1, -1])
    assert np.linalg.det(mirrored.rotation) == pytest.approx(1)


def test_a_similarity_needs_three_points_off_one_line():
    line = np.outer(np.arange(5.0), [1.0, 2, 3])
    with pytest.raises(ValueError, match="one line"):
        fit_similarity(line, line)
    with pytest.raises(ValueError, match="3 or more"):
        fit_similarity(line[:2], line[:2])


def test_a_zero_vector_stays_zero_when_normalized():
    np.testing.assert_array_equal(normalize(np.array([[0.0, 0, 0], [0, 3, 4]])), [[0, 0, 0], [0, 0.6, 0.8]])
