"""Warps: where a reflection point is displayed for a camera centre (paper section 4).

Every warp is a module with forward(positions (n, 3), center (3,)) -> displayed positions (n, 3).
"""

import itertools

import torch
from torch import Tensor, nn

from catacaustics.shapes import Float


class StaticWarp(nn.Module):
    """p' = p: flat mirrors and painted-on highlights, whose image does not move with the camera."""

    def forward(self, positions: Float[Tensor, "n 3"], center: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
        return positions


class NeuralWarp(nn.Module):
    """p' = p + F(p, c), an MLP of position and camera centre, both normalised to [-1, 1] (paper section 4.2).

    Args:
        low, high: (3,) corners of a box around the reflection points and the camera centres.
        layers, width: hidden layers and their width (paper: 4 x 256).
    """

    def __init__(self, low: Float[Tensor, "3"], high: Float[Tensor, "3"], layers: int = 4, width: int = 256):
        super().__init__()
        self.register_buffer("middle", (low + high) / 2)
        # One scale for all axes keeps directions undistorted.
        self.register_buffer("half_size", ((high - low) / 2).max())
        sizes = [6] + [width] * layers
        hidden = [m for a, b in itertools.pairwise(sizes) for m in (nn.Linear(a, b), nn.ReLU())]
        self.network = nn.Sequential(*hidden, nn.Linear(width, 3))

    def forward(self, positions: Float[Tensor, "n 3"], center: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
        p = (positions - self.middle) / self.half_size
        c = ((center - self.middle) / self.half_size).expand_as(p)
        # Scaled so that training starts with almost no motion.
        return positions + 0.01 * self.half_size * self.network(torch.cat([p, c], -1))
