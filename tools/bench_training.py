"""Time steps of a training, and a rendered view, with native kernels and without.

    native              all kernels that this machine has
    PyTorch splatter    the splatter in PyTorch, all else native
    PyTorch             everything in PyTorch, as where there is no compiler

A finished run is trained on, in a copy, from its last checkpoint: full resolution, all points. The variants take turns,
step by step, in one process; times are medians, of the whole step and of its largest parts.

    GOMP_SPINCOUNT=10000 python tools/bench_training.py demo/run --json bench.json

The variable is what the command line sets (catacaustics/threads.py).
"""

import argparse
import functools
import json
import os
import shutil
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import torch

from catacaustics import scene as scenes
from catacaustics.config import TrainConfig
from catacaustics.environment import EnvironmentMap
from catacaustics.files import write_json
from catacaustics.kernels import find_library
from catacaustics.reflectors.volume import build_volume
from catacaustics.renderer import NeuralRenderer
from catacaustics.run import open_run
from catacaustics.scene import Scene
from catacaustics.splatting import splat_points
from catacaustics.training.initialize import named_reflectors
from catacaustics.training.loop import fit
from catacaustics.training.optimizer import RowAdam
from catacaustics.training.photographs import scaled_camera

VARIANTS = ("native", "PyTorch splatter", "PyTorch")
PARTS = {
    "which points a view can show": (scenes, "points_in_view"),
    "reflection points and their images": (Scene, "reflection_disks"),
    "environment map, forward": (EnvironmentMap, "forward"),
    "networks, forward": (NeuralRenderer, "forward"),
    "backward": (torch.Tensor, "backward"),
    "Adam": (RowAdam, "step"),
}


def choose(variant: str) -> None:
    """From now on, compute in this way."""
    os.environ["CATACAUSTICS_BACKEND"] = "reference" if variant == "PyTorch" else "auto"
    in_pytorch = functools.partial(splat_points, backend="reference")
    scenes.splat_points = splat_points if variant == "native" else in_pytorch


def timed(function: Callable, spent: dict[str, float], part: str) -> Callable:
    """The function, which adds the time of every call to spent[part]."""

    @functools.wraps(function)
    def call(*arguments: object, **named: object) -> object:
        start = time.perf_counter()
        try:
            return function(*arguments, **named)
        finally:
            spent[part] += time.perf_counter() - start

    return call


def step_times(run: Path, copy: Path, steps: int) -> tuple[dict[str, dict[str, list[float]]], Scene, TrainConfig]:
    """Seconds of steps and of their parts by variant, after every photograph has been read once; the scene, and the
    settings."""
    opened = open_run(run)
    shutil.copy(run / "checkpoint.safetensors", copy / "checkpoint.safetensors")
    known = {f.name for f in fields(TrainConfig)}
    settings = {k: v for k, v in opened.config.items() if k in known}
    warm = len(opened.capture.train) + 10
    done = json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])["step"]
    last = done + warm + len(VARIANTS) * steps + 10
    # Densification belongs to no variant.
    settings |= {"run": copy, "resume": True, "minutes": None, "iterations": last, "densifications": 0}
    settings["model"] = tuple(settings["model"])
    config = TrainConfig(**settings)
    times: dict[str, dict[str, list[float]]] = {variant: defaultdict(list) for variant in VARIANTS}
    state = {"step": 0, "before": 0.0}
    spent: dict[str, float] = defaultdict(float)
    for part, (owner, name) in PARTS.items():
        setattr(owner, name, timed(getattr(owner, name), spent, part))

    def watch(_: Scene) -> None:
        now, index = time.perf_counter(), state["step"] - warm
        if index > 0:
            own = times[VARIANTS[(index - 1) % len(VARIANTS)]]
            own["step"].append(now - state["before"])
            for part in PARTS:
                own[part].append(spent[part])
        spent.clear()
        choose(VARIANTS[max(index, 0) % len(VARIANTS)])
        state["step"] += 1
        state["before"] = time.perf_counter()

    volumes = [build_volume(opened.capture, name) for name in opened.capture.reflectors]
    return times, fit(opened.capture, named_reflectors(volumes, config.model), config, watch=watch), config


def render_times(scene: Scene, run: Path, image_size: int, runs: int) -> dict[str, list[float]]:
    """Seconds to render a held-out view with all its layers, by variant."""
    view = open_run(run).capture.held_out[0]
    camera = scaled_camera(view.camera, image_size, 1.0)
    times: dict[str, list[float]] = {variant: [] for variant in VARIANTS}
    for turn in range(runs + 1):
        for variant in VARIANTS:
            choose(variant)
            start = time.perf_counter()
            scene.render(camera)
            if turn:
                times[variant].append(time.perf_counter() - start)
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--steps", type=int, default=40, help="of each variant")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--json", type=Path, help="file to write all figures to")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    found = find_library("cpu")
    header = {"threads": options.threads, "cpu": found.library.description if found.library else found.problem}
    with tempfile.TemporaryDirectory() as folder:
        steps, scene, config = step_times(options.run, Path(folder), options.steps)
    renders = render_times(scene, options.run, config.image_size, 5)
    results = {}
    print(f"{'ms':<36}" + "".join(f"{variant:>22}" for variant in VARIANTS))
    for name in ("step", *PARTS, "view"):
        medians = {v: statistics.median(renders[v] if name == "view" else steps[v][name]) for v in VARIANTS}
        results[name] = medians
        cells = (f"{1000 * value:13.1f} ({value / medians['native']:5.2f} x)" for value in medians.values())
        print(f"{name:<36}" + "".join(f"{cell:>22}" for cell in cells))
    if options.json:
        write_json(options.json, {**header, **results})


if __name__ == "__main__":
    main()
