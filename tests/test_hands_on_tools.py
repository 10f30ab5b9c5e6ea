"""The worked scripts of tools/ do what they say on a small run."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from toy import make_toy_capture, scene_of, write_run

from catacaustics.capture.dataset import open_capture
from catacaustics.images import read_image

TOOLS = Path(__file__).parents[1] / "tools"
sys.path.insert(0, str(TOOLS))

import check_hands_on  # noqa: E402
import clone_reflector  # noqa: E402
import edit_reflections  # noqa: E402
import export_scene  # noqa: E402
import stereo_pair  # noqa: E402
import track_reflections  # noqa: E402


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs of a mirror and of a rung that is none."""
    folder = tmp_path_factory.mktemp("runs")
    capture = open_capture(make_toy_capture(folder / "capture"))
    return {model: write_run(folder / model, capture, scene_of(capture, model)) for model in ("sphere", "static")}


def columns(path: Path, count: int) -> list[np.ndarray]:
    return np.split(read_image(path), count, 1)


def test_edits_stand_side_by_side_and_those_that_a_rung_does_not_allow_are_named(runs, tmp_path, capsys):
    settings = {"picture": tmp_path / "edit.png", "width": 64}
    edit_reflections.main(edit_reflections.Edit(runs["sphere"], **settings))
    pictures = columns(tmp_path / "edit.png", 5)
    for picture in pictures[1:]:
        assert np.abs(picture - pictures[0]).max() > 0.1
    edit_reflections.main(edit_reflections.Edit(runs["static"], **settings))
    assert len(columns(tmp_path / "edit.png", 3)) == 3
    told = capsys.readouterr().out
    assert "warp camera moved: " in told
    assert "other surroundings: " in told


def test_clones_stand_side_by_side(runs, tmp_path, capsys):
    clone_reflector.main(clone_reflector.Clone(runs["sphere"], tmp_path / "clone.png", width=64))
    pictures = columns(tmp_path / "clone.png", 4)
    for picture in pictures[1:]:
        assert np.abs(picture - pictures[0]).max() > 0.1
    clone_reflector.main(clone_reflector.Clone(runs["static"], tmp_path / "clone.png", width=64))
    assert len(columns(tmp_path / "clone.png", 3)) == 3
    assert "StaticWarp" in capsys.readouterr().out


def test_stereo_pairs_come_with_the_table_of_disparities(runs, tmp_path):
    stereo_pair.main(stereo_pair.Pair(runs["sphere"], tmp_path, width=96))
    table = json.loads((tmp_path / "disparity.json").read_text())["disparity"]
    high = [table[key]["high"] for key in ("1", "0.75", "0.5", "0.25", "0")]
    assert (np.diff(high) < 0).all()
    full, comfortable = (read_image(tmp_path / f"pair_{name}.jpg") for name in ("full", "comfortable"))
    assert full.shape == comfortable.shape == (72, 192, 3)
    assert read_image(tmp_path / "anaglyph.jpg").shape == (144, 96, 3)


def test_trails_are_drawn_where_points_went(runs, tmp_path, capsys):
    picture = tmp_path / "track.png"
    track_reflections.main(track_reflections.Follow(runs["sphere"], picture, count=3, frames=8, width=64))
    assert read_image(picture).shape == (48, 128, 3)
    assert "3 points" in capsys.readouterr().out


def test_an_exported_scene_looks_like_the_scene_without_reflections(runs, tmp_path, capsys):
    export_scene.main(export_scene.Export(runs["sphere"], tmp_path / "out", width=96))
    told = capsys.readouterr().out
    assert float(told.split("reflections: ")[1].split(" dB")[0]) > 30
    assert read_image(tmp_path / "out" / "gaussians.jpg").shape == (72, 192, 3)


def test_the_check_of_all_edits_finds_them_right(runs, tmp_path):
    """Clone and decoupled edits as on a trained scene; the toy has no truth for tracks."""
    settings = {"move": (0.5, -2.5, 0.5), "views": 1, "width": 96, "json": tmp_path / "hands_on.json"}
    check_hands_on.main(check_hands_on.Check(runs["sphere"], **settings))
    numbers = json.loads((tmp_path / "hands_on.json").read_text())
    assert numbers["decoupled_by_nothing"] == 0
    assert numbers["clone_not_moved"] < 1e-5
    assert min(numbers["clone_moved_psnr"]) > 40
    assert numbers["stereo"][0]["monotone"]


def test_the_scripts_are_short():
    for module in (clone_reflector, edit_reflections, export_scene, stereo_pair, track_reflections):
        assert len(Path(module.__file__).read_text().splitlines()) < 120
