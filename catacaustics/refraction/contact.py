"""A contact sheet of a data set: a look at what the buffers hold, one frame a row."""

import numpy as np

from catacaustics.images import to_bytes
from catacaustics.refraction.frames import Frame, Frames
from catacaustics.shapes import Float, UInt8

ROWS = 6
COLUMNS = (
    "reference",
    "texture colour where the specular path lands",
    "landing point",
    "landing coordinates in the texture",
    "events; red where one is a total internal reflection",
    "albedo",
    "direct lighting",
    "normals of the opaque scene",
    "normals of the transparent objects",
)


def true_colour(frame: Frame, textures: list[np.ndarray]) -> Float[np.ndarray, "h w 3"]:
    """Albedo with the texture colour at the true landing point where the path is refracted; nearest texel."""
    colour = frame.albedo.copy()
    colour[frame.refractive] = 0
    for number, texture in enumerate(textures):
        there = frame.landing_object == number
        height, width = texture.shape[:2]
        u, v = frame.landing_uv[there].T
        colour[there] = texture[(v * height).astype(int), (u * width).astype(int)] / 255
    return colour


def _row(frame: Frame, textures: list[np.ndarray]) -> list[np.ndarray]:
    valid = np.expand_dims(frame.landing_object >= 0, -1)
    uv = np.concatenate([frame.landing_uv, np.full((*frame.landing_uv.shape[:2], 1), 0.5, np.float32)], -1)
    count = np.repeat(frame.events[..., None] / 8.0, 3, -1)
    count[frame.internal_reflection] *= [1.0, 0.3, 0.3]
    nearest = np.where(frame.object_mask, frame.object_depth, np.inf).argmin(0)
    normal = np.take_along_axis(frame.object_normal, nearest[None, ..., None], 0)[0]
    return [
        frame.reference,
        true_colour(frame, textures),
        valid * (frame.landing + 1) / 2,
        valid * uv,
        count,
        frame.albedo,
        frame.direct,
        (frame.normal + 1) / 2,
        (normal + 1) / 2 * np.any(frame.object_mask, 0)[..., None],
    ]


def contact_sheet(frames: Frames) -> UInt8[np.ndarray, "height width 3"]:
    """The first frames, references first where there are any; columns as COLUMNS."""
    rows = [np.concatenate(_row(frames[i], frames.textures), 1) for i in range(min(ROWS, len(frames)))]
    return to_bytes(np.concatenate(rows, 0))
