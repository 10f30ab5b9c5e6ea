"""Cameras of a capture: irregular hand-held arcs for training, one smooth path for the held-out views."""

from dataclasses import dataclass

import numpy as np

from catacaustics.cameras import Camera
from catacaustics.geometry import look_at
from scene_maker.model import Arcs

FOCAL = 0.9
"""Focal length in image widths: 58 degrees across, a phone's main lens."""

UP = np.array([0.0, 0.0, 1.0])


def camera_at(eye: np.ndarray, target: np.ndarray, width: int, height: int, roll: float = 0.0) -> Camera:
    """A camera at `eye` looking at `target`, turned by `roll` radians about its axis."""
    pose = look_at(np.asarray(eye, float), np.asarray(target, float), UP)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
    return Camera(width, height, FOCAL * width, FOCAL * width, width / 2, height / 2, turn @ pose)


def _eye(arcs: Arcs, azimuth: float, elevation: float, distance: float) -> np.ndarray:
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.asarray(arcs.target) + distance * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


@dataclass(frozen=True)
class HandHeld:
    """Draws the cameras of one scene's training arcs one by one; a refused camera is drawn again."""

    arcs: list[Arcs]
    count: int
    width: int
    height: int

    def draw(self, index: int, rng: np.random.Generator) -> Camera:
        """Camera `index` of `count`: arcs one after the other, jittered in angle, height, distance, aim and roll."""
        rows = [(arc, elevation) for arc in self.arcs for elevation in arc.elevations]
        row, position = divmod(index * len(rows) / self.count, 1)
        arc, elevation = rows[int(row)]
        first, last = arc.azimuth
        step = len(rows) / self.count
        along = position + step * (0.5 + rng.uniform(-0.35, 0.35))
        eye = _eye(
            arc,
            first + (last - first) * (along % 1 if last - first >= 360 else min(along, 1.0)),
            elevation + rng.normal(0, 2.5),
            arc.distance * rng.uniform(0.92, 1.1),
        )
        aim = np.asarray(arc.target) + rng.normal(0, 0.045, 3) * arc.distance
        return camera_at(eye, aim, self.width, self.height, rng.normal(0, 0.03))


def held_out_cameras(arcs: list[Arcs], count: int, width: int, height: int) -> list[Camera]:
    """A smooth path between the heights of the arcs; with several targets it travels from the first to the last,
    standing back between them."""
    path = []
    for t in np.linspace(0, 1, count):
        position = t * (len(arcs) - 1)
        i = min(int(position), max(len(arcs) - 2, 0))
        blend = 0.5 - 0.5 * np.cos(np.pi * (position - i)) if len(arcs) > 1 else 0.0
        ends = [arcs[i], arcs[min(i + 1, len(arcs) - 1)]]
        eyes = []
        for arc in ends:
            a0, a1, e0, e1 = arc.held_out
            back = arc.distance * (1 + 2 * blend * (1 - blend))
            eyes.append(_eye(arc, a0 + (a1 - a0) * t, e0 + (e1 - e0) * (0.5 - 0.5 * np.cos(np.pi * t)), back))
        eye = (1 - blend) * eyes[0] + blend * eyes[1]
        target = (1 - blend) * np.asarray(ends[0].target) + blend * np.asarray(ends[1].target)
        path.append(camera_at(eye, target, width, height))
    return path
