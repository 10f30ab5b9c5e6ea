"""Undistortion against COLMAP's own camera models, against analytic pictures, and on broken input."""

import numpy as np
import pytest

from catacaustics.capture.colmap import ColmapCamera, ColmapImage, ColmapModel
from catacaustics.capture.undistort import (
    distort,
    find_masks,
    pinhole_camera,
    undistort_image,
    undistort_mask,
    undistort_points,
    undistort_views,
)
from catacaustics.errors import UserError
from catacaustics.images import read_image_bytes, read_mask, write_image

WIDTH, HEIGHT = 400, 300
DISTORTED = {
    "SIMPLE_RADIAL": [320, 205, 147, -0.12],
    "RADIAL": [320, 205, 147, 0.08, -0.02],
    "OPENCV": [320, 315, 205, 147, -0.2, 0.05, 0.003, -0.002],
    "FULL_OPENCV": [320, 315, 205, 147, 0.1, 0.02, 0.002, -0.003, 0.01, 0.2, 0.03, 0.01],
    "OPENCV_FISHEYE": [180, 182, 205, 147, 0.02, -0.01, 0.003, -0.001],
    "FOV": [200, 202, 205, 147, 0.9],
    "SIMPLE_RADIAL_FISHEYE": [180, 205, 147, 0.03],
    "RADIAL_FISHEYE": [180, 205, 147, 0.03, -0.01],
    "THIN_PRISM_FISHEYE": [180, 182, 205, 147, 0.02, -0.01, 0.002, -0.003, 0.003, -0.001, 0.002, 0.001],
}
ALL = {"SIMPLE_PINHOLE": [320, 205, 147], "PINHOLE": [320, 315, 205, 147], **DISTORTED}


def make(model: str) -> ColmapCamera:
    return ColmapCamera(model, WIDTH, HEIGHT, np.array(ALL[model], float))


def outline(camera: ColmapCamera, n: int = 200) -> np.ndarray:
    """Points along the border of a camera's image."""
    t = np.linspace(0, 1, n)
    zero, one = np.zeros(n), np.ones(n)
    sides = [np.stack(s, -1) for s in ((t, zero), (t, one), (zero, t), (one, t))]
    return np.concatenate(sides) * [camera.width, camera.height]


def plane_points(pinhole: ColmapCamera, pixels: np.ndarray) -> np.ndarray:
    return (pixels - pinhole.params[2:]) / pinhole.params[:2]


def smooth(pixels: np.ndarray) -> np.ndarray:
    """A smooth gray picture as a function of continuous pixel coordinates."""
    return 128 + 60 * np.sin(pixels[..., 0] / 17) + 60 * np.cos(pixels[..., 1] / 13 + 0.4)


def grid(width: int, height: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)


@pytest.mark.parametrize("model", ALL)
def test_projection_agrees_with_colmap(model):
    pycolmap = pytest.importorskip("pycolmap", reason="COLMAP's own camera models are the known answer")
    camera = make(model)
    theirs = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=ALL[model])
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    expected = theirs.img_from_cam(np.concatenate([points, np.ones((200, 1))], -1))
    np.testing.assert_allclose(distort(camera, points), expected, atol=1e-6)
    np.testing.assert_allclose(undistort_points(camera, expected), theirs.cam_from_img(expected), atol=1e-6 / 180)


@pytest.mark.parametrize("model", ALL)
def test_undistorting_a_pixel_and_distorting_it_again_returns_it(model):
    camera = make(model)
    pixels = grid(WIDTH, HEIGHT)[::17, ::17].reshape(-1, 2)
    rays = undistort_points(camera, pixels)
    np.testing.assert_allclose(distort(camera, rays), pixels, atol=1e-6)


def test_a_pixel_beyond_the_fold_of_the_lens_polynomial_has_no_ray():
    # r + k r^3 with k = -0.5 grows up to r = sqrt(2/3), to 0.544: pixels farther than 109 from the centre have no ray.
    camera = ColmapCamera("SIMPLE_RADIAL", 400, 400, np.array([200, 200, 200, -0.5]))
    rays = undistort_points(camera, np.array([[300.0, 200], [312.0, 200]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


@pytest.mark.parametrize("model", DISTORTED)
def test_the_pinhole_rectangle_lies_inside_the_photograph_and_touches_its_border(model):
    camera = make(model)
    pinhole = pinhole_camera(camera)
    pixels = distort(camera, plane_points(pinhole, outline(pinhole)))
    assert (pixels > -0.05).all()
    assert (pixels < np.array([WIDTH, HEIGHT]) + 0.05).all()
    # As large as possible: each side grown by two pixels would leave the photograph (unless at the size limit).
    low, high = -pinhole.params[2:], np.array([pinhole.width, pinhole.height]) - pinhole.params[2:]
    for axis, size in enumerate((WIDTH, HEIGHT)):
        for side in (low, high):
            corner = np.linspace(low, high, 400)
            corner[:, axis] = side[axis] + 2 * np.sign(side[axis])
            grown = distort(camera, corner / pinhole.params[:2])
            outside = ((grown < 0) | (grown > [WIDTH, HEIGHT])).any()
            assert outside or (pinhole.width, pinhole.height)[axis] > 0.98 * size * 1.5


@pytest.mark.parametrize("model", DISTORTED)
def test_the_undistorted_picture_is_the_scene_seen_by_the_pinhole_camera(model):
    # The photograph holds, at the centre of each pixel, the analytic picture of the scene.
    camera = make(model)
    photo = np.rint(smooth(undistort_points(camera, grid(WIDTH, HEIGHT).reshape(-1, 2)) * 250)).reshape(HEIGHT, WIDTH)
    pinhole = pinhole_camera(camera)
    result = undistort_image(np.nan_to_num(photo).astype(np.uint8), camera, pinhole).astype(float)
    expected = smooth(plane_points(pinhole, grid(pinhole.width, pinhole.height)) * 250)
    assert result.shape == (pinhole.height, pinhole.width)
    inner = (slice(2, -2), slice(2, -2))
    error = np.abs(result - expected)[inner].mean()
    assert error < 0.6  # of 255 levels; rounding to 8 bits twice makes about 0.35
    half_a_pixel_off = smooth(plane_points(pinhole, grid(pinhole.width, pinhole.height) + 0.5) * 250)
    assert np.abs(result - half_a_pixel_off)[inner].mean() > 3 * error


@pytest.mark.parametrize("max_size", [200, 133])
def test_reducing_keeps_pixels_where_they_are_and_does_not_alias(max_size):
    camera = make("SIMPLE_RADIAL")
    pinhole = pinhole_camera(camera, max_size)
    assert max(pinhole.width, pinhole.height) == max_size
    photo = smooth(undistort_points(camera, grid(WIDTH, HEIGHT).reshape(-1, 2)) * 320).reshape(HEIGHT, WIDTH)
    result = undistort_image(np.rint(photo).astype(np.uint8), camera, pinhole).astype(float)
    expected = smooth(plane_points(pinhole, grid(pinhole.width, pinhole.height)) * 320)
    assert np.abs(result - expected).mean() < 1
    stripes = np.tile(np.array([0, 255], np.uint8), (HEIGHT, WIDTH // 2))
    assert undistort_image(stripes, camera, pinhole).std() < 40  # sampling without averaging gives about 127


def test_a_photograph_without_distortion_comes_back_unchanged():
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    camera = make("PINHOLE")
    assert np.array_equal(undistort_image(image, camera, pinhole_camera(camera, 400)), image)
    weak = ColmapCamera("SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([320, 205, 147, 0.0]))
    assert np.array_equal(undistort_image(image, weak, pinhole_camera(weak)), image)


def test_masks_stay_aligned_with_photographs():
    camera, random = make("OPENCV"), np.random.default_rng(1)
    for max_size in (None, 250):
        pinhole = pinhole_camera(camera, max_size)
        center, radius = random.uniform([150, 100], [250, 200]), 60
        mask = np.linalg.norm(grid(WIDTH, HEIGHT) - center, axis=-1) < radius
        result = undistort_mask(mask, camera, pinhole)
        truth = distort(camera, plane_points(pinhole, grid(pinhole.width, pinhole.height)))
        expected = np.linalg.norm(truth - center, axis=-1) < radius
        middle, expected_middle = np.argwhere(result).mean(0), np.argwhere(expected).mean(0)
        np.testing.assert_allclose(middle, expected_middle, atol=0.1)
        assert result.sum() == pytest.approx(expected.sum(), rel=0.005)
        photo = undistort_image(mask.astype(np.uint8) * 255, camera, pinhole) > 127
        assert (photo != result).mean() < 2e-4  # single pixels: bicubic against bilinear


def test_a_lens_that_folds_the_photograph_over_is_refused():
    camera = ColmapCamera("SIMPLE_RADIAL", 400, 300, np.array([200, 200, 150, -2000.0]))
    with pytest.raises(UserError, match="SIMPLE_RADIAL"):
        pinhole_camera(camera)


def small_workspace(tmp_path, names=("a.jpg", "sub/b.png", "c.bmp")):
    model = ColmapModel(
        {1: make("SIMPLE_RADIAL")}, [ColmapImage(n, 1, np.eye(4)) for n in names], np.zeros((0, 3)), np.zeros((0, 3))
    )
    photo = np.rint(smooth(grid(WIDTH, HEIGHT)))[..., None].repeat(3, -1).astype(np.uint8)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[100:200, 120:220] = True
    for name in names:
        write_image(tmp_path / "photos" / name, photo)
    write_image(tmp_path / "masks" / "ball" / "a.png", mask)
    return model, tmp_path / "photos", tmp_path / "masks"


def test_views_are_written_with_their_masks_and_finished_ones_are_skipped(tmp_path):
    model, photos, masks = small_workspace(tmp_path)
    out = tmp_path / "capture"
    views = undistort_views(model, photos, masks, out, 200)
    assert [v.name for v in views] == ["a.jpg", "sub/b.png", "c.png"]
    for view in views:
        assert read_image_bytes(out / "images" / view.name).shape == (view.camera.height, view.camera.width, 3)
    mask = read_mask(out / "masks" / "ball" / "a.png")
    assert mask.shape == (views[0].camera.height, views[0].camera.width)
    assert mask.any()
    times = {p: p.stat().st_mtime_ns for p in out.rglob("*.*")}
    (out / "images" / "sub" / "b.png").unlink()
    undistort_views(model, photos, masks, out, 200)
    changed = {p.name for p, t in times.items() if p.stat().st_mtime_ns != t}
    assert changed == {"b.png"}
    undistort_views(model, photos, masks, out, 100)
    assert read_image_bytes(out / "images" / "a.jpg").shape[1] == 100


def test_a_repainted_mask_is_undistorted_again(tmp_path):
    model, photos, masks = small_workspace(tmp_path)
    undistort_views(model, photos, masks, tmp_path / "out", 200)
    write_image(masks / "ball" / "a.png", np.ones((HEIGHT, WIDTH), bool))
    undistort_views(model, photos, masks, tmp_path / "out", 200)
    assert read_mask(tmp_path / "out" / "masks" / "ball" / "a.png").all()


def test_a_jpeg_that_needs_no_change_is_not_compressed_again(tmp_path):
    model, photos, _ = small_workspace(tmp_path, ("a.jpg",))
    model = ColmapModel({1: make("PINHOLE")}, model.images, model.points, model.colors)
    undistort_views(model, photos, None, tmp_path / "out")
    assert (tmp_path / "out" / "images" / "a.jpg").read_bytes() == (photos / "a.jpg").read_bytes()


def test_missing_photographs_are_named_before_any_work(tmp_path):
    model, photos, masks = small_workspace(tmp_path)
    (photos / "c.bmp").unlink()
    with pytest.raises(UserError, match=r"1 of 3.*c\.bmp"):
        undistort_views(model, photos, masks, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_photographs_and_masks_of_another_size_are_refused_by_name(tmp_path):
    model, photos, masks = small_workspace(tmp_path)
    write_image(masks / "ball" / "c.png", np.ones((10, 20), bool))
    with pytest.raises(UserError, match=r"c\.png has 20 x 10"):
        undistort_views(model, photos, masks, tmp_path / "out")
    write_image(photos / "a.jpg", np.zeros((30, 40, 3)))
    with pytest.raises(UserError, match=r"a\.jpg has 40 x 30"):
        undistort_views(model, photos, None, tmp_path / "other")


def test_masks_that_belong_to_no_photograph_are_refused(tmp_path):
    write_image(tmp_path / "masks" / "x.png", np.ones((4, 4), bool))
    with pytest.raises(UserError, match="no reflector folder"):
        find_masks(tmp_path / "masks", ["a.jpg"])
    write_image(tmp_path / "masks" / "ball" / "x.png", np.ones((4, 4), bool))
    with pytest.raises(UserError, match=r"None of the 1 masks.*ball.*x\.png"):
        find_masks(tmp_path / "masks", ["a.jpg"])
    write_image(tmp_path / "masks" / "ball" / "a.jpg.png", np.ones((4, 4), bool))
    assert find_masks(tmp_path / "masks", ["a.jpg"])["ball"].keys() == {"a.jpg"}


def test_photographs_that_share_a_stem_are_refused(tmp_path):
    model, photos, _ = small_workspace(tmp_path, ("a.jpg", "a.png"))
    with pytest.raises(UserError, match=r"a\.jpg and a\.png"):
        undistort_views(model, photos, None, tmp_path / "out")


@pytest.mark.parametrize("upright", [False, True])
def test_photographs_are_read_with_the_orientation_they_were_calibrated_in(tmp_path, upright):
    image_module = pytest.importorskip("PIL.Image", reason="writes the EXIF orientation tag")
    size = (HEIGHT, WIDTH) if upright else (WIDTH, HEIGHT)
    stored = image_module.new("RGB", (WIDTH, HEIGHT))
    exif = stored.getexif()
    exif[0x0112] = 6  # turned by a quarter
    (tmp_path / "photos").mkdir()
    stored.save(tmp_path / "photos" / "a.jpg", exif=exif)
    camera = ColmapCamera("PINHOLE", *size, np.array([320, 320, size[0] / 2, size[1] / 2]))
    model = ColmapModel({1: camera}, [ColmapImage("a.jpg", 1, np.eye(4))], np.zeros((0, 3)), np.zeros((0, 3)))
    undistort_views(model, tmp_path / "photos", None, tmp_path / "out", upright=upright)
    assert read_image_bytes(tmp_path / "out" / "images" / "a.jpg").shape == (size[1], size[0], 3)
