"""Image metrics against their definitions and known answers."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from catacaustics.metrics import PSNR_CAP, Metrics, compare, flip_map, lpips_missing, mean_metrics, ssim_map


def photograph(height: int = 32, width: int = 40, seed: int = 0) -> np.ndarray:
    """Smooth random colours within [0.2, 0.8]."""
    noise = np.random.default_rng(seed).random((height, width, 3))
    smooth = gaussian_filter(noise, (2, 2, 0))
    low, high = smooth.min(), smooth.max()
    return (0.2 + 0.6 * (smooth - low) / (high - low)).astype(np.float32)


def left_half(image: np.ndarray) -> np.ndarray:
    mask = np.zeros(image.shape[:2], bool)
    mask[:, : image.shape[1] // 2] = True
    return mask


def test_an_offset_of_a_tenth_is_20_db_everywhere():
    photo = photograph()
    result = compare(photo + np.float32(0.1), photo, left_half(photo))
    assert result.whole.psnr == pytest.approx(20, abs=1e-4)
    assert result.inside.psnr == pytest.approx(20, abs=1e-4)


def test_identical_images_reach_the_cap_and_not_infinity():
    photo = photograph()
    result = compare(photo, photo)
    assert result.whole.psnr == PSNR_CAP
    assert result.whole.ssim == pytest.approx(1, abs=1e-6)
    assert result.whole.flip == 0


def test_psnr_inside_a_mask_sees_only_the_masked_pixels():
    photo = photograph()
    mask = left_half(photo)
    render = photo + np.where(mask, 0.01, 0.2)[..., None].astype(np.float32)
    result = compare(render, photo, mask)
    assert result.inside.psnr == pytest.approx(40, abs=1e-2)
    assert result.whole.psnr == pytest.approx(-10 * np.log10((0.01**2 + 0.2**2) / 2), abs=1e-3)


def test_errors_outside_the_mask_do_not_reach_a_mask_that_is_farther_than_the_window():
    photo = photograph(48, 64)
    mask = np.zeros(photo.shape[:2], bool)
    mask[:, :20] = True
    render = photo.copy()
    render[:, 50:] = 0
    inside = compare(render, photo, mask).inside
    assert inside.ssim == pytest.approx(1, abs=1e-5)
    assert inside.psnr == PSNR_CAP


def test_ssim_follows_its_definition_at_an_inner_pixel():
    photo, render = photograph(seed=1), photograph(seed=2)
    offset = np.arange(-5, 6)
    window = np.exp(-(offset[:, None] ** 2 + offset[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    row, column = 15, 20
    expected = []
    for channel in range(3):
        x, y = (image[row - 5 : row + 6, column - 5 : column + 6, channel].astype(float) for image in (render, photo))
        mx, my = (window * x).sum(), (window * y).sum()
        vx, vy, cov = (
            (window * (x - mx) ** 2).sum(),
            (window * (y - my) ** 2).sum(),
            (window * (x - mx) * (y - my)).sum(),
        )
        c1, c2 = 0.01**2, 0.03**2
        expected.append((2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2)))
    assert ssim_map(render, photo)[row, column] == pytest.approx(np.mean(expected), abs=1e-4)


def test_ssim_of_two_flat_images_is_the_luminance_term():
    low, high = np.full((16, 16, 3), 0.3, np.float32), np.full((16, 16, 3), 0.6, np.float32)
    expected = (2 * 0.3 * 0.6 + 1e-4) / (0.3**2 + 0.6**2 + 1e-4)
    # Variances are differences of single-precision numbers: about 2e-4 of error where an image is flat.
    assert compare(low, high).whole.ssim == pytest.approx(expected, abs=5e-4)


def test_a_mask_over_the_whole_image_changes_nothing():
    photo, render = photograph(seed=3), photograph(seed=4)
    result = compare(render, photo, np.ones(photo.shape[:2], bool))
    assert result.inside.psnr == pytest.approx(result.whole.psnr)
    assert result.inside.ssim == pytest.approx(result.whole.ssim)
    assert result.inside.flip == pytest.approx(result.whole.flip)


def test_flip_of_black_against_white_is_nearly_one():
    black, white = np.zeros((32, 32, 3), np.float32), np.ones((32, 32, 3), np.float32)
    assert 0.95 < flip_map(black, white).mean() <= 1


def test_flip_is_at_its_authors_default_viewing_distance():
    import flip_evaluator

    photo, render = photograph(seed=5), photograph(seed=6)
    values, mean, parameters = flip_evaluator.evaluate(photo, render, "LDR", applyMagma=False)
    assert parameters["ppd"] == pytest.approx(67.02, abs=0.01)
    np.testing.assert_allclose(flip_map(render, photo), values[..., 0], atol=1e-6)
    assert compare(render, photo).whole.flip == pytest.approx(mean, abs=1e-5)


def test_renders_are_clamped_to_what_a_screen_shows():
    white = np.ones((16, 16, 3), np.float32)
    assert compare(white * 3, white).whole.psnr == PSNR_CAP


def test_an_empty_mask_has_no_metrics_inside():
    photo = photograph()
    assert compare(photo, photo, np.zeros(photo.shape[:2], bool)).inside is None
    assert compare(photo, photo).inside is None


def test_means_are_means_of_the_per_view_values():
    mean = mean_metrics([Metrics(20.0, 0.5, 0.2), Metrics(PSNR_CAP, 1.0, 0.0)])
    assert mean == Metrics(60.0, 0.75, 0.1)
    assert mean_metrics([Metrics(1.0, 1.0, 1.0, 0.2), Metrics(1.0, 1.0, 1.0, 0.4)]).lpips == pytest.approx(0.3)
    assert mean_metrics([Metrics(1.0, 1.0, 1.0, 0.2), Metrics(1.0, 1.0, 1.0)]).lpips is None
    with pytest.raises(ValueError, match="one or more"):
        mean_metrics([])


def test_what_was_not_measured_is_left_out_of_the_json():
    assert Metrics(20.0, 0.5, 0.2).as_dict() == {"psnr": 20, "ssim": 0.5, "flip": 0.2}


def test_images_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="finite"):
        compare(np.full((20, 20, 3), np.nan, np.float32), np.zeros((20, 20, 3), np.float32))


def test_images_below_the_window_are_refused():
    with pytest.raises(ValueError, match="11 or more pixels"):
        compare(np.zeros((8, 20, 3), np.float32), np.zeros((8, 20, 3), np.float32))


def test_lpips_without_weights_on_disk_says_so_and_downloads_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    photo = photograph()
    assert "not in" in lpips_missing()
    assert compare(photo, photo).whole.lpips is None
    assert not list(tmp_path.iterdir())
