"""The scene before training: clouds from multi-view stereo and from the surfaces of the reflection volumes."""

from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from catacaustics.cameras import up_direction
from catacaustics.capture.dataset import Capture
from catacaustics.config import TrainConfig
from catacaustics.environment import EnvironmentMap
from catacaustics.errors import UserError
from catacaustics.reflectors.fit import fit_bowl, fit_ellipsoid, fit_plane, fit_sphere, surroundings
from catacaustics.reflectors.revolution import Revolution
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.reflectors.warps import (
    NeuralWarp,
    PlaneWarp,
    QuadricNeuralWarp,
    QuadricWarp,
    RevolutionWarp,
    StaticWarp,
    learns_positions,
)
from catacaustics.renderer import FEATURES, NeuralRenderer
from catacaustics.scene import PointParameters, Scene
from catacaustics.shapes import Float
from catacaustics.splatting.config import SplatConfig
from catacaustics.training.mirrors import hull_of, start_shapes, turned_body_of
from catacaustics.training.photographs import photograph, scaled_camera

INITIAL_OPACITY = 0.8
_SHAPE_SHARE = 1 / 6
"""Of the clouds, for the fits: what sparser ones show is a blur that prefers flat mirrors."""
_PLAIN_SHARE = 0.75
"""Of a flat mirror's sources, points of the stereo cloud as they are; the rest is spread over directions."""
_SURFACE_SHARE = 0.3
"""Primary points on the reflectors' surfaces are at most this share of the cloud."""


class Seeds(NamedTuple):
    """Where a cloud's points start, in the order in which stages activate them."""

    positions: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    colors: Float[np.ndarray, "n 3"]
    rho: Float[np.ndarray, "n"]


class Reflector(NamedTuple):
    """A reflection volume and the rung of the ladder that models it (config.Model, but not auto)."""

    volume: ReflectionVolume
    model: str


def named_reflectors(volumes: list[ReflectionVolume], models: tuple[str, ...]) -> list[Reflector]:
    """Each volume with its model: one name counts for all.

    Raises:
        UserError: the number of names is neither 1 nor that of the volumes.
    """
    if len(models) not in (1, len(volumes)) and volumes:
        raise UserError(
            f"{len(models)} models are named for {len(volumes)} reflectors.",
            "one for all, or one for each of " + ", ".join(v.name for v in volumes),
            "change --model",
        )
    names = models * len(volumes) if len(models) == 1 else models
    return [Reflector(volume, name) for volume, name in zip(volumes, names, strict=False)]


def scene_extent(capture: Capture) -> float:
    """Radius of the training cameras about their mean: the unit of position learning rates."""
    centers = np.array([v.camera.center for v in capture.train])
    return float(max(np.linalg.norm(centers - centers.mean(0), axis=1).max() * 1.1, 1e-3))


def neighbor_footprints(positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Squared radii so that neighbouring disks overlap: half the mean squared distance to 3 nearest neighbours.

    Outliers are capped at 16 times the median, so that a stray point does not cover half the image.
    """
    from scipy.spatial import KDTree

    if len(positions) < 2:
        return np.full(len(positions), 1e-4, np.float32)
    k = min(4, len(positions))
    distances = KDTree(positions).query(positions, k=k)[0][:, 1:]
    squared = 0.5 * (distances**2).mean(1)
    median = np.median(squared)
    return np.clip(squared, 1e-4 * median + 1e-16, 16 * median).astype(np.float32)


def usual_points(capture: Capture, volumes: list[ReflectionVolume], config: TrainConfig) -> dict[str, int]:
    """Points that images of the training's size deserve: 1.3 primary points a pixel of one image, 2 reflection points a
    pixel of the largest reflector. Measured on path-traced rooms; more brings little."""
    cameras = [scaled_camera(v.camera, config.image_size, 1.0) for v in capture.train]
    pixels = float(np.median([c.width * c.height for c in cameras]))
    share = max((_image_share(v, capture) for v in volumes), default=0)
    return {
        "primary_points": int(np.clip(1.3 * pixels, 1000, config.max_primary_points)),
        "reflection_points": int(np.clip(2 * pixels * share, 500, 400_000)),
    }


def _image_share(volume: ReflectionVolume, capture: Capture) -> float:
    """Share of the image that a volume takes: the median over the training views that see it well."""
    views = capture.train[:: max(1, len(capture.train) // 24)]
    shares = np.array([volume.project_mask(scaled_camera(v.camera, 160, 1.0)).mean() for v in views])
    return float(np.median(shares[shares >= 0.1 * shares.max()]))


def mean_reflector_color(capture: Capture, volume: ReflectionVolume) -> Float[np.ndarray, "3"]:
    """Mean colour inside the projected volume over a few training views."""
    pixels = []
    for view in capture.train[:: max(1, len(capture.train) // 8)]:
        inside = capture.image(view)[volume.project_mask(view.camera)]
        if len(inside):
            pixels.append(inside.mean(0) / 255)
    return np.mean(pixels, axis=0).astype(np.float32) if pixels else np.full(3, 0.5, np.float32)


def primary_seeds(
    capture: Capture, reflectors: list[Reflector], count: int, rng: np.random.Generator, guesses: bool = False
) -> Seeds:
    """At most `count` stereo points outside the reflectors, stereo's guesses among them where asked for, and points on
    the reflectors' surfaces, which carry rho, in random order.

    Stereo has no points on a mirror, but something must hide what is behind it, and a glaze has paint below it. A
    surface gets as many points as the image has for its share, a quarter as dense: its sides are four pictures wide.
    """
    cloud = capture.points()
    if guesses and (guessed := capture.guesses()) is not None:
        cloud = cloud.joined(guessed)
    for volume, _ in reflectors:
        cloud = cloud.select(~volume.contains(cloud.positions.astype(np.float64)))
    if len(cloud) > count:
        cloud = cloud.select(rng.choice(len(cloud), count, replace=False))
    budget = int(_SURFACE_SHARE * count)
    wanted = [int(count * _image_share(volume, capture)) + 1 for volume, _ in reflectors]
    shrink = min(1.0, budget / max(sum(wanted), 1))
    parts = [(cloud.positions, cloud.normals, cloud.colors, np.full(len(cloud), 0.02))]
    for (volume, model), n in zip(reflectors, wanted, strict=True):
        rho = 0.02 if model == "none" else 0.9
        positions, normals = hull_of(volume, capture).sample(max(int(n * shrink), 100), rng)
        color = mean_reflector_color(capture, volume)
        parts.append((positions, normals, np.broadcast_to(color, positions.shape), np.full(len(positions), rho)))
    columns = [np.concatenate(c).astype(np.float32) for c in zip(*parts, strict=True)]
    order = rng.permutation(len(columns[0]))
    return Seeds(*(c[order] for c in columns))


def reflection_seeds(
    capture: Capture, volume: ReflectionVolume, warp: nn.Module, count: int, rng: np.random.Generator
) -> Seeds:
    """Where `count` reflection points start: for mirrors, on what the capture knows of the surroundings, evenly spread
    over directions; otherwise at random on the surface of the reflection volume (paper section 4.2)."""
    color = mean_reflector_color(capture, volume)
    if isinstance(warp, StaticWarp | NeuralWarp):
        positions, normals = volume.sample_surface(count, rng)
        colors = np.broadcast_to(color, positions.shape)
    else:
        cloud = capture.points()
        plain = np.empty(0, int)
        if isinstance(warp, PlaneWarp):
            # A wide mirror shows what stands before any part of it: most sources are points of the cloud as they are.
            point, normal = warp.start_point.numpy(), warp.start_normal.numpy()
            front = np.flatnonzero((cloud.positions - point) @ normal > 0.02 * volume.radius)
            plain = rng.permutation(front)[: int(_PLAIN_SHARE * count)]
        far = 2 * max(float(np.linalg.norm(v.camera.center - volume.center)) for v in capture.train)
        positions, colors = surroundings(
            cloud.positions.astype(np.float64), cloud.colors, volume, count - len(plain), far, color, rng
        )
        order = rng.permutation(len(plain) + len(positions))
        positions = np.concatenate([cloud.positions[plain], positions])[order]
        colors = np.concatenate([cloud.colors[plain], colors])[order]
        normals = np.zeros_like(positions)
    columns = (positions, normals, colors, np.zeros(len(positions)))
    return Seeds(*(np.ascontiguousarray(c, np.float32) for c in columns))


def start_cloud(seeds: Seeds, count: int, primary: bool, trainable_positions: bool = True) -> PointParameters:
    """The first `count` seeds as trainable points; only primary points carry rho."""
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
        trainable_positions,
    )


def grow_cloud(cloud: PointParameters, seeds: Seeds, count: int) -> PointParameters:
    """Activate seeds up to `count`. A new point takes what its nearest trained point has learned (the change from that
    point's start), and every footprint shrinks with the spacing."""
    from scipy.spatial import KDTree

    old = len(cloud)
    if count <= old:
        return cloud
    device = cloud.positions.device
    kind = (cloud.rho_logits is not None, cloud.positions.requires_grad)
    grown = start_cloud(seeds, count, *kind).to(device)
    before = start_cloud(seeds, old, *kind).to(device)
    nearest = KDTree(seeds.positions[:old]).query(seeds.positions[old:count])[1]
    source = torch.cat([torch.arange(old), torch.from_numpy(nearest)]).to(device)
    with torch.no_grad():
        for name, parameter in grown.named_parameters():
            learned, start = cloud.get_parameter(name), before.get_parameter(name)
            if parameter.requires_grad:
                parameter += (learned - start)[source]
    return grown


def start_warps(capture: Capture, reflectors: list[Reflector], config: TrainConfig) -> list[nn.Module]:
    """The warps of the reflectors' models, started from volumes or masks; networks from the configuration's seed."""
    torch.manual_seed(config.seed)
    centers = np.array([v.camera.center for v in capture.train])
    return [_start_warp(r, capture, centers, config) for r in reflectors]


def _start_warp(
    reflector: Reflector, capture: Capture, centers: Float[np.ndarray, "m 3"], config: TrainConfig
) -> nn.Module:
    volume, model = reflector

    def tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
        return [torch.from_numpy(np.asarray(a, np.float32)) for a in arrays]

    if model == "static":
        return StaticWarp()
    if model == "plane":
        point, normal = tensors(*fit_plane(volume, centers))
        return PlaneWarp(point, normal, volume.radius)
    if model == "sphere":
        center, radius = fit_sphere(volume)
        return QuadricWarp(*tensors(center, radius * np.eye(3)), sphere=True)
    if model == "ellipsoid":
        return QuadricWarp(*tensors(*fit_ellipsoid(volume)), sphere=False)
    if model == "revolution":
        return RevolutionWarp(Revolution(*(value.float() for value in turned_body_of(volume, capture)[0])))
    if model == "concave":
        center, radius = fit_bowl(volume, centers)
        return QuadricWarp(*tensors(center, radius * np.eye(3)), sphere=False, concave=True)
    corners = np.concatenate([volume.vertices, centers])
    low, high = tensors(corners.min(0), corners.max(0))
    neural = NeuralWarp(low, high, config.warp_layers, config.warp_width)
    if model == "neural":
        return neural
    return QuadricNeuralWarp(QuadricWarp(*tensors(*fit_ellipsoid(volume)), sphere=False), neural)


def initial_scene(
    capture: Capture,
    volumes: list[ReflectionVolume],
    warps: list[nn.Module],
    seeds: list[Seeds],
    share: float,
    config: TrainConfig,
) -> Scene:
    """A scene with the first `share` of every cloud's seeds: seeds[0] primary, then one per reflector. The environment
    map and the mirrors' shapes start from clouds of at least `_SHAPE_SHARE`."""
    environment = None
    if config.environment_width:
        up = torch.from_numpy(up_direction([v.camera for v in capture.train])).float()
        environment = EnvironmentMap(config.environment_width, max(1, round(0.4 * config.environment_width)), up)
    renderer = NeuralRenderer(config.renderer_width, config.renderer_layers)

    def clouds(share: float) -> tuple[PointParameters, list[PointParameters]]:
        counts = [stage_count(s, share) for s in seeds]
        reflections = [
            start_cloud(s, count, False, learns_positions(warp))
            for s, count, warp in zip(seeds[1:], counts[1:], warps, strict=True)
        ]
        return start_cloud(seeds[0], counts[0], primary=True), reflections

    splatting = SplatConfig.fast(near=1e-2 * scene_extent(capture))
    scene = Scene(*clouds(max(share, _SHAPE_SHARE)), warps, volumes, environment, renderer, splatting)
    if environment is not None:
        environment.start_from(*seen_through(capture, scene, config))
    start_shapes(scene, capture, config)
    if share < _SHAPE_SHARE:
        scene.primary, reflections = clouds(share)
        for i, cloud in enumerate(reflections):
            scene.reflections[i] = cloud
    return scene


def seen_through(
    capture: Capture, scene: Scene, config: TrainConfig, size: int = 200, views: int = 24
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Directions, colours and weights of what the photographs show where the primary cloud is open and no mirror is:
    mirrors would leave ghosts in the distance behind them."""
    parts = []
    for view in capture.train[:: max(1, len(capture.train) // views)]:
        camera = scaled_camera(view.camera, min(size, config.image_size), 1.0)
        with torch.no_grad():
            directions, weights = scene.openings(camera)
        colors = torch.from_numpy(photograph(capture, view, camera)).to(scene.device).view(-1, 3)
        for volume in scene.volumes:
            weights[torch.from_numpy(volume.project_mask(camera))] = 0
        parts.append((directions.view(-1, 3), colors, weights.reshape(-1)))
    directions, colors, weights = (torch.cat(p) for p in zip(*parts, strict=True))
    return directions, colors, weights


def stage_count(seeds: Seeds, share: float) -> int:
    """How many of the seeds a stage uses; never none."""
    return min(len(seeds.positions), max(int(len(seeds.positions) * share), 100))
