"""Ground truth on disk, and the shipped capture against the optics of its ball. Needs no renderer."""

from pathlib import Path

import numpy as np
import pytest

from catacaustics.cameras import Camera, pixel_centers
from catacaustics.capture.dataset import View, open_capture
from catacaustics.capture.truth import Truth, read_reflectors, read_truth, truth_path, write_truth
from catacaustics.errors import UserError

BALL = Path(__file__).parents[1] / "data_samples" / "ball"


@pytest.fixture(scope="module")
def ball():
    return open_capture(BALL)


def views_with_truth(ball) -> list[View]:
    return [v for v in ball.views if truth_path(BALL, v.name).is_file()]


def sphere_hit(camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth (nan beside it) and normal of the shipped ball at pixel centres, and the rays, in closed form."""
    sphere = read_reflectors(BALL)["ball"]
    away = camera.center - np.array(sphere["center"])
    rays = camera.ray_directions(pixel_centers(camera.viewport))
    a, b, c = (rays**2).sum(-1), (away * rays).sum(-1), (away**2).sum() - sphere["radius"] ** 2
    inside = b**2 - a * c
    depth = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.nan)
    return depth, (away + depth[..., None] * rays) / sphere["radius"], rays


def test_truth_comes_back_as_written_to_the_stated_precision(tmp_path):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.6, 5, (7, 9))
    normals = rng.normal(size=(7, 9, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    source = rng.uniform(-20, 20, (7, 9, 3))
    depth[0, :4], normals[0, :4], source[2:4] = np.nan, np.nan, np.nan
    written = Truth(depth, normals, source, rng.random((7, 9)) > 0.5)
    write_truth(tmp_path, "shelf/view.jpg", written)
    read = read_truth(tmp_path, "shelf/view.jpg")
    np.testing.assert_allclose(1 / read.depth, 1 / depth, atol=0.51 / 65535 / np.nanmin(depth))
    assert np.nanmin((read.normals * normals).sum(-1)) > np.cos(np.radians(0.5))
    np.testing.assert_allclose(read.source, source, atol=0.51e-3)
    np.testing.assert_array_equal(np.isnan(read.normals), np.isnan(normals))
    np.testing.assert_array_equal(read.mirror_mask, written.mirror_mask)


def test_a_view_without_truth_is_refused_and_those_that_have_it_are_named():
    with pytest.raises(UserError, match="path_000"):
        read_truth(BALL, "train_001.jpg")


def test_a_damaged_truth_file_is_named(tmp_path):
    truth_path(tmp_path, "a.jpg").parent.mkdir()
    truth_path(tmp_path, "a.jpg").write_bytes(b"half a file")
    with pytest.raises(UserError, match="damaged"):
        read_truth(tmp_path, "a.jpg")


def test_the_shipped_ball_is_complete_and_small(ball):
    assert (len(ball.train), len(ball.held_out), ball.reflectors) == (60, 12, ["ball"])
    for view in ball.views:
        assert ball.image(view).shape == (320, 480, 3)
        mask = ball.mask(view, "ball")
        assert mask is not None
        assert 0.1 < mask.mean() < 0.22
    assert sum(v in ball.train for v in views_with_truth(ball)) >= 6
    assert any(v in ball.held_out for v in views_with_truth(ball))
    assert sum(p.stat().st_size for p in BALL.rglob("*") if p.is_file()) < 4e6


def test_the_shipped_training_cameras_stand_all_around_the_ball(ball):
    away = np.array([v.camera.center for v in ball.train]) - read_reflectors(BALL)["ball"]["center"]
    turn = np.sort(np.arctan2(away[:, 1], away[:, 0]))
    gaps = np.diff(np.concatenate([turn, turn[:1] + 2 * np.pi]))
    assert np.degrees(gaps.max()) < 30


def test_shipped_masks_are_the_outline_of_the_sphere_to_a_pixel(ball):
    from scipy.ndimage import binary_dilation, binary_erosion

    for view in views_with_truth(ball):
        depth, _, _ = sphere_hit(view.camera)
        nearer = read_truth(BALL, view.name).depth < np.nan_to_num(depth) - 5e-3  # something stands before the ball
        outline, mask = np.isfinite(depth) & ~nearer, ball.mask(view, "ball")
        assert not (mask & ~binary_dilation(outline)).any()
        assert not (binary_erosion(outline) & ~mask).any()


def test_shipped_depth_and_normals_on_the_ball_match_the_closed_form(ball):
    for view in views_with_truth(ball):
        truth, (depth, normal, _) = read_truth(BALL, view.name), sphere_hit(view.camera)
        on = truth.mirror_mask & np.isfinite(depth)
        np.testing.assert_allclose(truth.depth[on], depth[on], rtol=1e-4)
        assert (truth.normals[on] * normal[on]).sum(-1).min() > np.cos(np.radians(0.6))


def test_shipped_sources_obey_the_law_of_reflection(ball):
    for view in views_with_truth(ball):
        truth, (depth, normal, rays) = read_truth(BALL, view.name), sphere_hit(view.camera)
        on = np.isfinite(truth.source).all(-1) & np.isfinite(depth)
        assert on.sum() > 0.95 * truth.mirror_mask.sum()
        point, normal, ray = view.camera.unproject(pixel_centers(view.camera.viewport), depth)[on], normal[on], rays[on]
        out = ray - 2 * (ray * normal).sum(-1, keepdims=True) * normal
        out /= np.linalg.norm(out, axis=-1, keepdims=True)
        reach = truth.source[on] - point
        along = (reach * out).sum(-1)
        assert along.min() > 0
        beside = np.linalg.norm(reach - along[:, None] * out, axis=-1)
        # Sources are stored to 1 mm; rays that graze the ball magnify the rounding of the renderer's numbers.
        assert np.quantile(beside, 0.999) < 2e-3


def test_shipped_photographs_agree_with_shipped_depth_to_a_tenth_of_a_pixel(ball):
    """A diffuse point looks alike in two photographs: find the shift between them that is left, by least squares."""
    import cv2

    a, b = ball.train[0], ball.train[1]
    truth = read_truth(BALL, a.name)
    points = a.camera.unproject(pixel_centers(a.camera.viewport), truth.depth)
    pixels, z = b.camera.project(points)
    gray_a, gray_b = (cv2.cvtColor(ball.image(v), cv2.COLOR_RGB2GRAY).astype(np.float32) for v in (a, b))
    at = (pixels - 0.5).astype(np.float32)
    seen = cv2.remap(gray_b, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=-1000)
    gx, gy = (cv2.remap(np.gradient(gray_b, axis=k), at[..., 0], at[..., 1], cv2.INTER_LINEAR) for k in (1, 0))
    mirror_b = cv2.remap(ball.mask(b, "ball").astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    use = ~truth.mirror_mask & (mirror_b == 0) & (z > 0) & (np.abs(seen - gray_a) < 25)  # the rest is hidden in b
    assert use.mean() > 0.2
    shift = np.linalg.lstsq(np.stack([gx[use], gy[use]], -1), (gray_a - seen)[use], rcond=None)[0]
    assert np.abs(shift).max() < 0.1
