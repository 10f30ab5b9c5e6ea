"""Snell and Fresnel at smooth interfaces, in float64. Directions and normals are unit vectors."""

from typing import NamedTuple

import numpy as np

from catacaustics.geometry import normalize
from catacaustics.shapes import Bool, Float


class Event(NamedTuple):
    """What becomes of rays at an interface."""

    direction: Float[np.ndarray, "n 3"]
    refracted: Bool[np.ndarray, "n"]
    total: Bool[np.ndarray, "n"]
    """Totally reflected: there is no refracted ray."""
    share: Float[np.ndarray, "n"]
    """Of the light, that takes this branch."""


def fresnel(
    cosine: Float[np.ndarray, "*n"], ratio: Float[np.ndarray, "*n"]
) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Share of unpolarised light that is reflected, and the cosine of the refracted ray (0 past the critical angle).

    Args:
        cosine: of the angle between ray and normal, in [0, 1].
        ratio: index of refraction behind the interface over the one before it.
    """
    squared = 1 - (1 - cosine**2) / ratio**2
    beyond = np.sqrt(np.maximum(squared, 0))
    with np.errstate(invalid="ignore", divide="ignore"):
        across = (cosine - ratio * beyond) / (cosine + ratio * beyond)
        along = (ratio * cosine - beyond) / (ratio * cosine + beyond)
    reflectance = (across**2 + along**2) / 2
    return np.where((squared <= 0) | (cosine <= 0), 1.0, reflectance), beyond


def dominant_event(
    direction: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    inner: Float[np.ndarray, "n"],
    outer: Float[np.ndarray, "n"],
) -> Event:
    """Follow the branch that carries more light: refraction, or reflection where it exceeds one half.

    Args:
        normal: shading normal, from the medium of index `inner` to the one of index `outer`.
    """
    against = -(direction * normal).sum(-1)
    entering = against > 0
    facing = np.where(entering[:, None], normal, -normal)
    cosine, ratio = np.abs(against), np.where(entering, inner / outer, outer / inner)
    reflectance, beyond = fresnel(cosine, ratio)
    refracted = reflectance <= 0.5
    mirrored = direction + 2 * cosine[:, None] * facing
    bent = direction / ratio[:, None] + (cosine / ratio - beyond)[:, None] * facing
    total = (1 - cosine**2) >= ratio**2
    share = np.where(refracted, 1 - reflectance, reflectance)
    return Event(normalize(np.where(refracted[:, None], bent, mirrored)), refracted, total, share)
