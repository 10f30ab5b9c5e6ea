"""Do edits do what they say on a trained scene? Decoupled cameras, clones, stereo and tracks, in numbers.

    python tools/check_hands_on.py RUN --truth data_samples/ball --json hands_on.json

- an edit that decouples the reflections' camera by nothing, and a clone that is not moved: largest difference to the
  unedited views;
- a clone moved by d and seen from c against the original seen from c - d: PSNR inside the reflector;
- stereo: 95th percentile of the reflections' disparity for ever smaller warp separations, and of the surface;
- tracks along the held-out path, against truth in pixels.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from catacaustics.cameras import Camera
from catacaustics.capture.truth import truth_path
from catacaustics.editing import clone_reflector, decouple_reflections, reflector_index
from catacaustics.errors import UserError
from catacaustics.files import write_json
from catacaustics.metrics import psnr
from catacaustics.run import Run, open_run
from catacaustics.scene import Scene
from catacaustics.stereo import reflection_disparity, surface_disparity, usual_rig
from catacaustics.tracking import follow_points, spread_points, track_errors
from catacaustics.video import camera_path

_SEPARATIONS = (1.0, 0.75, 0.5, 0.25, 0.0)


@dataclass(frozen=True)
class Check:
    """Measure edits on a run.

    Args:
        run: folder that training wrote.
        truth: the path-traced capture with truth/; without it tracks are not measured.
        reflector: its name, where there are several.
        move: of the clone, in radii of the reflector, world axes.
        views: held-out views to look from.
        points: tracks.
        frames: steps along the held-out path.
        width: of the views in pixels.
        json: write the numbers to this file too.
    """

    run: Annotated[Path, tyro.conf.Positional]
    truth: Path | None = None
    reflector: str | None = None
    move: tuple[float, float, float] = (1.0, 2.5, 1.5)
    views: int = 4
    points: int = 40
    frames: int = 48
    width: int = 480
    json: Path | None = None


def largest_difference(one: Scene, other: Scene, cameras: list[Camera]) -> float:
    return max(float((one.render(c).rgb - other.render(c).rgb).abs().max()) for c in cameras)


def moved_clone(scene: Scene, index: int, shift: np.ndarray, cameras: list[Camera]) -> list[float]:
    """PSNR inside the reflector of the clone seen from c against the original seen from c - d."""
    cloned = clone_reflector(scene, index, shift, np.eye(3))
    values = []
    for camera in cameras:
        pose = camera.camera_from_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ shift
        inside = scene.volumes[index].scaled(0.97).project_mask(camera)
        here, there = (s.render(c).rgb.cpu().numpy() for s, c in ((scene, camera),
                       (cloned, replace(camera, camera_from_world=pose))))  # fmt: skip
        values.append(psnr(there[inside], here[inside]))
    return values


def tracks(run: Run, index: int, settings: Check, truth: Path) -> dict[str, Any]:
    view = next((v for v in run.capture.held_out if truth_path(truth, v.name).is_file()), None)
    if view is None:
        raise UserError(f"No held-out view has truth in {truth}.", "a path-traced capture", "correct --truth")
    path = camera_path(run.capture, "held-out", settings.frames, settings.width)
    cameras = [view.camera.resized(path[0].width, path[0].height), *path]
    points = spread_points(run.scene, index, cameras[0], settings.points)
    followed = follow_points(run.scene, index, points, cameras)
    errors = track_errors(run, index, followed, cameras, 0, view, truth)[1:]
    stuck = np.linalg.norm(followed.pixels - followed.pixels[0], axis=-1)[1:][np.isfinite(errors)]
    median, high = np.nanpercentile(errors, (50, 95))
    return {"points": len(points), "positions": int(np.isfinite(errors).sum()), "median": float(median),
            "percentile_95": float(high), "median_way": float(np.median(stuck))}  # fmt: skip


def main(check: Check) -> None:
    run = open_run(check.run)
    scene, index = run.scene, reflector_index(run.scene, check.reflector)
    shown = np.linspace(0, len(run.capture.held_out) - 1, check.views).round().astype(int)
    cameras = [run.capture.held_out[i].camera for i in shown]
    cameras = [c.resized(check.width, round(check.width * c.height / c.width)) for c in cameras]
    same = largest_difference(scene, decouple_reflections(scene, index, np.zeros(3)), cameras)
    still = largest_difference(scene, clone_reflector(scene, index, np.zeros(3), np.eye(3)), cameras)
    shift = scene.volumes[index].radius * np.array(check.move)
    likeness = moved_clone(scene, index, shift, cameras)
    print(f"decoupled by nothing: largest difference {same:.2g}")
    print(f"clone not moved: largest difference {still:.2g}")
    print(f"clone moved by {np.linalg.norm(shift):.2f}: {min(likeness):.1f} to {max(likeness):.1f} dB inside")
    numbers = {"decoupled_by_nothing": same, "clone_not_moved": still, "clone_moved_psnr": likeness, "stereo": []}
    for camera in cameras:
        rig = usual_rig(scene, camera)
        high = [reflection_disparity(scene, camera, rig._replace(warp=w)).high for w in _SEPARATIONS]
        surface = surface_disparity(scene, camera, rig._replace(warp=0.0)).high
        numbers["stereo"].append({"reflections": high, "surface": surface, "monotone": bool((np.diff(high) < 0).all())})
        print(f"stereo, 95 % of disparity: {', '.join(f'{d:.2f}' for d in high)} px; surface {surface:.2f} px")
    if check.truth is not None:
        numbers["tracks"] = tracks(run, index, check, check.truth)
        print("tracks: {points} points, {positions} positions, median {median:.2f} px, 95 % {percentile_95:.2f} px "
              "(median way {median_way:.0f} px)".format(**numbers["tracks"]))  # fmt: skip
    if check.json is not None:
        write_json(check.json, numbers)


if __name__ == "__main__":
    main(tyro.cli(Check))
