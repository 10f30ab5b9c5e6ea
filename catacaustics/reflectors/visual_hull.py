"""The surface of the visual hull (Laurentini 1994): what the masks leave of a reflection volume.

The volume is convex so that reflections are free to land anywhere inside. The primary cloud stands for the object
itself: a neck, a handle or a spout leaves gaps in the convex volume through which the background is seen.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from catacaustics.cameras import Camera
from catacaustics.geometry import normalize
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.shapes import Bool, Float

_ROW = 1024
"""Points are looked up in an image by rows of so many: OpenCV's images have at most 32767 rows."""
_CELLS = 64
"""Along the longest side of the volume."""
_BLUR = 1.5
"""Standard deviation in pixels of the masks' soft edges, between which the surface is interpolated."""
_LEVEL = 0.25
"""Of the soft masks, where the surface is: a pixel outside their outlines, as hands and calibrations err."""


class VisualHull(NamedTuple):
    """The surface of a visual hull, as points to draw from.

    Args:
        volume: that the hull lies in.
        points, normals: where the edges of a grid cross the surface, and outward unit normals there; empty where the
            masks leave nothing (they contradict each other, or the object is thinner than a cell).
        cell: spacing of the grid.
    """

    volume: ReflectionVolume
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    cell: float

    def sample(self, count: int, rng: np.random.Generator) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """`count` random points of the surface and their outward unit normals; of the volume's where it is empty."""
        if not len(self.points):
            return self.volume.sample_surface(count, rng)
        # Edges cross a surface evenly up to their slant: |n_x| + |n_y| + |n_z| crossings an area.
        density = 1 / np.abs(self.normals).sum(1)
        chosen = rng.choice(len(self.points), count, p=density / density.sum())
        points, normals = self.points[chosen], self.normals[chosen]
        spread = rng.uniform(-0.5, 0.5, (count, 3)) * self.cell
        spread -= (spread * normals).sum(1, keepdims=True) * normals
        spread[~self.volume.contains(points + spread)] = 0
        return points + spread, normals


def carve_visual_hull(
    volume: ReflectionVolume, masks: Sequence[tuple[str, Camera, Bool[np.ndarray, "height width"]]]
) -> VisualHull:
    """The visual hull of masks, given as names of views, their cameras, and where they see the reflector.

    A point belongs to the hull where it lies in the volume and no mask that it projects into excludes it. The surface
    is found where the edges of a grid cross it (the corners of marching cubes, Lorensen and Cline 1987).
    """
    grid, cell = _grid(volume)
    inside = _soft_inside(volume, grid.reshape(-1, 3), masks, cell).reshape(grid.shape[:3])
    return VisualHull(volume, *_crossings(grid, inside, cell), cell)


def _grid(volume: ReflectionVolume) -> tuple[Float[np.ndarray, "x y z 3"], float]:
    low, high = volume.vertices.min(0), volume.vertices.max(0)
    cell = float((high - low).max()) / _CELLS
    counts = np.ceil((high - low) / cell).astype(int) + 3
    first = (low + high) / 2 - cell * (counts - 1) / 2
    return first + cell * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), -1), cell


def _soft_inside(
    volume: ReflectionVolume,
    points: Float[np.ndarray, "n 3"],
    masks: Sequence[tuple[str, Camera, Bool[np.ndarray, "height width"]]],
    cell: float,
) -> Float[np.ndarray, "n"]:
    """1 inside, 0 outside of all masks together, with soft edges; at `_LEVEL` on the volume's planes, 0 outside."""
    inside = np.clip(_LEVEL * (1 - volume.heights(points) / cell), 0, 1)
    for _, camera, mask in masks:
        left = np.flatnonzero(inside)
        pixels, distance = camera.project(points[left])
        soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), _BLUR)
        seen = _sampled(soft, pixels - 0.5)
        unknown = np.isnan(seen) | (distance <= 0)  # beside the picture: nothing is said
        inside[left] = np.minimum(inside[left], np.where(unknown, 1, seen))
    return inside


def _sampled(image: Float[np.ndarray, "height width"], pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Bilinear in an image, to 1/32 pixel; nan outside. OpenCV's is ten times as fast as SciPy's."""
    height, width = image.shape
    outside = (pixels < 0).any(1) | (pixels[:, 0] > width - 1) | (pixels[:, 1] > height - 1)
    rows = -(-len(pixels) // _ROW)
    maps = np.zeros((2, rows * _ROW), np.float32)
    maps[:, : len(pixels)] = np.where(outside, 0, pixels.T)
    x, y = maps.reshape(2, rows, _ROW)
    sampled = cv2.remap(image, x, y, cv2.INTER_LINEAR)
    return np.where(outside, np.nan, sampled.ravel()[: len(pixels)])


def _crossings(
    grid: Float[np.ndarray, "x y z 3"], inside: Float[np.ndarray, "x y z"], cell: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Where edges of the grid cross the surface, and the normals there."""
    from scipy.ndimage import gaussian_filter

    slope = np.stack([*np.gradient(gaussian_filter(inside, 1.0), cell)], -1)
    points, slopes = [], []
    for axis in range(3):
        a, b = (np.moveaxis(inside, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        crossing = (a < _LEVEL) != (b < _LEVEL)
        share = ((_LEVEL - a[crossing]) / (b[crossing] - a[crossing]))[:, None]
        for values, kept in ((grid, points), (slope, slopes)):
            moved = np.moveaxis(values, axis, 0)
            kept.append((1 - share) * moved[:-1][crossing] + share * moved[1:][crossing])
    found, downhill = np.concatenate(points), -np.concatenate(slopes)
    steep = np.linalg.norm(downhill, axis=1) > 1e-6 / cell
    return found[steep], normalize(downhill[steep])
