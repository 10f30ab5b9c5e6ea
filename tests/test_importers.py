"""Calibrated photographs from elsewhere become captures in which points stay on their pixels."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from toy import ball_mask, make_toy_capture

from catacaustics.cameras import Camera
from catacaustics.capture.colmap import ColmapCamera, read_model, write_model
from catacaustics.capture.dataset import View
from catacaustics.capture.importers import import_capture, importable, read_source, read_transforms
from catacaustics.capture.undistort import distort
from catacaustics.errors import UserError
from catacaustics.files import read_json, write_json
from catacaustics.geometry import look_at, rigid_inverse, transform
from catacaustics.images import read_image_bytes, read_mask, write_image

WIDTH, HEIGHT = 160, 120
POINT = np.array([0.1, -0.2, 0.15])


def poses(n: int = 4) -> list[np.ndarray]:
    turn = np.arange(n) * 2 * np.pi / n
    eyes = np.stack([3 * np.cos(turn), np.full(n, -1.0), 3 * np.sin(turn)], -1)
    return [look_at(eye, np.zeros(3), np.array([0, -1.0, 0])) for eye in eyes]


def photo_of(camera: ColmapCamera, pose: np.ndarray) -> np.ndarray:
    """A gray photograph with a soft white spot where the camera sees POINT."""
    spot = pixel_of(camera, pose, POINT)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    bright = np.exp(-((x - spot[0]) ** 2 + (y - spot[1]) ** 2) / (2 * 2.0**2))
    return (60 + 190 * bright[..., None].repeat(3, -1)).astype(np.uint8)


def pixel_of(camera: ColmapCamera, pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    local = transform(pose, point)
    return distort(camera, local[..., :2] / local[..., 2:])


def spot_in(image: np.ndarray) -> np.ndarray:
    """Centre of brightness above the gray, in pixel coordinates."""
    weight = np.clip(image[..., 0].astype(float) - 80, 0, None)
    x, y = np.meshgrid(np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5)
    return np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


def assert_the_point_is_on_its_pixel(capture) -> None:
    for view in capture.views:
        np.testing.assert_allclose(spot_in(capture.image(view)), view.camera.project(POINT)[0], atol=0.1)


# COLMAP --------------------------------------------------------------------------------------------------------------

CAMERA = ColmapCamera("OPENCV", WIDTH, HEIGHT, np.array([150, 148, 83, 58, -0.15, 0.03, 0.002, -0.001]))


def write_text_model(folder: Path, names: list[str]) -> None:
    from scipy.spatial.transform import Rotation

    folder.mkdir(parents=True)
    params = " ".join(map(repr, CAMERA.params.tolist()))
    (folder / "cameras.txt").write_text(f"# comment\n1 OPENCV {WIDTH} {HEIGHT} {params}\n")
    lines = []
    for i, (name, pose) in enumerate(zip(names, poses(len(names)), strict=True), 1):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        numbers = " ".join(map(repr, [w, x, y, z, *pose[:3, 3].tolist()]))
        lines += [f"{i} {numbers} 1 {name}", ""]
    (folder / "images.txt").write_text("# comment\n" + "\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("1 0.1 -0.2 0.15 255 0 51 0.5\n")


def workspace(root: Path, model: str = "sparse/0") -> Path:
    names = ["a.png", "b.png", "c.png", "sub/d.png"]
    write_text_model(root / model, names)
    for name, pose in zip(names, poses(), strict=True):
        write_image(root / "images" / name, photo_of(CAMERA, pose))
    return root


@pytest.mark.parametrize("model", ["sparse/0", "sparse"])
def test_a_distorted_colmap_workspace_becomes_a_capture_with_points_on_their_pixels(tmp_path, model):
    source = workspace(tmp_path / "source", model)
    write_image(tmp_path / "masks" / "ball" / "b.png", np.pad(np.ones((60, 80), bool), ((20, 40), (30, 50))))
    assert importable(source)
    capture = import_capture(source, tmp_path / "capture", tmp_path / "masks", 120, held_out_every=2)
    assert [v.name for v in capture.held_out] == ["a.png", "c.png"]
    assert [v.name for v in capture.train] == ["b.png", "sub/d.png"]
    assert max(capture.views[0].camera.width, capture.views[0].camera.height) == 120
    assert capture.reflectors == ["ball"]
    assert capture.mask(capture.train[0], "ball").any()
    assert_the_point_is_on_its_pixel(capture)
    written = read_model(tmp_path / "capture" / "sparse" / "0")
    np.testing.assert_allclose(written.points, [POINT])
    np.testing.assert_allclose(written.colors, [[1, 0, 0.2]])


def test_text_and_binary_models_give_the_same_capture(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="converts a text model to binary")
    text = workspace(tmp_path / "text")
    (tmp_path / "binary" / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "binary" / "images").symlink_to(text / "images")
    pycolmap.Reconstruction(text / "sparse" / "0").write_binary(tmp_path / "binary" / "sparse" / "0")
    assert not list((tmp_path / "binary").rglob("*.txt"))
    first, second = (import_capture(s, tmp_path / s.name / "out") for s in (text, tmp_path / "binary"))
    assert {v.name for v in first.views} == {v.name for v in second.views}
    by_name = {v.name: v for v in second.views}
    for view in first.views:
        other = by_name[view.name]
        np.testing.assert_allclose(view.camera.camera_from_world, other.camera.camera_from_world, atol=1e-9)
        np.testing.assert_allclose(view.camera.intrinsics, other.camera.intrinsics)
        assert np.array_equal(first.image(view), second.image(other))


def test_a_second_import_keeps_finished_photographs_and_a_changed_split(tmp_path):
    source, out = workspace(tmp_path / "source"), tmp_path / "capture"
    import_capture(source, out)
    write_json(out / "split.json", {"train": ["a.png", "b.png", "c.png"], "held_out": ["sub/d.png"]})
    before = {p: p.stat().st_mtime_ns for p in (out / "images").rglob("*.png")}
    capture = import_capture(source, out)
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert [v.name for v in capture.held_out] == ["sub/d.png"]
    (out / "split.json").write_text('{"train": ["other.png"], "held_out": []}')
    assert len(import_capture(source, out).views) == 4


def test_missing_photographs_of_a_workspace_are_listed(tmp_path):
    source = workspace(tmp_path / "source")
    (source / "images" / "b.png").unlink()
    (source / "images" / "sub" / "d.png").unlink()
    with pytest.raises(UserError, match=r"2 of 4 .* missing: b\.png, sub/d\.png"):
        read_source(source)


def test_a_folder_of_plain_photographs_holds_no_cameras(tmp_path):
    write_image(tmp_path / "images" / "a.png", np.zeros((4, 4, 3), np.uint8))
    assert not importable(tmp_path)
    with pytest.raises(UserError, match="no cameras"):
        read_source(tmp_path)


def test_a_capture_can_be_imported_again(tmp_path):
    # Its own layout is a COLMAP workspace without distortion.
    views = [View(f"{i}.png", Camera(WIDTH, HEIGHT, 150.0, 150.0, 80.0, 60.0, p)) for i, p in enumerate(poses())]
    write_model(tmp_path / "one" / "sparse" / "0", [(v.name, v.camera) for v in views])
    plain = ColmapCamera("PINHOLE", WIDTH, HEIGHT, np.array([150.0, 150, 80, 60]))
    for view in views:
        write_image(tmp_path / "one" / "images" / view.name, photo_of(plain, view.camera.camera_from_world))
    capture = import_capture(tmp_path / "one", tmp_path / "two")
    assert_the_point_is_on_its_pixel(capture)
    for view in capture.views:
        assert np.array_equal(capture.image(view), read_image_bytes(tmp_path / "one" / "images" / view.name))


# transforms.json -----------------------------------------------------------------------------------------------------


def opengl(pose: np.ndarray) -> list[list[float]]:
    """world_from_camera with y up and z backward, from camera_from_world with y down and z forward."""
    matrix = rigid_inverse(pose)
    matrix[:3, 1:3] *= -1
    return matrix.tolist()


FISHEYE = ColmapCamera("OPENCV_FISHEYE", WIDTH, HEIGHT, np.array([100, 101, 82, 59, 0.02, -0.01, 0.003, -0.001]))
CUBIC = ColmapCamera("FULL_OPENCV", WIDTH, HEIGHT, np.array([150, 148, 83, 58, -0.1, 0.02, 0, 0, 0.01, 0, 0, 0]))
ANGLE = ColmapCamera("PINHOLE", WIDTH, HEIGHT, np.array([80 / np.tan(0.45), 80 / np.tan(0.45), 80, 60]))
SIZE = {"w": WIDTH, "h": HEIGHT}
FLAVOURS = {
    "nerfstudio": (
        CAMERA,
        {**SIZE, "camera_model": "OPENCV", "fl_x": 150, "fl_y": 148, "cx": 83, "cy": 58}
        | {"k1": -0.15, "k2": 0.03, "p1": 0.002, "p2": -0.001},
    ),
    "fisheye": (
        FISHEYE,
        {**SIZE, "camera_model": "OPENCV_FISHEYE", "fl_x": 100, "fl_y": 101, "cx": 82, "cy": 59}
        | {"k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001},
    ),
    "instant-ngp fisheye": (
        FISHEYE,
        {**SIZE, "is_fisheye": True, "fl_x": 100, "fl_y": 101, "cx": 82, "cy": 59}
        | {"k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001},
    ),
    "third coefficient": (
        CUBIC,
        {**SIZE, "fl_x": 150, "fl_y": 148, "cx": 83, "cy": 58, "k1": -0.1, "k2": 0.02, "k3": 0.01},
    ),
    "angle only": (ANGLE, {"camera_angle_x": 0.9}),
}


def scene(root: Path, camera: ColmapCamera, shared: dict, suffix: str = ".png", per_frame: bool = False) -> Path:
    frames = []
    for i, pose in enumerate(poses()):
        write_image(root / "images" / f"frame_{i}.png", photo_of(camera, pose))
        frame = {"file_path": f"./images/frame_{i}{suffix}", "transform_matrix": opengl(pose)}
        frames.append(frame | (shared if per_frame else {}))
    write_json(root / "transforms.json", {"frames": frames} | ({} if per_frame else shared))
    return root


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("per_frame", [False, True])
def test_a_transforms_file_puts_a_known_point_on_the_right_pixel(tmp_path, flavour, per_frame):
    camera, shared = FLAVOURS[flavour]
    source = scene(tmp_path / "source", camera, shared, suffix="" if per_frame else ".png", per_frame=per_frame)
    assert importable(source)
    assert importable(source / "transforms.json")
    model, photos = read_source(source)
    assert len(model.cameras) == 1
    assert [i.name for i in model.images] == [f"frame_{i}.png" for i in range(4)]
    for image, pose in zip(model.images, poses(), strict=True):
        expected = pixel_of(camera, pose, POINT)
        np.testing.assert_allclose(pixel_of(model.cameras[1], image.camera_from_world, POINT), expected, atol=1e-6)
        np.testing.assert_allclose(spot_in(read_image_bytes(photos[image.name])), expected, atol=0.1)
    assert_the_point_is_on_its_pixel(import_capture(source, tmp_path / "capture"))


def test_each_frame_may_have_its_own_focal_length(tmp_path):
    source = scene(tmp_path, ANGLE, SIZE | {"fl_x": 150})
    value = json.loads((source / "transforms.json").read_text())
    value["frames"][2]["fl_x"] = 170
    write_json(source / "transforms.json", value)
    model, _ = read_source(source)
    assert [model.cameras[i.camera_id].params[0] for i in model.images] == [150, 150, 170, 150]
    np.testing.assert_allclose(model.cameras[1].params, [150, 150, 80, 60])


def test_photographs_in_several_folders_keep_their_folders_in_their_names(tmp_path):
    frames = []
    for name, pose in zip(["left/a.jpg", "right/a.jpg"], poses(2), strict=True):
        write_image(tmp_path / "images" / name, photo_of(ANGLE, pose))
        frames.append({"file_path": f"images\\{name}".replace("/", "\\"), "transform_matrix": opengl(pose)})
    write_json(tmp_path / "transforms.json", {"camera_angle_x": 0.9, "frames": frames})
    assert list(read_transforms(tmp_path / "transforms.json")[1]) == ["left/a.jpg", "right/a.jpg"]


def test_missing_photographs_of_a_transforms_file_are_listed(tmp_path):
    source = scene(tmp_path, ANGLE, {"camera_angle_x": 0.9}, suffix="")
    (source / "images" / "frame_0.png").unlink()
    (source / "images" / "frame_3.png").unlink()
    with pytest.raises(UserError, match=r"2 of 4 .* missing: frame_0, frame_3"):
        read_source(source)


def frame_with(**changes) -> dict:
    return {"file_path": "images/frame_0.png", "transform_matrix": np.eye(4).tolist()} | changes


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"camera_angle_x": 0.9}, "no list of frames"),
        ({"camera_angle_x": 0.9, "frames": [{"transform_matrix": []}]}, "no list of frames"),
        ({"frames": [frame_with()]}, "no focal length"),
        ({"fl_x": "wide", "frames": [frame_with()]}, "intrinsics of frame_0.png are malformed"),
        ({"fl_x": 100, "camera_model": "EQUIRECTANGULAR", "frames": [frame_with()]}, "EQUIRECTANGULAR"),
        ({"fl_x": 100, "k4": 0.1, "frames": [frame_with()]}, "with k4"),
        ({"fl_x": 100, "frames": [frame_with(transform_matrix=[[1, 2], [3, 4]])]}, "frame_0.png has no 4 x 4"),
        ({"fl_x": 100, "frames": [frame_with(transform_matrix=None)]}, "frame_0.png has no 4 x 4"),
        ({"fl_x": 100, "frames": [frame_with(transform_matrix=np.diag([1, 2, 1, 1]).tolist())]}, "not a rotation"),
        ({"fl_x": 100, "frames": [frame_with(transform_matrix=np.diag([-1, 1, 1, 1]).tolist())]}, "not a rotation"),
        ({"fl_x": 100, "frames": [frame_with(), frame_with()]}, "several frames, first frame_0.png"),
        ([1, 2], "no list of frames"),
    ],
)
def test_malformed_transforms_files_are_refused_with_the_reason(tmp_path, value, message):
    write_image(tmp_path / "images" / "frame_0.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    write_json(tmp_path / "transforms.json", value)
    with pytest.raises(UserError, match=message):
        read_source(tmp_path)


# Real photographs ----------------------------------------------------------------------------------------------------


@pytest.fixture
def mirror_ball() -> Path:
    if "CATACAUSTICS_CAPTURES" not in os.environ:
        pytest.skip("needs the mirror_ball photographs: set CATACAUSTICS_CAPTURES to their parent folder")
    return Path(os.environ["CATACAUSTICS_CAPTURES"]) / "mirror_ball"


def test_the_mirror_ball_workspace_opens_and_its_points_reproject_the_same(mirror_ball, tmp_path):
    model, photos = read_source(mirror_ball)
    assert (len(model.images), len(photos)) == (34, 34)
    capture = import_capture(mirror_ball, tmp_path)
    assert len(capture.views) == 34
    by_name = {view.name: view for view in capture.views}
    image = model.images[0]
    view, camera = by_name[image.name], model.cameras[image.camera_id]
    local = transform(image.camera_from_world, model.points)
    seen = model.points[(local[:, 2] > 0.1) & (np.abs(local[:, :2]) < 0.6 * local[:, 2:]).all(-1)]
    assert len(seen) > 500
    pixels, _ = view.camera.project(seen)
    # The same rays: a pinhole pixel, distorted, is the photograph's pixel.
    rays = (pixels - [view.camera.cx, view.camera.cy]) / [view.camera.fx, view.camera.fy]
    expected = pixel_of(camera, image.camera_from_world, seen)
    np.testing.assert_allclose(distort(camera, rays), expected, atol=1e-6)
    # And the same colours there.
    inside = (pixels > 5).all(-1) & (pixels < [view.camera.width - 5, view.camera.height - 5]).all(-1)
    photo, result = read_image_bytes(photos[image.name]), capture.image(view)

    def difference(shift: float) -> float:
        return np.abs(colors_at(photo, expected[inside]) - colors_at(result, pixels[inside] + shift)).mean()

    assert difference(0) < 3  # of 255 levels, at corners and edges
    assert difference(0) < 0.7 * min(difference(-0.5), difference(0.5))


def colors_at(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    import cv2

    x, y = (pixels - 0.5).astype(np.float32).T
    return cv2.remap(image, x[None], y[None], cv2.INTER_LINEAR)[0].astype(float)


# Masks of a ball -----------------------------------------------------------------------------------------------------


def test_a_sphere_is_found_from_three_circles_and_painted_in_every_view(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "tools")
    from mask_sphere import main

    source, center, radius = workspace(tmp_path / "source"), np.array([0.05, 0.1, -0.1]), 0.4
    model, _ = read_source(source)
    circles, expected = [], {}
    for image in model.images:
        local = transform(image.camera_from_world, center)
        x, y = np.meshgrid(np.linspace(-0.6, 0.6, 1500), np.linspace(-0.5, 0.5, 1250))
        rays = np.stack([x, y, np.ones_like(x)], -1)
        cosine = rays @ local / np.linalg.norm(rays, axis=-1) / np.linalg.norm(local)
        outline = distort(CAMERA, rays[cosine > np.cos(np.arcsin(radius / np.linalg.norm(local)))][:, :2])
        expected[image.name] = outline
        low, high = outline.min(0), outline.max(0)
        circles += ["--circle", image.name, *map(str, [*(low + high) / 2, (high - low).mean() / 2])]
    main([str(source), str(tmp_path / "masks"), "--reflector", "ball", *circles[:15]])
    for name, outline in expected.items():
        mask = read_mask(tmp_path / "masks" / "ball" / name)
        y, x = np.nonzero(mask)
        np.testing.assert_allclose([x.min(), y.min()], outline.min(0), atol=1.2)
        np.testing.assert_allclose([x.max() + 1, y.max() + 1], outline.max(0), atol=1.2)
        assert mask.sum() == pytest.approx(np.pi * np.prod(np.ptp(outline, axis=0)) / 4, rel=0.02)


def test_masks_and_split_beside_the_cameras_come_along(tmp_path):
    source = make_toy_capture(tmp_path / "source")
    split = read_json(source / "split.json")
    capture = import_capture(source, tmp_path / "capture")
    assert [v.name for v in capture.held_out] == split["held_out"]
    assert capture.reflectors == ["ball"]
    view = capture.held_out[0]
    np.testing.assert_array_equal(capture.mask(view, "ball"), ball_mask(view.camera))
