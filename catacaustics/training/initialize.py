"""The scene before training: clouds from multi-view stereo and from the surfaces of the reflection volumes."""

from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from catacaustics.capture.dataset import Capture
from catacaustics.config import SplatConfig, TrainConfig
from catacaustics.environment import EnvironmentMap
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.reflectors.warps import NeuralWarp, StaticWarp
from catacaustics.renderer import FEATURES, NeuralRenderer
from catacaustics.scene import PointParameters, Scene
from catacaustics.shapes import Float

INITIAL_OPACITY = 0.8
_SURFACE_SHARE = 0.3
"""Primary points on the reflectors' surfaces are at most this share of the cloud."""


class Seeds(NamedTuple):
    """Where a cloud's points start, in the order in which stages activate them."""

    positions: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    colors: Float[np.ndarray, "n 3"]
    rho: Float[np.ndarray, "n"]


def scene_extent(capture: Capture) -> float:
    """Radius of the training cameras about their mean: the unit of position learning rates."""
    centers = np.array([v.camera.center for v in capture.train])
    return float(max(np.linalg.norm(centers - centers.mean(0), axis=1).max() * 1.1, 1e-3))


def neighbor_footprints(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Squared radii so that neighbouring disks overlap: half the mean squared distance to 3 nearest neighbours.

    Outliers are capped at 16 times the median, so that a stray point does not cover half the image.
    """
    from scipy.spatial import cKDTree

    if len(positions) < 2:
        return np.full(len(positions), 1e-4, np.float32)
    k = min(4, len(positions))
    distances = cKDTree(positions).query(positions, k=k)[0][:, 1:]
    squared = 0.5 * (distances**2).mean(1)
    median = np.median(squared)
    return np.clip(squared, 1e-4 * median + 1e-16, 16 * median).astype(np.float32)


def mean_reflector_color(capture: Capture, volume: ReflectionVolume) -> Float[np.ndarray, "3"]:
    """Mean colour inside the projected volume over a few training views."""
    pixels = []
    for view in capture.train[:: max(1, len(capture.train) // 8)]:
        inside = capture.image(view)[volume.project_mask(view.camera)]
        if len(inside):
            pixels.append(inside.mean(0) / 255)
    return np.mean(pixels, axis=0).astype(np.float32) if pixels else np.full(3, 0.5, np.float32)


def primary_seeds(
    capture: Capture, volumes: list[ReflectionVolume], config: TrainConfig, rng: np.random.Generator
) -> Seeds:
    """Stereo points outside the reflectors, and points on the reflectors' surfaces, which carry rho, in random order.

    Stereo has no points on a mirror, but something must hide what is behind it.
    """
    cloud = capture.points()
    for volume in volumes:
        cloud = cloud.select(~volume.contains(cloud.positions.astype(np.float64)))
    if len(cloud) > config.primary_points:
        cloud = cloud.select(rng.choice(len(cloud), config.primary_points, replace=False))
    spacing2 = 2 * float(np.median(neighbor_footprints(cloud.positions))) if len(cloud) > 1 else 1e-4
    budget = int(_SURFACE_SHARE * config.primary_points)
    wanted = [int(v.area / spacing2) + 1 for v in volumes]
    shrink = min(1.0, budget / max(sum(wanted), 1))
    rho = 0.02 if config.warp == "none" else 0.9
    parts = [(cloud.positions, cloud.normals, cloud.colors, np.full(len(cloud), 0.02))]
    for volume, n in zip(volumes, wanted, strict=True):
        positions, normals = volume.sample_surface(max(int(n * shrink), 100), rng)
        color = mean_reflector_color(capture, volume)
        parts.append((positions, normals, np.broadcast_to(color, positions.shape), np.full(len(positions), rho)))
    columns = [np.concatenate(c).astype(np.float32) for c in zip(*parts, strict=True)]
    order = rng.permutation(len(columns[0]))
    return Seeds(*(c[order] for c in columns))


def reflection_seeds(
    capture: Capture, volume: ReflectionVolume, config: TrainConfig, rng: np.random.Generator
) -> Seeds:
    """Random points on the surface of a reflection volume (paper section 4.2)."""
    positions, normals = volume.sample_surface(config.reflection_points, rng)
    color = np.broadcast_to(mean_reflector_color(capture, volume), positions.shape)
    columns = (positions, normals, color, np.zeros(len(positions)))
    return Seeds(*(np.ascontiguousarray(c, np.float32) for c in columns))


def start_cloud(seeds: Seeds, count: int, primary: bool) -> PointParameters:
    """The first `count` seeds as trainable points."""
    positions = seeds.positions[:count]
    features = torch.zeros(len(positions), FEATURES)
    features[:, :3] = torch.from_numpy(seeds.colors[:count])
    return PointParameters(
        torch.from_numpy(positions.copy()),
        torch.from_numpy(seeds.normals[:count].copy()),
        torch.from_numpy(neighbor_footprints(positions)),
        torch.full((len(positions),), INITIAL_OPACITY),
        features,
        torch.from_numpy(seeds.rho[:count].copy()) if primary else None,
        trainable_geometry=primary,
    )


def grow_cloud(cloud: PointParameters, seeds: Seeds, count: int) -> PointParameters:
    """Activate seeds up to `count`. A new point takes what its nearest trained point has learned (the change from that
    point's start), and every footprint shrinks with the spacing."""
    from scipy.spatial import cKDTree

    old = len(cloud)
    if count <= old:
        return cloud
    device = cloud.positions.device
    grown = start_cloud(seeds, count, cloud.rho_logits is not None).to(device)
    before = start_cloud(seeds, old, cloud.rho_logits is not None).to(device)
    nearest = cKDTree(seeds.positions[:old]).query(seeds.positions[old:count])[1]
    source = torch.cat([torch.arange(old), torch.from_numpy(nearest)]).to(device)
    with torch.no_grad():
        for name, parameter in grown.named_parameters():
            learned, start = cloud.get_parameter(name), before.get_parameter(name)
            if parameter.requires_grad and name not in ("positions", "normals"):
                parameter += (learned - start)[source]
    return grown


def make_warp(config: TrainConfig, capture: Capture, volume: ReflectionVolume) -> nn.Module:
    if config.warp == "static":
        return StaticWarp()
    corners = np.concatenate([volume.vertices, [v.camera.center for v in capture.train]])
    low, high = (torch.from_numpy(c.astype(np.float32)) for c in (corners.min(0), corners.max(0)))
    return NeuralWarp(low, high, config.warp_layers, config.warp_width)


def initial_scene(
    capture: Capture, volumes: list[ReflectionVolume], seeds: list[Seeds], share: float, config: TrainConfig
) -> Scene:
    """A scene with the first `share` of every cloud's seeds: seeds[0] primary, then one per reflector."""
    torch.manual_seed(config.seed)
    counts = [stage_count(s, share) for s in seeds]
    primary = start_cloud(seeds[0], counts[0], primary=True)
    environment = None
    if config.environment_width:
        environment = EnvironmentMap(config.environment_width, max(1, round(0.4 * config.environment_width)))
    renderer = NeuralRenderer(config.renderer_width, config.renderer_layers)
    reflective = [] if config.warp == "none" else volumes
    clouds = [start_cloud(s, n, primary=False) for s, n in zip(seeds[1:], counts[1:], strict=True)]
    warps = [make_warp(config, capture, v) for v in reflective]
    near = 1e-2 * scene_extent(capture)
    return Scene(primary, clouds, warps, reflective, environment, renderer, SplatConfig(near=near, alpha_min=1 / 255))


def stage_count(seeds: Seeds, share: float) -> int:
    """How many of the seeds a stage uses; never none."""
    return min(len(seeds.positions), max(int(len(seeds.positions) * share), 100))
