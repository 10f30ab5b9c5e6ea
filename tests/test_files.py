"""Files: atomic writes, JSON, images, masks, PLY, COLMAP models, captures."""

import errno
import json

import numpy as np
import pytest
from toy import floor_cloud, make_toy_capture, toy_cameras

from catacaustics.capture.colmap import read_model, write_model
from catacaustics.capture.dataset import default_split, open_capture
from catacaustics.errors import UserError
from catacaustics.files import atomic_path, read_json, write_json, write_text
from catacaustics.images import list_images, read_image, read_mask, resize, write_image
from catacaustics.points import read_ply, write_ply


def test_a_write_that_fails_leaves_the_old_file_and_no_debris(tmp_path):
    path = tmp_path / "value.txt"
    write_text(path, "old")

    def fail_half_way():
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["value.txt"]


@pytest.mark.parametrize(("number", "words"), [(errno.ENOSPC, "No space left"), (errno.EACCES, "Cannot write")])
def test_a_full_or_forbidden_disk_is_one_clear_message_and_keeps_the_old_file(tmp_path, number, words):
    path = tmp_path / "value.txt"
    write_text(path, "old")

    def disk_refuses():
        with atomic_path(path):
            raise OSError(number, "refused")

    with pytest.raises(UserError, match=words):
        disk_refuses()
    assert path.read_text() == "old"


def test_json_that_is_missing_or_cut_off_is_named(tmp_path):
    with pytest.raises(UserError, match=r"no file .*a\.json"):
        read_json(tmp_path / "a.json")
    write_json(tmp_path / "a.json", {"x": [1, 2]})
    assert read_json(tmp_path / "a.json") == {"x": [1, 2]}
    (tmp_path / "a.json").write_text('{"x": [1,')
    with pytest.raises(UserError, match="not valid JSON"):
        read_json(tmp_path / "a.json")


def test_png_keeps_an_image_exactly_and_its_channels_in_order(tmp_path):
    image = np.zeros((4, 6, 3), np.float32)
    image[1, 2] = [1.0, 0.2, 0.0]
    write_image(tmp_path / "a.png", image)
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), image, atol=1e-6)


def test_an_image_or_mask_that_cannot_be_read_is_named(tmp_path):
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "text.png").write_text("not an image")
    for read in (read_image, read_mask):
        with pytest.raises(UserError, match=r"empty\.jpg is empty \(0 bytes\)"):
            read(tmp_path / "empty.jpg")
        with pytest.raises(UserError, match=r"text\.png cannot be decoded"):
            read(tmp_path / "text.png")
        with pytest.raises(UserError, match=r"no image .*gone\.png"):
            read(tmp_path / "gone.png")


def test_shrinking_averages_areas():
    image = np.random.default_rng(0).random((8, 12, 3)).astype(np.float32)
    np.testing.assert_allclose(resize(image, 6, 4), image.reshape(4, 2, 6, 2, 3).mean((1, 3)), atol=1e-6)


def test_images_are_listed_through_subfolders_without_hidden_files(tmp_path):
    for name in ("b/2.JPG", "a.png", ".hidden.png", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert [p.relative_to(tmp_path).as_posix() for p in list_images(tmp_path)] == ["a.png", "b/2.JPG"]


def test_a_point_cloud_survives_its_file_and_a_damaged_file_is_named(tmp_path):
    cloud = floor_cloud()
    write_ply(tmp_path / "c.ply", cloud)
    loaded = read_ply(tmp_path / "c.ply")
    np.testing.assert_array_equal(loaded.positions, cloud.positions)
    np.testing.assert_array_equal(loaded.normals, cloud.normals)
    np.testing.assert_allclose(loaded.colors, cloud.colors, atol=0.5 / 255 + 1e-6)
    (tmp_path / "c.ply").write_bytes((tmp_path / "c.ply").read_bytes()[:2000])
    with pytest.raises(UserError, match=r"c\.ply is not a complete PLY"):
        read_ply(tmp_path / "c.ply")


def test_a_point_cloud_without_normals_is_refused_by_their_names(tmp_path):
    (tmp_path / "c.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
    )
    with pytest.raises(UserError, match="no properties nx, ny, nz"):
        read_ply(tmp_path / "c.ply")


def test_a_colmap_model_survives_its_files_and_pycolmap_reads_the_same(tmp_path):
    import pycolmap

    cameras = toy_cameras(3, 64, 48)
    points = np.random.default_rng(0).standard_normal((5, 3))
    colors = np.linspace(0, 1, 15).reshape(5, 3)
    write_model(tmp_path, [(f"sub/{i}.jpg", c) for i, c in enumerate(cameras)], points, colors)
    model = read_model(tmp_path)
    theirs = pycolmap.Reconstruction(tmp_path)
    assert len(model.cameras) == len(theirs.cameras) == 1  # equal intrinsics are shared
    np.testing.assert_array_equal(model.points, points)
    np.testing.assert_allclose(model.colors, colors, atol=0.5 / 255 + 1e-9)
    for image, camera in zip(model.images, cameras, strict=True):
        np.testing.assert_allclose(image.camera_from_world, camera.camera_from_world, atol=1e-12)
        found = theirs.find_image_with_name(image.name)
        np.testing.assert_allclose(found.cam_from_world().matrix(), camera.camera_from_world[:3], atol=1e-9)
    pycolmap.Reconstruction(tmp_path).write_text(str(tmp_path))
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}.bin").unlink()
    text = read_model(tmp_path)
    np.testing.assert_allclose(text.images[2].camera_from_world, cameras[2].camera_from_world, atol=1e-9)


def test_the_default_split_holds_out_every_eighth_view_and_always_leaves_some():
    names = [f"{i:02d}.jpg" for i in range(17)]
    split = default_split(names)
    assert split["held_out"] == ["00.jpg", "08.jpg", "16.jpg"]
    assert sorted(split["train"] + split["held_out"]) == names
    assert default_split(names[:3]) == {"train": names[:2], "held_out": names[2:3]}


def test_a_capture_reads_images_only_when_asked_and_checks_their_size(tmp_path):
    root = make_toy_capture(tmp_path)
    capture = open_capture(root)
    assert (len(capture.train), len(capture.held_out), capture.reflectors) == (8, 2, ["ball"])
    view = capture.train[0]
    (root / "images" / capture.train[1].name).write_bytes(b"")  # opening must not have needed it
    capture = open_capture(root)
    assert capture.image(view).shape == (48, 64, 3)
    (root / "masks" / "ball" / "view_00.png").unlink()
    assert capture.mask(view, "ball") is None
    write_image(root / "images" / view.name, np.zeros((10, 10, 3)))
    with pytest.raises(UserError, match=r"view_00\.png has 10 x 10 pixels"):
        capture.image(view)


def test_a_split_with_unknown_or_no_names_is_refused(tmp_path):
    root = make_toy_capture(tmp_path)
    for split, words in (
        ({"train": ["nobody.png"], "held_out": []}, "nobody.png"),
        ({"train": [], "held_out": []}, "no view for training"),
        ({"learn": []}, "other keys"),
    ):
        (root / "split.json").write_text(json.dumps(split))
        with pytest.raises(UserError, match=words):
            open_capture(root)
