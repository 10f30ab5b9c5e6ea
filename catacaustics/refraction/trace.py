"""R-buffer truth: where the specular path of a ray lands.

At every smooth interface the path takes the branch that carries more light: it is refracted, or reflected where
Fresnel's reflectance exceeds one half, which past the critical angle is always. The first opaque surface ends it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from catacaustics.refraction.optics import dominant_event
from catacaustics.shapes import Bool, Float, Int

MAX_EVENTS = 16
"""A path with more refractions and reflections than this lands nowhere."""
CLEARANCE = 5e-6
"""How far behind a surface a ray starts, across it: well above the rounding of 32-bit hits in [-1, 1]^3. It starts on
its own line, so that the path is not displaced."""


class Hits(NamedTuple):
    """What rays meet: distance (infinite: nothing), normals of the surface and for shading (both outward), texture
    coordinates, and which body (-1: none)."""

    distance: Float[np.ndarray, "n"]
    normal: Float[np.ndarray, "n 3"]
    shading: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    body: Int[np.ndarray, "n"]


Intersect = Callable[[np.ndarray, np.ndarray], Hits]
"""Meets rays (origins (n, 3), unit directions (n, 3)) with a scene."""


class Media(NamedTuple):
    """Indices of refraction within and around every body; `inner` is nan where it is opaque."""

    inner: Float[np.ndarray, "b"]
    outer: Float[np.ndarray, "b"]


@dataclass(frozen=True, eq=False)
class Landings:
    """Where paths land. Where they do not, `body` is -1 and the rest zero; `refractive`, `events` and `light` (its
    share that takes the path, by Fresnel) are always set."""

    refractive: Bool[np.ndarray, "n"]
    position: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    body: Int[np.ndarray, "n"]
    events: Int[np.ndarray, "n"]
    internal: Bool[np.ndarray, "n"]
    light: Float[np.ndarray, "n"]


def land(
    intersect: Intersect,
    media: Media,
    origins: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    max_events: int = MAX_EVENTS,
    first: Hits | None = None,
) -> Landings:
    """Follow the specular paths of rays (unit directions) whose first surface is transparent.

    Args:
        first: what the rays meet first, where that is known.
    """
    n = len(origins)
    refractive, internal, body = np.zeros(n, bool), np.zeros(n, bool), np.full(n, -1)
    position, normal, uv, events = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 2)), np.zeros(n, int)
    light = np.ones(n)
    active, origin, direction = np.arange(n), np.asarray(origins, float), np.asarray(directions, float)
    opaque = np.isnan(media.inner)
    for count in range(max_events + 1):
        hits = first if first is not None and count == 0 else intersect(origin, direction)
        met = hits.body >= 0
        ends = met & opaque[hits.body]
        goes_on = met & ~ends
        if count == 0:
            refractive[goes_on] = True
        else:
            done = active[ends]
            position[done] = origin[ends] + hits.distance[ends, None] * direction[ends]
            towards = (hits.shading[ends] * direction[ends]).sum(-1, keepdims=True) > 0
            normal[done] = np.where(towards, -hits.shading[ends], hits.shading[ends])
            uv[done], body[done] = hits.uv[ends] % 1, hits.body[ends]
        if count == max_events or not goes_on.any():
            break
        hits, active = Hits(*(v[goes_on] for v in hits)), active[goes_on]
        point = origin[goes_on] + hits.distance[:, None] * direction[goes_on]
        event = dominant_event(direction[goes_on], hits.shading, media.inner[hits.body], media.outer[hits.body])
        direction = event.direction
        events[active] += 1
        light[active] *= event.share
        internal[active] |= event.total
        slope = np.abs((direction * hits.normal).sum(-1, keepdims=True))
        origin = point + CLEARANCE / np.maximum(slope, 0.01) * direction
    internal &= body >= 0
    return Landings(refractive, position, normal, uv, body, events, internal, light)
