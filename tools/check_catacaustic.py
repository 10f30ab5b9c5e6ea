"""Do a trained scene's reflections move as optics says? Against a sphere's catacaustics and against path-traced truth.

    python tools/check_catacaustic.py RUN [RUN ...] --figure catacaustic.png --json catacaustic.json

For every run on a path-traced capture: the angle between displayed and true directions of mirrored things (mean,
median, 95th percentile). Where the reflector is a sphere, also for single points: the catacaustic of what a reflection
point stands for, over the cameras of the held-out path, beside where the warp displays it; drawn in plan view.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro

from catacaustics.cameras import interpolate_path
from catacaustics.capture.dataset import Capture
from catacaustics.capture.truth import read_reflectors, read_truth, truth_path
from catacaustics.catacaustic import caustic_errors, displayed_points, flow_error, nearest_image, sphere_caustic
from catacaustics.errors import UserError
from catacaustics.files import write_json
from catacaustics.run import Run, open_run
from catacaustics.scene import Scene

_POINTS = 40
"""Reflection points that are compared with catacaustics."""


@dataclass(frozen=True)
class Check:
    """Compare displayed reflections with truth.

    Args:
        runs: folders of finished runs on path-traced captures.
        truth: the capture with ground truth, where the runs' capture is a calibrated copy without.
        figure: PNG to draw.
        json: write the numbers to this file too.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    truth: Path | None = None
    figure: Path | None = None
    json: Path | None = None


def followed_points(scene: Scene, capture: Capture) -> tuple[np.ndarray, np.ndarray]:
    """Indices of reflection points and the world positions that they stand for, from one training view with truth."""
    view = next(v for v in capture.train if truth_path(capture.root, v.name).is_file())
    source = read_truth(capture.root, view.name).source
    shown, rows = displayed_points(scene, 0, view.camera)
    pixels, depth = view.camera.project(shown)
    cells = np.floor(pixels).astype(int)
    inside = (depth > 0) & (cells >= 0).all(1) & (cells < source.shape[1::-1]).all(1)
    index = np.flatnonzero(inside)
    found = source[cells[index, 1], cells[index, 0]]
    usable = np.isfinite(found).all(1)
    index, found = index[usable], found[usable]
    pick = np.random.default_rng(0).permutation(len(index))[:_POINTS]
    return rows[index[pick]], found[pick]


def against_caustics(run: Run, capture: Capture, sphere: dict[str, Any]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Angles in degrees over points and cameras; and, for three points, catacaustic and displayed positions (n, 6)."""
    center, radius = torch.tensor(sphere["center"], dtype=torch.float32), float(sphere["radius"])
    path = interpolate_path([v.camera for v in capture.held_out], 24)
    cameras = torch.from_numpy(np.array([c.center for c in path], np.float32))
    index, sources = followed_points(run.scene, capture)
    warp, points = run.scene.warps[0], run.scene.reflections[0].positions.detach()
    errors, curves = [], []
    for i, source in zip(index.tolist(), torch.from_numpy(sources.astype(np.float32)), strict=True):
        errors.append(caustic_errors(warp, points[i], source, center, radius, cameras))
        if len(curves) < 3:
            places = [sphere_caustic(source, center, radius, c) for c in cameras]
            shown = np.array(
                [nearest_image(warp, points[i], c, t).numpy() for c, t in zip(cameras, places, strict=True)]
            )
            true = np.array([t.numpy() for t in places])
            # Only the direction is seen: put the displayed point at the catacaustic's distance.
            eyes = cameras.numpy()
            ray = (shown - eyes) / np.linalg.norm(shown - eyes, axis=1, keepdims=True)
            curves.append(np.c_[true, eyes + ray * np.linalg.norm(true - eyes, axis=1, keepdims=True)])
    angles = np.concatenate(errors)
    return angles[np.isfinite(angles)], curves


def draw(path: Path, sphere: dict[str, Any], curves: dict[str, list[np.ndarray]]) -> None:
    """Plan view of the sphere: catacaustics in grey, what each run displays in colour."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5 * len(curves), 5.2), layout="constrained")
    axes = figure.subplots(1, len(curves), squeeze=False)[0]
    x, y, _ = sphere["center"]
    for ax, (name, lines) in zip(axes, curves.items(), strict=True):
        turn = np.linspace(0, 2 * np.pi, 200)
        ax.plot(x + sphere["radius"] * np.cos(turn), y + sphere["radius"] * np.sin(turn), color="0.6", linewidth=1)
        for i, line in enumerate(lines):
            ax.plot(line[:, 0], line[:, 1], color="0.25", linewidth=3, label="catacaustic" if i == 0 else None)
            ax.plot(line[:, 3], line[:, 4], "o-", markersize=3, linewidth=1, label=f"displayed, point {i + 1}")
        ax.set_title(name)
        ax.set_aspect("equal")
        ax.legend(fontsize=8, loc="lower right")
        ax.set_xlabel("x (m)")
        ax.set_ylabel("y (m)")
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_png(path)


def main(check: Check) -> None:
    numbers, curves, sphere = {}, {}, None
    for folder in check.runs:
        run = open_run(folder, check.truth, "cpu")
        capture = run.capture
        flow = flow_error(run.scene, capture)
        if flow is None:
            raise UserError(
                f"{folder} has no reflections or no ground truth.",
                "a run with a reflector on a path-traced capture",
                "name the capture with ground truth by --truth",
            )
        numbers[str(folder)] = {"flow": flow._asdict()}
        print(f"{folder}: flow mean {flow.mean:.2f}, median {flow.median:.2f}, 95 % {flow.percentile_95:.2f} degrees "
              f"({flow.samples} samples; stuck to the surface: median {flow.static:.2f})")  # fmt: skip
        geometry = read_reflectors(capture.root)[run.scene.volumes[0].name]
        if geometry["type"] == "sphere":
            sphere = geometry
            errors, curves[folder.name] = against_caustics(run, capture, geometry)
            numbers[str(folder)]["catacaustic"] = {
                "median": float(np.median(errors)),
                "percentile_95": float(np.percentile(errors, 95)),
            }
            print(f"{folder}: from the catacaustic, median {np.median(errors):.2f}, "
                  f"95 % {np.percentile(errors, 95):.2f} degrees")  # fmt: skip
    if check.figure is not None and sphere is not None:
        draw(check.figure, sphere, curves)
    if check.json is not None:
        write_json(check.json, numbers)


if __name__ == "__main__":
    main(tyro.cli(Check))
