"""A latitude-longitude map of features for what is farther away than any point."""

import math

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from catacaustics.kernels import host_kernel, library_for
from catacaustics.renderer import FEATURES
from catacaustics.shapes import Float, Int


def texels(directions: Float[Tensor, "n 3"], height: int, width: int) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Rows and columns of a latitude-longitude image that unit directions fall on; the poles are the y axis."""
    x, y, z = directions.unbind(-1)
    column = ((torch.atan2(x, z) / math.pi + 1) / 2 * width).long().clamp(0, width - 1)
    row = ((torch.asin(y.clamp(-1, 1)) / (math.pi / 2) + 1) / 2 * height).long().clamp(0, height - 1)
    return row, column


class EnvironmentMap(nn.Module):
    """Features by direction, zero at the start (paper: 1000 x 400, 6 channels).

    Args:
        width, height: texels.
        up: (3,) world direction of a pole, where columns meet: one that photographs hardly show; -y left out.
    """

    axes: Tensor

    def __init__(self, width: int = 1000, height: int = 400, up: Float[Tensor, "3"] | None = None):
        super().__init__()
        down = torch.tensor([0.0, 1.0, 0.0]) if up is None else -torch.nn.functional.normalize(up, dim=0)
        across = torch.eye(3)[2 if abs(float(down[2])) < 0.9 else 0]
        right = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=0)
        self.register_buffer("axes", torch.stack([right, down, torch.linalg.cross(right, down)]))
        self.features = nn.Parameter(torch.zeros(height, width, FEATURES))

    def start_from(
        self, directions: Float[Tensor, "n 3"], colors: Float[Tensor, "n 3"], weights: Float[Tensor, "n"]
    ) -> None:
        """Set the colours (the first three features) to weighted means of what was seen; texels that saw little take
        them from coarser levels (push-pull, Gortler et al. 1996)."""
        height, width, _ = self.features.shape
        row, column = texels(directions @ self.axes.T, height, width)
        sums = colors.new_zeros(4, height * width)
        sums.index_add_(1, row * width + column, torch.cat([colors * weights[:, None], weights[:, None]], 1).T)
        levels = [sums.view(1, 4, height, width)]
        while max(levels[-1].shape[2:]) > 1:
            levels.append(4 * torch.nn.functional.avg_pool2d(levels[-1], 2, ceil_mode=True, count_include_pad=False))
        filled = levels[-1][:, :3] / levels[-1][:, 3:].clamp_min(1e-6)
        for level in reversed(levels[:-1]):
            coarse = torch.nn.functional.interpolate(filled, level.shape[2:], mode="bilinear", align_corners=False)
            # A prior of one pixel's weight from the coarser level.
            filled = (level[:, :3] + coarse) / (level[:, 3:] + 1)
        with torch.no_grad():
            self.features[..., :3] = filled[0].permute(1, 2, 0)

    def forward(self, directions: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 6"]:
        """Bilinear lookup for unit world directions; longitude wraps around."""
        x, y, z = self.axes @ directions.flatten(0, 1).T
        height, width, channels = self.features.shape
        column = (torch.atan2(x, z) / math.pi + 1) / 2 * width - 0.5
        # Not up to the poles, where the arc sine has no derivative: the outermost row ends half a texel before.
        latitude = torch.asin(y.clamp(-1 + 1e-7, 1 - 1e-7))
        row = ((latitude / (math.pi / 2) + 1) / 2 * height - 0.5).clamp(0, height - 1)
        native = host_kernel("environment", self.features) and row.dtype == self.features.dtype
        found = _NativeLookup.apply(self.features, row, column) if native else _lookup(self.features, row, column)
        return found.view(*directions.shape[:2], channels)


def _lookup(
    features: Float[Tensor, "height width channels"], row: Float[Tensor, "n"], column: Float[Tensor, "n"]
) -> Float[Tensor, "n channels"]:
    """Bilinear lookup at fractional rows in [0, height - 1] and columns, which wrap around."""
    height, width, channels = features.shape
    left, top = column.detach().floor(), row.detach().floor()
    right_share, lower_share = column - left, row - top
    columns = torch.stack([left, left + 1], 1).long() % width
    rows = torch.stack([top, top + 1], 1).long().clamp(max=height - 1)
    shares = (
        torch.stack([1 - lower_share, lower_share], 1)[:, :, None]
        * torch.stack([1 - right_share, right_share], 1)[:, None, :]
    )
    texel = rows[:, :, None] * width + columns[:, None, :]
    # Reads rows of the table: a map of its size is never copied.
    found = features.view(-1, channels).index_select(0, texel.flatten()).view(-1, 4, channels)
    return (shares.view(-1, 4, 1) * found).sum(1)


class _NativeLookup(torch.autograd.Function):
    """`_lookup` in native code; gradients are the same bit for bit in every run."""

    @staticmethod
    def forward(ctx, features, row, column):
        features, row, column = (t.contiguous() for t in (features, row, column))
        ctx.save_for_backward(features, row, column)
        found = features.new_empty(len(row), features.shape[2])
        library_for(features).call("environment", features, len(row), *features.shape, features, row, column, found)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx, g_found):  # pyright: ignore[reportIncompatibleMethodOverride]
        gradients = [
            torch.empty_like(t) if wanted else None
            for t, wanted in zip(ctx.saved_tensors, ctx.needs_input_grad, strict=True)
        ]
        features, row, _ = ctx.saved_tensors
        sizes, inputs = (len(row), *features.shape), (*ctx.saved_tensors, g_found.contiguous())
        library_for(features).call("environment_backward", features, *sizes, *inputs, *gradients)
        return tuple(gradients)
