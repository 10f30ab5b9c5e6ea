"""Do reflections move as optics says? Displayed directions against ground truth, for every kind of warp.

A reflection point stands for something in the world: whatever is mirrored where the point is displayed. From another
camera that thing is mirrored somewhere else, and there the warp should display the point. The angle between the two
directions, seen from the camera, is the error of the reflection's flow (paper section 7.7). On path-traced captures the
truth is known pixel by pixel (capture/truth.py).
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from catacaustics.cameras import Camera, pixel_centers
from catacaustics.capture.dataset import Capture, View
from catacaustics.capture.truth import read_truth, truth_path
from catacaustics.geometry import normalize
from catacaustics.scene import Scene
from catacaustics.shapes import Float, Int

_LEAST_OPACITY = 0.3
"""Fainter points show nothing that could be followed."""
_SAME_PLACE = 0.02
"""Two mirrored positions within this share of their distance from the reflector are the same thing."""


class FlowError(NamedTuple):
    """Angles in degrees between displayed and true directions of mirrored things, over points and pairs of views.
    `static` is the median error of reflections that would stick to the reflector's surface: the motion there is."""

    mean: float
    median: float
    percentile_95: float
    static: float
    samples: int


def flow_error(scene: Scene, capture: Capture, most_pairs: int = 24) -> FlowError | None:
    """The error of the reflections' flow from training views to held-out views with ground truth; None where the
    capture has none or the scene no reflections."""
    starts = [v for v in capture.train if truth_path(capture.root, v.name).is_file()]
    ends = [v for v in capture.held_out if truth_path(capture.root, v.name).is_file()]
    if not starts or not ends or not scene.volumes:
        return None
    pairs = [(a, b) for a in starts for b in ends]
    pairs = [pairs[i] for i in np.linspace(0, len(pairs) - 1, min(most_pairs, len(pairs))).round().astype(int)]
    errors, still = (np.concatenate(e) for e in zip(*(_pair_errors(scene, capture, *p) for p in pairs), strict=True))
    if not len(errors):
        return None
    return FlowError(
        float(errors.mean()),
        float(np.median(errors)),
        float(np.percentile(errors, 95)),
        float(np.median(still)),
        len(errors),
    )


def displayed_points(scene: Scene, index: int, camera: Camera) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Where points of reflection cloud `index` appear for a camera, and their rows: those that appear at all, some of
    them several times."""
    cloud = scene.reflections[index]
    center = torch.tensor(camera.center, dtype=cloud.positions.dtype, device=cloud.positions.device)
    with torch.no_grad():
        shown = scene.warps[index](cloud.positions, center)
        rows = torch.arange(len(cloud.positions), device=center.device) if shown.rows is None else shown.rows
        visible = torch.sigmoid(cloud.opacity_logits[rows]) > _LEAST_OPACITY
        if shown.visible is not None:
            visible &= shown.visible
    return shown.positions.detach()[visible].cpu().numpy().astype(np.float64), rows[visible].cpu().numpy()


def _pair_errors(scene: Scene, capture: Capture, first: View, second: View) -> tuple[np.ndarray, np.ndarray]:
    """Angles between displayed and true directions in the second view, for points that show something in the first;
    and what the angles would be if reflections stuck to the surface."""
    from scipy.spatial import KDTree

    truth = [read_truth(capture.root, v.name) for v in (first, second)]
    errors, still = [], []
    for i, volume in enumerate(scene.volumes):
        before, rows = displayed_points(scene, i, first.camera)
        after, rows_again = displayed_points(scene, i, second.camera)
        pixels, depth = first.camera.project(before)
        cells = np.floor(pixels).astype(int)
        height, width = truth[0].mirror_mask.shape
        inside = (depth > 0) & (cells >= 0).all(1) & (cells[:, 0] < width) & (cells[:, 1] < height)
        cells = np.where(inside[:, None], cells, 0)
        sources = truth[0].source[cells[:, 1], cells[:, 0]]
        own = volume.project_mask(first.camera)[cells[:, 1], cells[:, 0]]
        usable = inside & np.isin(rows, rows_again) & own & np.isfinite(sources).all(1)
        # Where is the same thing mirrored in the second view?
        region = np.isfinite(truth[1].source).all(-1) & volume.project_mask(second.camera)
        if not usable.any() or not region.any():
            continue
        rays = normalize(second.camera.ray_directions(pixel_centers(second.camera.viewport)))[region]
        gap, nearest = map(np.asarray, KDTree(truth[1].source[region]).query(sources[usable]))
        same = gap < _SAME_PLACE * np.linalg.norm(sources[usable] - volume.center, axis=1)
        true = rays[nearest[same]]
        errors.append(_least_angles(rows[usable][same], true, rows_again, normalize(after - second.camera.center)))
        stuck = _surface_points(first.camera, before[usable][same], volume.center, volume.radius)
        still.append(_angle(normalize(stuck - second.camera.center), true))
    if not errors:
        return np.zeros(0), np.zeros(0)
    return np.concatenate(errors), np.concatenate(still)


def _least_angles(rows: np.ndarray, true: np.ndarray, rows_again: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Degrees between true directions of points and the nearest of the directions in which each is shown: a mirror that
    is bent inwards shows one several times, and the truth tells one of them."""
    order = np.argsort(rows_again, kind="stable")
    first, end = (np.searchsorted(rows_again[order], rows, side) for side in ("left", "right"))
    angles = np.full(len(rows), np.inf)
    for k in range(int((end - first).max(initial=0))):
        more = first + k < end
        angles[more] = np.minimum(angles[more], _angle(shown[order[first[more] + k]], true[more]))
    return angles


def _surface_points(camera: Camera, points: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """The points' rays cut off where a ball around the reflector begins, or where they pass its centre."""
    rays = normalize(points - camera.center)
    along = (rays * (center - camera.center)).sum(1)
    nearest2 = np.sum((center - camera.center) ** 2) - along**2
    return camera.center + (along - np.sqrt(np.maximum(radius**2 - nearest2, 0)))[:, None] * rays


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between unit vectors, accurate near 0."""
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=1) / 2, 0, 1)))


def sphere_caustic(
    source: Float[Tensor, "3"], center: Float[Tensor, "3"], radius: float, camera: Float[Tensor, "3"]
) -> Float[Tensor, "3"]:
    """The point of the catacaustic of a sphere that a camera sees of a source: the tangential image, where
    neighbouring reflected rays in the plane of incidence meet (Coddington): 1/t = 1/d + 2 / (r cos i) behind the
    surface."""
    from catacaustics.reflectors.quadric import specular_points

    axes = radius * torch.eye(3, dtype=source.dtype)
    point = specular_points(source[None], camera, center, axes).points[0]
    ray = torch.nn.functional.normalize(point - camera, dim=0)
    cosine = -(ray @ (point - center)) / radius
    distance = 1 / (1 / (source - point).norm() + 2 / (radius * cosine))
    return point + distance * ray


def caustic_errors(
    warp: nn.Module,
    point: Float[Tensor, "3"],
    source: Float[Tensor, "3"],
    center: Float[Tensor, "3"],
    radius: float,
    cameras: Float[Tensor, "n 3"],
) -> Float[np.ndarray, "n"]:
    """Degrees between where a warp displays a point and the catacaustic of the source that it stands for, seen from
    each of the camera centres; nan where it does not."""
    angles = []
    for camera in cameras:
        true = sphere_caustic(source, center, radius, camera)
        shown = nearest_image(warp, point, camera, true)
        pair = [normalize((p - camera).double().numpy()[None]) for p in (shown, true)]
        angles.append(float(_angle(*pair)[0]))
    return np.array(angles)


def nearest_image(
    warp: nn.Module, point: Float[Tensor, "3"], camera: Float[Tensor, "3"], true: Float[Tensor, "3"]
) -> Float[Tensor, "3"]:
    """Where a warp displays a point, nearest to a place if there are several; nan where it does not."""
    with torch.no_grad():
        positions = warp(point[None], camera).positions.detach()
    if not len(positions):
        return torch.full_like(point, torch.nan)
    return positions[(positions - true).norm(dim=1).argmin()]
