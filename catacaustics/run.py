"""The folder of a training run: config.json, scene.safetensors, metrics.jsonl and checkpoints."""

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch

from catacaustics.capture.dataset import Capture, View, open_capture
from catacaustics.errors import UserError
from catacaustics.files import read_json
from catacaustics.scene import Scene


class Run(NamedTuple):
    """A finished run: its folder, the scene, the capture it was trained on and training's config.json."""

    folder: Path
    scene: Scene
    capture: Capture
    config: dict[str, Any]


def named_view(capture: Capture, name: str | None) -> View:
    """A view by name; without one the first held-out view, or the first training view where none is held out.

    Raises:
        UserError: no view of that name.
    """
    if name is None:
        return [*capture.held_out, *capture.train][0]
    views = {v.name: v for v in capture.views}
    if name not in views:
        few = sorted(views)[:6]
        raise UserError(
            f"{capture.root} has no view {name}.",
            f"one of {len(views)} names: {', '.join(few)}{' ...' if len(views) > len(few) else ''}",
            "name it as its file below images/",
        )
    return views[name]


def scene_file(folder: Path, unfinished: bool = False) -> Path:
    """The file of a run's scene; where training has not finished and `unfinished` is allowed, its last checkpoint."""
    path, checkpoint = Path(folder) / "scene.safetensors", Path(folder) / "checkpoint.safetensors"
    return checkpoint if unfinished and checkpoint.is_file() and not path.is_file() else path


def open_run(folder: Path, capture: Path | None = None, device: str = "auto", unfinished: bool = False) -> Run:
    """Open a run's scene and capture.

    Args:
        capture: the capture's folder, where it is not the one that config.json names.
        device: "cpu", "cuda", or "auto": the GPU if there is one.
        unfinished: take the last checkpoint where training has not finished.

    Raises:
        UserError: training has not finished, its config.json is missing or damaged, or the capture is gone.
    """
    folder = Path(folder)
    path = scene_file(folder, unfinished)
    if not path.is_file():
        started = (folder / "checkpoint.safetensors").is_file()
        raise UserError(
            f"There is no scene {path}" + (", only a checkpoint: training has not finished." if started else "."),
            "the folder of a finished training run",
            "go on with `catacaustics train ... --resume`"
            if started
            else "run `catacaustics train`, or check the path",
        )
    config = read_json(folder / "config.json")
    if not isinstance(config, dict) or not isinstance(config.get("image_size"), int) or "capture" not in config:
        raise UserError(
            f"{folder / 'config.json'} does not tell the capture and image_size of the training.",
            "the file that training wrote",
            "restore it from a copy, or train again",
        )
    root = Path(capture) if capture is not None else Path(config["capture"])
    if not root.is_dir():
        noted = "" if capture is not None else f", which {folder / 'config.json'} names"
        raise UserError(
            f"There is no capture {root.absolute()}{noted}.",
            "the calibrated capture that the scene was trained on",
            "give its folder with --capture",
        )
    return Run(folder, Scene.load(path, choose_device(device)), open_capture(root), config)


def choose_device(name: str) -> torch.device:
    """The device of a configuration: "cpu", "cuda", or "auto": the GPU if there is one.

    Raises:
        UserError: cuda is wanted and there is none.
    """
    automatic = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and automatic == "cpu":
        raise UserError("There is no GPU that PyTorch can use.", "a CUDA device", "leave --device at auto, or take cpu")
    return torch.device(automatic if name == "auto" else name)


def clock_of(name: str) -> Callable[[], float]:
    """Seconds as a configuration's `clock` wants them: "wall", or "cpu": processor time of this process."""
    return time.monotonic if name == "wall" else time.process_time


def read_log(folder: Path) -> tuple[list[dict[str, Any]], int]:
    """Rows of a run's metrics.jsonl and the number of unreadable lines, which are skipped (training was cut off there).

    A missing file is an empty log.
    """
    path = Path(folder) / "metrics.jsonl"
    rows, skipped = [], 0
    for line in path.read_text(errors="replace").splitlines() if path.is_file() else []:
        try:
            row = json.loads(line)
        except json.JSONDecodeError:
            row = None
        if isinstance(row, dict) and isinstance(row.get("seconds"), int | float) and math.isfinite(row["seconds"]):
            rows.append(row)
        elif line.strip():
            skipped += 1
    return rows, skipped
