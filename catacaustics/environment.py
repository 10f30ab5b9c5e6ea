"""A latitude-longitude map of features for what is farther away than any point."""

import math

import torch
from torch import Tensor, nn

from catacaustics.renderer import FEATURES
from catacaustics.shapes import Float


class EnvironmentMap(nn.Module):
    """Features by direction, zero at the start (paper: 1000 x 400, 6 channels)."""

    def __init__(self, width: int = 1000, height: int = 400):
        super().__init__()
        self.features = nn.Parameter(torch.zeros(FEATURES, height, width))

    def forward(self, directions: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 6"]:
        """Bilinear lookup for unit world directions; longitude wraps around, the poles are the y axis."""
        x, y, z = directions.unbind(-1)
        columns = self.features.shape[2]
        # One column more on either side, so that the seam is interpolated too.
        padded = torch.nn.functional.pad(self.features[None], (1, 1, 0, 0), mode="circular")
        longitude = torch.atan2(x, z) / math.pi * columns / (columns + 2)
        latitude = torch.asin(y.clamp(-1, 1)) / (math.pi / 2)
        grid = torch.stack([longitude, latitude], -1)[None]
        sampled = torch.nn.functional.grid_sample(padded, grid, padding_mode="border", align_corners=False)
        return sampled[0].permute(1, 2, 0)
