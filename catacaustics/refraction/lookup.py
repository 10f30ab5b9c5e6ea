"""Colours at landing points: by texture coordinates, by a screen-space colour buffer, or by a probe's panorama.

All images are channels first. ndc: x to the right, y up, -1 and 1 at the edges of the image.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from catacaustics.shapes import Float, Int, UInt8

_NOWHERE = 1e4
"""ndc of points at or behind the camera's plane: far outside of any image."""


def project(
    points: Float[Tensor, "b 3 h w"], world_to_clip: Float[Tensor, "b 4 4"]
) -> tuple[Float[Tensor, "b 2 h w"], Float[Tensor, "b 1 h w"]]:
    """Normalised device coordinates p_ndc = (M p)_xy / (M p)_w and the depth along the viewing axis, (M p)_w.

    Points that are not in front of the camera come out far outside the image.
    """
    clip = torch.einsum("bij,bjhw->bihw", world_to_clip[:, :, :3], points) + world_to_clip[:, :, 3, None, None]
    depth = clip[:, 3:4]
    front = depth > 1e-6
    ndc = torch.where(front, clip[:, :2] / torch.where(front, depth, 1.0), _NOWHERE)
    return ndc, depth


def sample_screen(screen: Float[Tensor, "b c s s"], ndc: Float[Tensor, "b 2 h w"]) -> Float[Tensor, "b c h w"]:
    """Bilinear lookup in screen-space buffers; outside, their border."""
    grid = torch.stack([ndc[:, 0], -ndc[:, 1]], -1)
    return grid_sample(screen, grid, "bilinear", "border", align_corners=False)


def sample_probe(
    probe: Float[Tensor, "b c v u"], position: Float[Tensor, "b 3"], points: Float[Tensor, "b 3 h w"]
) -> Float[Tensor, "b c h w"]:
    """Bilinear lookup in a panorama, as `Frame.probe`, in the directions of points as seen from its position."""
    x, y, z = (points - position[..., None, None]).unbind(1)
    azimuth, elevation = torch.atan2(y, x), torch.atan2(z, torch.hypot(x, y))
    columns = probe.shape[-1]
    around = torch.cat([probe[..., -1:], probe, probe[..., :1]], -1)
    grid = torch.stack([azimuth / torch.pi * columns / (columns + 2), -2 * elevation / torch.pi], -1)
    return grid_sample(around, grid, "bilinear", "border", align_corners=False)


def inside_screen(ndc: Float[Tensor, "b 2 h w"], edge: float = 0.0) -> Float[Tensor, "b 1 h w"]:
    """1 in the image and 0 outside; with an `edge`, in ndc, it falls linearly to 0 towards the image's border."""
    distance = 1 - ndc.abs().amax(1, keepdim=True)
    return (distance / edge).clamp(0, 1) if edge else (distance >= 0).to(ndc.dtype)


def visibility(
    screen_depth: Float[Tensor, "b 1 s s"],
    ndc: Float[Tensor, "b 2 h w"],
    depth: Float[Tensor, "b 1 h w"],
    tolerance: float,
) -> Float[Tensor, "b 1 h w"]:
    """Whether points are the ones that the camera sees there: 1 where the depths differ by less than `tolerance` (scene
    units), 0 beyond twice of it, linear between. Off the screen the value means nothing."""
    difference = (sample_screen(screen_depth, ndc) - depth).abs()
    return (2 - difference / tolerance).clamp(0, 1)


class Textures:
    """The textures of a scene's opaque objects for bilinear lookup by texture coordinates, which repeat.

    Args:
        images: sRGB bytes, one an object. (0, 0) is the top left corner, v runs down, texel centres at half integers.
    """

    def __init__(self, images: Sequence[UInt8[np.ndarray, "_ _ 3"]], device: torch.device | str = "cpu"):
        flat = np.concatenate([image.reshape(-1, 3) for image in images])
        self.texels = torch.from_numpy(flat).to(device).float() / 255
        sizes = [(image.shape[1], image.shape[0]) for image in images]
        self.sizes = torch.tensor(sizes, device=device)
        self.offsets = torch.tensor(np.cumsum([0, *(w * h for w, h in sizes[:-1])]), device=device)

    def __len__(self) -> int:
        return len(self.sizes)

    def sample(self, index: Int[Tensor, "b h w"], uv: Float[Tensor, "b 2 h w"]) -> Float[Tensor, "b 3 h w"]:
        """sRGB colours in [0, 1]; black where the index is negative."""
        known = index.clamp_min(0)
        size = self.sizes[known].movedim(-1, 1)
        place = uv * size - 0.5
        corner = place.floor()
        fraction = place - corner
        total = torch.zeros((), device=uv.device)
        for dx in (0, 1):
            for dy in (0, 1):
                step = torch.tensor([dx, dy], device=uv.device).view(1, 2, 1, 1)
                texel = (corner.long() + step) % size
                share = (fraction * step + (1 - fraction) * (1 - step)).prod(1, keepdim=True)
                row = self.offsets[known] + texel[:, 1] * size[:, 0] + texel[:, 0]
                total = total + share * self.texels[row].movedim(-1, 1)
        return total * (index >= 0)[:, None]


class Screen(NamedTuple):
    """Pictures of the opaque scene that landing points are looked up in: from the camera, and all around the probe."""

    color: Float[Tensor, "b 3 s s"]
    depth: Float[Tensor, "b 1 s s"]
    probe: Float[Tensor, "b 3 v u"]
    probe_position: Float[Tensor, "b 3"]
