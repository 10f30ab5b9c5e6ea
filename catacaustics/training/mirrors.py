"""The shapes of mirrors before training: fitted to the photographs and to the visual hull of the masks."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch

from catacaustics.cameras import Camera, Viewport
from catacaustics.capture.dataset import Capture, View
from catacaustics.config import TrainConfig
from catacaustics.losses import dssim
from catacaustics.reflectors import quadric, revolution
from catacaustics.reflectors.fit import body_loss, fit_bent_sheet, fit_body, fit_ellipsoid, fit_revolution
from catacaustics.reflectors.revolution import Revolution
from catacaustics.reflectors.visual_hull import VisualHull, carve_visual_hull
from catacaustics.reflectors.volume import ReflectionVolume, volume_masks
from catacaustics.reflectors.warps import Mirror, PlaneWarp, QuadricNeuralWarp, QuadricWarp, RevolutionWarp
from catacaustics.scene import Scene, frozen
from catacaustics.shapes import Float
from catacaustics.training.photographs import photograph, scaled_camera

_SIZES = (1.0, 0.8, 0.65)
"""Sizes that a quadric is fitted from, in units of the one that touches its volume."""
_SHAPE_STEPS, _SHAPE_SIZE = 30, 120
"""Steps of each fit, and the longer side of its images."""
_BODY_WEIGHT = 0.1
"""Of the distance from the visual hull beside the photographs, which say little of a painted mirror's shape."""

_BODY_POINTS = 2000
"""Of a visual hull, that bodies are fitted to."""

_ROUND, _TURNED = 0.3, 0.3
"""A body is an ellipsoid where its loss (`body_loss`) is below the first; otherwise it is turned where a surface of
revolution has less than the second's share of that. Losses and shares measured: balls and egg up to 0.17; kettle 0.91,
0.65; vase 1.15, 0.07; bowl 1.42, 0.07; mirror 1.94, 0.71; bent sheet 2.66, 0.45."""


def start_shapes(scene: Scene, capture: Capture, config: TrainConfig) -> None:
    """Fit every mirror to the photographs while everything else stands still, quadrics from several sizes and from the
    body in the visual hull; the best remains.

    A volume from few or careless masks is too large, a convex hull has handles and spouts in it, and a flat one tells
    little of how it is bent; training does not find back from far. The surroundings are known in outline, so that a
    mirror of the right shape shows about the right picture; where paint shows more, the visual hull keeps the shape.
    Judged in the middle of the volume, which is mirror in any case.
    """
    cameras = [(v, scaled_camera(v.camera, min(_SHAPE_SIZE, config.image_size), 1.0)) for v in capture.train]
    cameras = cameras[:: max(1, len(cameras) // 10)]
    with frozen(scene):
        for warp, volume in zip(scene.warps, scene.volumes, strict=True):
            mirror = warp.quadric if isinstance(warp, QuadricNeuralWarp) else warp
            if isinstance(mirror, Mirror):
                hollow = isinstance(mirror, QuadricWarp) and bool(mirror.concave)
                masked = not (hollow or isinstance(mirror, PlaneWarp))
                boxes = [_middle_box(volume.scaled(0.6), camera) for _, camera in cameras]
                seen = [(v, c, box) for (v, c), box in zip(cameras, boxes, strict=True) if box is not None]
                if seen:
                    body = body_of(volume, capture) if masked else None
                    starts = _starts(mirror, volume, body)
                    points = None if body is None else torch.from_numpy(body.points).to(scene.device, torch.float32)
                    _start_shape(scene, capture, mirror, starts, seen, points)


def _start_shape(
    scene: Scene,
    capture: Capture,
    mirror: Mirror,
    starts: list[list[torch.Tensor]],
    cameras: list[tuple[View, Camera, Viewport]],
    hull: torch.Tensor | None,
) -> None:
    parameters = list(mirror.parameters())
    targets = []
    for view, camera, box in cameras:
        photo = photograph(capture, view, camera)
        photo = photo[box.y0 : box.y0 + box.height, box.x0 : box.x0 + box.width]
        targets.append(torch.from_numpy(np.ascontiguousarray(photo)).to(scene.device))

    def error(i: int) -> torch.Tensor:
        image = scene.decode(scene.layers(cameras[i][1], cameras[i][2]))
        shown = (image - targets[i]).abs().mean() + dssim(image, targets[i])
        if hull is None or isinstance(mirror, PlaneWarp):
            return shown
        return shown + _BODY_WEIGHT * off_body(hull, mirror)

    found = []
    for start in starts:
        with torch.no_grad():
            for buffer, value in zip(mirror.buffers(), start, strict=True):
                buffer.copy_(value)
            for parameter in parameters:
                parameter.zero_()
        for parameter in parameters:
            parameter.requires_grad_(True)
        optimizer = torch.optim.Adam(parameters, 0.02)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _SHAPE_STEPS, 1e-3)
        for step in range(_SHAPE_STEPS):
            optimizer.zero_grad()
            error(step % len(cameras)).backward()
            optimizer.step()
            schedule.step()
        for parameter in parameters:
            parameter.requires_grad_(False)
        total = float(sum(float(error(i)) for i in range(len(cameras))))
        state = [t.detach().clone() for t in (*mirror.buffers(), *parameters)]
        found.append((total if np.isfinite(total) else np.inf, state))
    best = min(found, key=lambda pair: pair[0])[1]
    with torch.no_grad():
        for tensor, value in zip((*mirror.buffers(), *parameters), best, strict=True):
            tensor.copy_(value)


def off_body(points: Float[torch.Tensor, "n 3"], mirror: QuadricWarp | RevolutionWarp) -> Float[torch.Tensor, ""]:
    """How far the points of a visual hull lie from a mirror: the loss of its fits, differentiable."""
    if isinstance(mirror, RevolutionWarp):
        return body_loss(revolution.distances(mirror.surface(), points) / mirror.radii.mean())
    center, axes = mirror.shape()
    return body_loss(quadric.distances(points, center, axes) / axes.norm(dim=0).mean())


@lru_cache(maxsize=16)
def hull_of(volume: ReflectionVolume, capture: Capture) -> VisualHull:
    """The visual hull of a reflector's masks; carved once, whoever asks: trials carve the same one again and again."""
    return carve_visual_hull(volume, volume_masks(capture, volume.name))


class Body(NamedTuple):
    """Points of a visual hull, and centre, half-axes (columns) and loss of the ellipsoid that most of them lie on."""

    points: Float[np.ndarray, "n 3"]
    center: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    loss: float


def nearest_ellipsoid(points: Float[np.ndarray, "n 3"], volume: ReflectionVolume) -> Body:
    """The ellipsoid in the points of a visual hull."""
    center, axes = fit_body(points, *fit_ellipsoid(volume), sphere=False)
    shape = (torch.from_numpy(v) for v in (points, center, axes))
    return Body(points, center, axes, float(body_loss(quadric.distances(*shape) / np.linalg.norm(axes, axis=0).mean())))


@lru_cache(maxsize=16)
def body_of(volume: ReflectionVolume, capture: Capture) -> Body:
    """The ellipsoid in a reflector's visual hull."""
    points = hull_of(volume, capture).sample(_BODY_POINTS, np.random.default_rng(0))[0]
    return nearest_ellipsoid(points, volume)


@lru_cache(maxsize=16)
def turned_body_of(volume: ReflectionVolume, capture: Capture) -> tuple[Revolution, float]:
    """The surface of revolution in a reflector's visual hull, and its loss."""
    body = body_of(volume, capture)
    return fit_revolution(body.points, body.center, body.axes)


def is_turned(volume: ReflectionVolume, capture: Capture) -> bool:
    """Whether a visual hull is a surface of revolution, and not an ellipsoid."""
    loss = body_of(volume, capture).loss
    return loss > _ROUND and turned_body_of(volume, capture)[1] < _TURNED * loss


def impossible_shapes(volume: ReflectionVolume, capture: Capture) -> dict[str, str]:
    """Rungs that the masks of a reflector rule out, and why."""
    if fit_bent_sheet(volume):
        return dict.fromkeys(("sphere", "revolution"), "the masks show something flat")
    return {} if is_turned(volume, capture) else {"revolution": "the masks show an ellipsoid, or no turned shape"}


def _starts(mirror: Mirror, volume: ReflectionVolume, body: Body | None) -> list[list[torch.Tensor]]:
    """Buffers of a mirror to start from: convex quadrics in several sizes and as the body in the visual hull, or as
    cylinders where that is flat and no ellipsoid; all others as they are."""
    start = [b.clone() for b in mirror.buffers()]
    if body is None or isinstance(mirror, RevolutionWarp):
        return [start]
    center, axes, concave = start
    sphere = isinstance(mirror, QuadricWarp) and len(mirror.log_radii) == 1
    sheets = [] if sphere else fit_bent_sheet(volume)
    if sheets and body.loss > _ROUND:
        found, sizes = sheets, ()
    else:
        found, sizes = [(body.center, body.axes)], _SIZES
        if sphere:
            shape = (t.cpu().numpy().astype(float) for t in (center, axes))
            found = [fit_body(body.points, *shape, sphere=True)]
    others = [[torch.from_numpy(c).to(center), torch.from_numpy(a).to(axes), concave] for c, a in found]
    return [[center, size * axes, concave] for size in sizes] + others


def _middle_box(core: ReflectionVolume, camera: Camera) -> Viewport | None:
    """The box around a volume in a view; None where it is not seen."""
    rows, columns = np.nonzero(core.project_mask(camera))
    if not len(rows):
        return None
    x0, y0 = int(columns.min()), int(rows.min())
    return Viewport(x0, y0, int(columns.max()) - x0 + 1, int(rows.max()) - y0 + 1)
