"""A tiny capture that tests make on the spot: a coloured floor and a ball that shows one flat colour, 10 views; and
scenes of it that training has not touched."""

import functools
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from catacaustics.cameras import Camera, pixel_centers
from catacaustics.capture.dataset import Capture, View, open_capture, write_capture
from catacaustics.config import TrainConfig
from catacaustics.files import write_json
from catacaustics.geometry import look_at
from catacaustics.images import write_image
from catacaustics.points import PointCloud, write_ply
from catacaustics.reflectors.volume import build_volume
from catacaustics.scene import Scene
from catacaustics.splatting import splat_points
from catacaustics.training import initialize
from catacaustics.training.initialize import named_reflectors, primary_seeds, reflection_seeds, start_warps

BALL_CENTER = np.array([0.0, -0.35, 0.0])
BALL_RADIUS = 0.35
BALL_COLOR = np.array([0.9, 0.8, 0.2])


def toy_cameras(count: int, width: int, height: int) -> list[Camera]:
    cameras = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        eye = np.array([2.2 * np.cos(angle), -1.2 - 0.1 * np.sin(3 * angle), 2.2 * np.sin(angle)])
        pose = look_at(eye, BALL_CENTER, np.array([0.0, -1.0, 0.0]))
        cameras.append(Camera(width, height, 1.1 * width, 1.1 * width, width / 2, height / 2, pose))
    return cameras


def ball_mask(camera: Camera) -> np.ndarray:
    """Pixels whose ray meets the ball, in closed form."""
    rays = camera.ray_directions(pixel_centers(camera.viewport))
    offset = camera.center - BALL_CENTER
    a, b, c = (rays**2).sum(-1), rays @ offset, offset @ offset - BALL_RADIUS**2
    return b**2 - a * c > 0


def floor_cloud() -> PointCloud:
    """Points on y = 0 in four colours that stripe both ways."""
    grid = np.linspace(-1.5, 1.5, 61)
    x, z = (g.ravel() for g in np.meshgrid(grid, grid))
    colors = np.stack([0.5 + 0.4 * np.sin(3 * x), 0.5 + 0.4 * np.cos(4 * z), 0.5 + 0.3 * np.sin(x + 2 * z)], -1)
    normals = np.broadcast_to([0.0, -1.0, 0.0], (len(x), 3))
    return PointCloud(*(np.float32(a) for a in (np.stack([x, 0 * x, z], -1), normals, colors)))


def make_toy_capture(root: Path, masks: bool = True, points: bool = True, width: int = 64, height: int = 48) -> Path:
    cloud = floor_cloud()
    tensors = [torch.from_numpy(a) for a in (cloud.positions, cloud.normals, cloud.colors)]
    footprints = torch.full((len(cloud),), 0.04**2)
    views = []
    for i, camera in enumerate(toy_cameras(10, width, height)):
        opacities = torch.full((len(cloud),), 0.95)
        out = splat_points(tensors[0], tensors[1], footprints, opacities, tensors[2], camera)
        image = out.image.numpy() + 0.3 * out.transmittance.numpy()[..., None]
        mask = ball_mask(camera)
        image = np.where(mask[..., None], BALL_COLOR, image)
        view = View(f"view_{i:02d}.png", camera)
        write_image(root / "images" / view.name, image)
        if masks:
            write_image(root / "masks" / "ball" / view.name, mask)
        views.append(view)
    names = [v.name for v in views]
    write_capture(root, views, {"train": names[:8], "held_out": names[8:]})
    if points:
        write_ply(root / "points.ply", cloud)
    open_capture(root)
    return root


@functools.cache  # nothing that is tested changes a scene
def scene_of(capture: Capture, model: str) -> Scene:
    """The scene from which training would start, opaque, with reflections in all colours."""
    config = TrainConfig(
        capture.root,
        capture.root / "run",
        model=(model,),
        primary_points=6000,
        reflection_points=800,
        environment_width=20,
        warp_width=16,
    )
    reflectors = named_reflectors([build_volume(capture, "ball")], config.model)
    rng = np.random.default_rng(0)
    volume, warps = reflectors[0].volume, start_warps(capture, reflectors, config)
    seeds = [
        primary_seeds(capture, reflectors, config.primary_points, rng),
        reflection_seeds(capture, volume, warps[0], config.reflection_points, rng),
    ]
    with mock.patch.object(initialize, "start_shapes"):  # fitting shapes to photographs takes seconds
        scene = initialize.initial_scene(capture, [volume], warps, seeds, 1.0, config)
    with torch.no_grad():
        scene.primary.opacity_logits.fill_(8.0)  # opaque, so that nothing shines through
        scene.reflections[0].features[:, :3] = torch.rand(800, 3, generator=torch.Generator().manual_seed(0))
    return scene


def write_run(folder: Path, capture: Capture, scene: Scene) -> Path:
    """A scene as the run of a finished training."""
    scene.save(folder / "scene.safetensors")
    write_json(folder / "config.json", {"capture": str(capture.root), "image_size": 64})
    return folder
