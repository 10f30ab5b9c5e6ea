"""The command line: help, one clear message and status 2 for bad input, the main job end to end."""

import json
import os

import numpy as np
import pytest
from toy import make_toy_capture

from catacaustics import cli
from catacaustics.images import write_image

SMALL = [
    *(
        "--model",
        "sphere",
        "--iterations",
        "40",
        "--image-size",
        "64",
        "--primary-points",
        "2000",
        "--reflection-points",
        "200",
    ),
]


def test_help_lists_every_command_and_each_has_its_own_help(capsys):
    assert cli.main(["--help"]) == 0
    listing = capsys.readouterr().out
    for command in cli._COMMANDS:
        assert f"  {command} " in listing
        with pytest.raises(SystemExit) as stop:
            cli.main([*command.split(), "--help"])
        assert stop.value.code == 0
        assert command in capsys.readouterr().out


@pytest.mark.parametrize(
    ("said", "spins"), [({}, "10000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "ACTIVE"}, None)], ids=str
)
def test_threads_of_pytorch_sleep_soon_unless_the_environment_says_how_they_wait(monkeypatch, said, spins):
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.delenv(name, raising=False)
    for name, value in said.items():
        monkeypatch.setenv(name, value)
    cli.main(["--version"])
    assert os.environ.get("GOMP_SPINCOUNT") == spins


def test_an_unknown_command_is_named_and_the_known_ones_are_listed(capsys):
    assert cli.main(["recontsruct"]) == 2
    message = capsys.readouterr().err
    assert "no command 'recontsruct'" in message
    assert "reconstruct" in message


def test_a_group_of_commands_has_its_own_help_and_names_what_it_does_not_know(capsys):
    assert cli.main(["refract"]) == 0
    listing = capsys.readouterr().out
    assert "refract data" in listing
    assert "calibrate" not in listing
    assert cli.main(["refract", "dtaa"]) == 2
    assert "no command 'refract dtaa'" in capsys.readouterr().err


def empty_folder(tmp_path):
    (tmp_path / "photos").mkdir()


def zero_byte_photograph(tmp_path):
    (tmp_path / "photos").mkdir()
    for i in range(3):
        write_image(tmp_path / "photos" / f"{i}.jpg", np.random.default_rng(i).random((40, 60, 3)))
    (tmp_path / "photos" / "broken.jpg").touch()


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (lambda tmp_path: None, ["photos"]),
        (empty_folder, ["photos"]),
        (zero_byte_photograph, ["broken.jpg", "0 bytes"]),
    ],
)
def test_bad_photographs_end_in_one_message_that_says_what_to_do(tmp_path, capsys, prepare, words):
    prepare(tmp_path)
    status = cli.main(["reconstruct", str(tmp_path / "photos"), str(tmp_path / "out"), *SMALL])
    message = capsys.readouterr().err
    assert status == 2
    assert "Traceback" not in message
    assert "expected:" in message
    assert "what to do:" in message
    for word in words:
        assert word in message


def test_a_capture_that_was_cut_off_half_way_is_named(tmp_path, capsys):
    root = make_toy_capture(tmp_path / "capture", points=False)
    assert cli.main(["train", str(root), str(tmp_path / "run"), *SMALL]) == 2
    assert "points.ply" in capsys.readouterr().err
    (root / "images" / "view_03.png").unlink()
    assert cli.main(["train", str(root), str(tmp_path / "run"), *SMALL]) == 2
    assert "view_03.png" in capsys.readouterr().err
    (root / "sparse" / "0" / "images.bin").write_bytes(b"\x05")
    assert cli.main(["train", str(root), str(tmp_path / "run"), *SMALL]) == 2
    assert "incomplete or corrupt" in capsys.readouterr().err


def corner_only(mask):
    """A mask that shares no volume with the others."""
    spoiled = np.zeros_like(mask)
    spoiled[2:8, 2:8] = True
    return spoiled


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda mask: np.zeros_like(mask), ["view_02", "black"]),
        (lambda mask: np.ones_like(mask), ["view_02", "white"]),
        (lambda mask: mask[:20], ["view_02", "64 x 20"]),
        (corner_only, ["view_02"]),
    ],
)
def test_bad_masks_are_refused_with_the_view_to_repaint(tmp_path, capsys, spoil, words):
    root = make_toy_capture(tmp_path / "capture")
    from catacaustics.images import read_mask

    path = root / "masks" / "ball" / "view_02.png"
    write_image(path, spoil(read_mask(path)))
    assert cli.main(["train", str(root), str(tmp_path / "run"), *SMALL]) == 2
    message = capsys.readouterr().err
    for word in words:
        assert word in message


def test_reconstruct_takes_a_capture_to_its_report_and_keeps_finished_stages(tmp_path, capsys):
    """Views of 128 x 96: stereo needs some pixels to match."""
    root = make_toy_capture(tmp_path / "capture", points=False, width=128, height=96)
    command = ["reconstruct", str(root), str(tmp_path / "out"), *SMALL]
    assert cli.main(command) == 0
    run = tmp_path / "out" / "run"
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["mean"]["inside"]["psnr"] > 10
    assert "<html" in (run / "report.html").read_text().lower()
    assert (tmp_path / "out" / "capture" / "volumes" / "ball.json").is_file()
    scene = (run / "scene.safetensors").stat().st_mtime_ns
    capsys.readouterr()
    assert cli.main(command) == 0
    assert "finished already" in capsys.readouterr().out
    assert (run / "scene.safetensors").stat().st_mtime_ns == scene
    film = tmp_path / "film.mp4"
    assert cli.main(["render", str(run), str(film), "--width", "64", "--seconds", "0.5", "--fps", "8"]) == 0
    assert film.read_bytes()[4:8] == b"ftyp"
