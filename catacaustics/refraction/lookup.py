"""Colours at landing points: by texture coordinates, by the camera and a screen-space colour buffer, or by both.

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


def snap(
    points: Float[Tensor, "b 3 h w"],
    origins: Float[Tensor, "b 3 h w"],
    world_to_clip: Float[Tensor, "b 4 4"],
    screen_depth: Float[Tensor, "b 1 s s"],
    reach: float,
    steps: int = 24,
) -> Float[Tensor, "b 3 h w"]:
    """Move points along their ray to where it meets the surface that the camera sees, at most by `reach` (scene units).

    The ray is followed from point - reach to point + reach; of the places where it goes below the surface the one
    nearest to the point is taken, found by linear interpolation. Points without such a place stay.
    """
    distance = (points - origins).norm(dim=1, keepdim=True)
    ray = (points - origins) / distance.clamp_min(1e-6)
    low = (distance - reach).clamp_min(0)
    step = (distance + reach - low) / steps
    best, shift = torch.full_like(distance, torch.inf), torch.zeros_like(distance)
    before: Tensor | None = None
    for i in range(steps + 1):
        ndc, depth = project(origins + (low + i * step) * ray, world_to_clip)
        below = depth - sample_screen(screen_depth, ndc)
        if before is not None:
            # Far below means that the ray has gone behind something, not into it.
            meets = (before < 0) & (below >= 0) & (below < 2 * step) & (inside_screen(ndc) > 0)
            moved = low + (i - below / (below - before).clamp_min(1e-6)) * step - distance
            nearer = meets & (moved.abs() < best)
            best, shift = torch.where(nearer, moved.abs(), best), torch.where(nearer, moved, shift)
        before = below
    return points + shift * ray


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
    """Screen-space buffers of the opaque scene, one frame each."""

    color: Float[Tensor, "b 3 s s"]
    depth: Float[Tensor, "b 1 s s"]
