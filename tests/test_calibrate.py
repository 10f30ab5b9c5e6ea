import os
import sys
from pathlib import Path

import numpy as np
import pytest
from room import cameras, photographs

from catacaustics.capture import calibrate as stage
from catacaustics.capture import sfm
from catacaustics.capture.calibrate import Stages, calibrate
from catacaustics.capture.colmap import read_model
from catacaustics.capture.dataset import Capture
from catacaustics.config import CalibrateConfig
from catacaustics.errors import UserError
from catacaustics.files import write_bytes
from catacaustics.geometry import rigid_inverse
from catacaustics.images import write_image
from catacaustics.points import PointCloud

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))
from compare_cameras import compare


def no_stereo(capture: Capture, max_size: int, sparse_points: np.ndarray | None) -> tuple[PointCloud, PointCloud]:
    """Multi-view stereo has its own tests; here one point stands in for it."""
    assert sparse_points is None or len(sparse_points) > 0
    up = np.array([[0, 0, 1]], np.float32)
    return PointCloud(up, up, up), PointCloud(up[:0], up[:0], up[:0])


def world_from_camera(folder: Path) -> dict[str, np.ndarray]:
    return {i.name: rigid_inverse(i.camera_from_world) for i in read_model(folder / "sparse" / "0").images}


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("room")
    photographs(folder, cameras())
    return folder


@pytest.fixture(scope="module")
def calibrated(room, tmp_path_factory) -> Path:
    capture = tmp_path_factory.mktemp("capture")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("catacaustics.capture.stereo.fuse_capture", no_stereo)
        calibrate(CalibrateConfig(photos=room, capture=capture))
    return capture


def test_eight_photographs_are_placed_within_half_a_percent(calibrated):
    ours = world_from_camera(calibrated)
    exact = {f"view_{k:02d}.jpg": rigid_inverse(c.camera_from_world) for k, c in enumerate(cameras())}
    assert sorted(ours) == sorted(exact)
    result = compare(np.array([ours[n] for n in sorted(exact)]), np.array([exact[n] for n in sorted(exact)]))
    assert result["position_errors"].max() < 0.005
    assert result["rotation_errors"].max() < 0.3


def test_the_focal_length_is_recovered_to_one_percent(calibrated):
    (camera,) = read_model(calibrated / "sparse" / "0").cameras.values()
    assert camera.model == "PINHOLE"
    np.testing.assert_allclose(camera.params[:2], 280, rtol=0.01)


def test_the_report_stands_alone_and_names_every_photograph(calibrated):
    text = (calibrated / "report.html").read_text()
    assert all(f"view_{k:02d}.jpg" in text for k in range(8))
    assert text.count("data:image/jpeg;base64,") == 8
    assert "http" not in text
    assert text.count("<polygon") == 8


def test_finished_stages_are_kept_and_said_so(room, calibrated, monkeypatch, capsys):
    monkeypatch.setattr("catacaustics.capture.stereo.fuse_capture", no_stereo)

    def fail(*_, **__):
        raise AssertionError("a finished stage ran again")

    for name in ("extract", "match", "relative_poses"):
        monkeypatch.setattr(sfm, name, fail)
    calibrate(CalibrateConfig(photos=room, capture=calibrated))
    said = capsys.readouterr().out
    assert all(f"{stage}: finished before, kept" in said for stage in ("features", "matches", "cameras", "points"))


def test_an_interrupted_match_goes_on_where_it_stopped(room, tmp_path, monkeypatch):
    asked = []
    real = sfm.match

    def interrupted(database, pairs, list_file):
        asked.append(len(pairs))
        real(database, pairs[:2], list_file)
        raise KeyboardInterrupt

    few = tmp_path / "photos"
    for k in range(3):
        write_bytes(few / f"{k}.jpg", (room / f"view_{k:02d}.jpg").read_bytes())
    config = CalibrateConfig(photos=few, capture=tmp_path / "capture")
    monkeypatch.setattr(sfm, "match", interrupted)
    with pytest.raises(KeyboardInterrupt):
        calibrate(config)
    database = tmp_path / "capture" / "work" / "matches.db"
    features = sfm.read_features(database)
    assert len(sfm.read_matches(database, features)) == 2
    monkeypatch.setattr(sfm, "match", real)
    monkeypatch.setattr(stage, "_solve_cameras", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        calibrate(config)
    assert len(sfm.read_matches(database, features)) == 3


def test_photographs_of_two_sizes_get_two_cameras(room, tmp_path):
    from catacaustics.images import read_image, resize

    for k in range(3):
        image = read_image(room / f"view_{k:02d}.jpg")
        write_image(tmp_path / "p" / f"{k}.jpg", resize(image, 240, 180) if k == 1 else image)
    photos, _ = sfm.prepare_photos(tmp_path / "p", {}, tmp_path / "c", tmp_path / "m", 1600)
    sfm.extract(photos, tmp_path / "c", None, tmp_path / "f.db", "SIMPLE_RADIAL")
    ids = sfm.read_features(tmp_path / "f.db").camera_ids
    assert ids[0] == ids[2] != ids[1]


def test_changed_inputs_run_a_stage_again_and_remove_its_old_output(tmp_path):
    output, runs = tmp_path / "out.txt", []

    def job() -> str:
        runs.append(output.exists())
        output.write_text("x")
        return "done"

    for inputs in (1, 1, 2):
        Stages(tmp_path).run("stage", inputs, [output], job)
    assert runs == [False, False]
    output.unlink()
    Stages(tmp_path).run("stage", 2, [output], job)
    assert len(runs) == 3


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_folder_with_too_few_photographs_is_refused(tmp_path, count):
    (tmp_path / "photos").mkdir()
    for k in range(count):
        write_image(tmp_path / "photos" / f"{k}.png", np.zeros((8, 8, 3)))
    with pytest.raises(UserError, match=r"holds (no|only) "):
        calibrate(CalibrateConfig(photos=tmp_path / "photos", capture=tmp_path / "c"))


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(UserError, match="nowhere is not a folder"):
        calibrate(CalibrateConfig(photos=tmp_path / "nowhere", capture=tmp_path / "c"))


@pytest.mark.parametrize("content", [b"", b"not a picture"])
def test_an_unreadable_photograph_is_named(tmp_path, content):
    for k in range(3):
        write_image(tmp_path / "photos" / f"{k}.png", np.zeros((8, 8, 3)))
    write_bytes(tmp_path / "photos" / "broken.jpg", content)
    with pytest.raises(UserError, match=r"broken\.jpg"):
        calibrate(CalibrateConfig(photos=tmp_path / "photos", capture=tmp_path / "c"))


def test_masks_of_other_photographs_are_refused(tmp_path):
    for k in range(3):
        write_image(tmp_path / "photos" / f"{k}.png", np.zeros((8, 8, 3)))
    write_image(tmp_path / "masks" / "ball" / "other.png", np.zeros((8, 8), bool))
    config = CalibrateConfig(photos=tmp_path / "photos", capture=tmp_path / "c", masks=tmp_path / "masks")
    with pytest.raises(UserError, match=r"None of the 1 masks"):
        calibrate(config)


def test_photographs_without_anything_in_common_end_in_one_clear_error(tmp_path):
    from room import texture

    for k in range(4):
        write_image(tmp_path / "photos" / f"{k}.png", texture(96, 100 + k))
    with pytest.raises(UserError, match=r"None of the 4 photographs could be placed|Only . of 4 photographs"):
        calibrate(CalibrateConfig(photos=tmp_path / "photos", capture=tmp_path / "c"))
    assert (tmp_path / "c" / "work" / "matches.db").is_file()


@pytest.mark.skipif("CATACAUSTICS_CAPTURES" not in os.environ, reason="CATACAUSTICS_CAPTURES is not set")
def test_the_mirror_ball_cameras_agree_with_the_curated_ones(tmp_path, monkeypatch):
    """Three near-identical cans misplace a third of the cameras in a plain run; here 32 of the curated 34 or more are
    within 2 % of their distance to the ball, without masks, and none is far off."""
    source = Path(os.environ["CATACAUSTICS_CAPTURES"]) / "mirror_ball"
    monkeypatch.setattr("catacaustics.capture.stereo.fuse_capture", no_stereo)
    calibrate(CalibrateConfig(photos=source / "images", capture=tmp_path))
    ours, reference = world_from_camera(tmp_path), world_from_camera(source)
    names = sorted(set(ours) & set(reference))
    result = compare(np.array([ours[n] for n in names]), np.array([reference[n] for n in names]))
    assert (result["position_errors"] < 0.02).sum() >= 32
    assert result["position_errors"].max() < 0.05
