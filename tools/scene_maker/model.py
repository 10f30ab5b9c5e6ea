"""What a scene consists of, without the renderer."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scene_maker.solids import Mesh, Surface, Vector


@dataclass(frozen=True, eq=False)
class Light:
    """A rectangle that emits from its front: top left corner, vectors along its top and left edges, radiance (RGB).

    `view` (height, width, 3), linear in [0, 1], is what a window shows; it scales the radiance.
    """

    top_left: Vector
    right: Vector
    down: Vector
    radiance: Vector
    view: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Reflector:
    """A mirror or glazed thing.

    Args:
        name: folder of its masks.
        geometry: what truth/reflectors.json says of it; a "sphere" is rendered exactly, anything else by `mesh`.
        mesh: its surface; both sides reflect.
        tint: reflectance (RGB) of a mirror, or of the coat of a glazed surface.
        paint: sRGB texture below a clear glaze; None for a mirror.
    """

    name: str
    geometry: dict[str, Any]
    mesh: Mesh | None = None
    tint: Vector = (0.93, 0.92, 0.9)
    paint: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Arcs:
    """Cameras that circle a target: hand-held for training, a smooth path for the held-out views.

    Args:
        target: where the cameras look.
        distance: mean distance from the target.
        elevations: one arc each, in degrees.
        azimuth: first and last azimuth in degrees (0 is +x, 90 is +y).
        held_out: first and last azimuth, first and last elevation of the held-out path in degrees.
    """

    target: Vector
    distance: float
    elevations: Sequence[float] = (8, 28, 50)
    azimuth: tuple[float, float] = (0, 360)
    held_out: tuple[float, float, float, float] = (20, 250, 16, 40)


@dataclass(frozen=True, eq=False)
class SceneModel:
    """Diffuse surfaces, lights, reflectors and where the cameras go. Lengths in metres, z is up."""

    surfaces: list[Surface]
    lights: list[Light]
    reflectors: list[Reflector]
    arcs: list[Arcs]
    sky: np.ndarray | None = None
    exposure: float = 1.0
    max_depth: int = 5
