"""How far does training bend before it breaks? Seeds, wrong volumes and noisy poses, at low resolution.

    python tools/stress_training.py demo/capture --json stress.json

Trains a capture's reflector many times: with 20 seeds, with its reflection volume 30 % too large, shifted by 20 % of
its radius, and with noise of 1 pixel in the camera poses; prints the PSNR inside the true reflector on held-out views.
"""

import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from catacaustics.capture.dataset import Capture, View, open_capture
from catacaustics.catacaustic import displayed_points
from catacaustics.config import Model, TrainConfig
from catacaustics.files import write_json
from catacaustics.geometry import rigid
from catacaustics.reflectors.volume import ReflectionVolume, build_volume
from catacaustics.scene import Scene
from catacaustics.training.corrections import align_view
from catacaustics.training.initialize import named_reflectors, scene_extent
from catacaustics.training.loop import fit
from catacaustics.training.photographs import photograph, scaled_camera


@dataclass(frozen=True)
class Stress:
    """Train under adverse conditions.

    Args:
        capture: folder made by `catacaustics calibrate`.
        model: rung of the warp.
        seeds: number of seeds.
        iterations: steps of each training.
        image_size: longer side of the photographs.
        refine_poses: learn pose corrections in the runs with noisy poses.
        json: write the results to this file too.
    """

    capture: Annotated[Path, tyro.conf.Positional]
    model: Model = "sphere"
    seeds: int = 20
    iterations: int = 800
    image_size: int = 160
    refine_poses: bool = True
    json: Path | None = None


class Run(NamedTuple):
    """One training: on which capture and volume, with which seed, and whether it learns pose corrections."""

    capture: Capture
    volume: ReflectionVolume
    seed: int = 0
    poses: bool = False


def shifted_volume(volume: ReflectionVolume, shift: np.ndarray) -> ReflectionVolume:
    planes = volume.halfspaces.copy()
    planes[:, 3] -= planes[:, :3] @ shift
    return ReflectionVolume(volume.name, planes, volume.vertices + shift, volume.faces)


def noisy_poses(capture: Capture, pixels: float, rng: np.random.Generator) -> Capture:
    """Training cameras turned and displaced at random, each moving the picture by about `pixels` of a photograph."""

    def disturbed(view: View) -> View:
        angle = pixels / view.camera.fx / np.sqrt(2)
        rotation = Rotation.from_rotvec(rng.standard_normal(3) * angle).as_matrix()
        shift = rng.standard_normal(3) * angle * scene_extent(capture)
        moved = replace(view.camera, camera_from_world=rigid(rotation, shift) @ view.camera.camera_from_world)
        return View(view.name, moved)

    return replace(capture, train=[disturbed(v) for v in capture.train])


def score(scene: Scene, capture: Capture, volume: ReflectionVolume, image_size: int, align: bool) -> float:
    """Mean PSNR inside the true volume on the held-out views."""
    import torch

    from catacaustics.metrics import psnr

    values = []
    for view in capture.held_out:
        camera = scaled_camera(view.camera, image_size, 1.0)
        photo = photograph(capture, view, camera)
        if align:
            aligned = align_view(scene, camera, torch.from_numpy(photo), True, False, scene_extent(capture))
            image = aligned.render(scene, camera).numpy()
        else:
            image = scene.render(camera).rgb.numpy()
        mask = volume.project_mask(camera)
        values.append(psnr(image[mask], photo[mask]))
    return float(np.mean(values))


def strayed(scene: Scene, capture: Capture) -> float:
    """Share of the reflection points that are shown, but nowhere in the outline of their volume: from the middle
    training view, with a margin of a quarter of the volume's radius."""
    camera = capture.train[len(capture.train) // 2].camera
    shown, _ = displayed_points(scene, 0, camera)
    wide = scene.volumes[0].scaled(1.25).project_mask(camera)
    pixels, depth = camera.project(shown)
    cells = np.floor(pixels).astype(int)
    inside = (depth > 0) & (cells >= 0).all(1) & (cells < [camera.width, camera.height]).all(1)
    cells = np.where(inside[:, None], cells, 0)
    return float(1 - (inside & wide[cells[:, 1], cells[:, 0]]).mean())


def main(config: Stress) -> None:
    capture = open_capture(config.capture)
    volume = build_volume(capture, capture.reflectors[0])
    rng = np.random.default_rng(0)
    direction = rng.standard_normal(3)
    direction *= 0.2 * volume.radius / np.linalg.norm(direction)
    runs = {f"seed {i}": Run(capture, volume, seed=i) for i in range(config.seeds)}
    runs["volume 30 % too large"] = Run(capture, volume.scaled(1.3))
    runs["volume shifted by 20 %"] = Run(capture, shifted_volume(volume, direction))
    noisy = noisy_poses(capture, 1.0, rng)
    runs["poses noisy by 1 px"] = Run(noisy, volume)
    if config.refine_poses:
        runs["poses noisy by 1 px, refined"] = Run(noisy, volume, poses=True)
    results = {}
    for name, run in runs.items():
        folder = Path(tempfile.mkdtemp(prefix="stress-"))
        train = TrainConfig(
            config.capture,
            folder,
            model=(config.model,),
            iterations=config.iterations,
            image_size=config.image_size,
            patch=config.image_size,
            environment_width=200,
            seed=run.seed,
            refine_poses=run.poses,
        )
        scene = fit(run.capture, named_reflectors([run.volume], train.model), train)
        shutil.rmtree(folder)
        results[name] = {"inside": score(scene, capture, volume, config.image_size, align=run.poses)}
        results[name]["strayed"] = strayed(scene, capture)
        shape = getattr(scene.warps[0], "shape", None)
        if shape is not None:
            center, axes = shape()
            results[name]["radius"] = float(axes.detach().norm(dim=0).mean())
            results[name]["center"] = center.detach().tolist()
        inside, away = results[name]["inside"], 100 * results[name]["strayed"]
        print(f"{name:<32}{inside:7.2f} dB, {away:.1f} % of the points astray", flush=True)
    seeds = [results[f"seed {i}"]["inside"] for i in range(config.seeds)]
    print(f"{config.seeds} seeds: median {np.median(seeds):.2f} dB, from {min(seeds):.2f} to {max(seeds):.2f}")
    if config.json is not None:
        write_json(config.json, results)


if __name__ == "__main__":
    main(tyro.cli(Stress))
