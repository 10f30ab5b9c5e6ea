"""Training losses (paper section 5.1). Images are (height, width, channels) in [0, 1]."""

import torch
from torch import Tensor

from catacaustics.shapes import Bool, Float

_WINDOW = 11
_SIGMA = 1.5


def ssim_map(
    image: Float[Tensor, "height width channels"], target: Float[Tensor, "height width channels"]
) -> Float[Tensor, "h w channels"]:
    """Structural similarity (Wang et al. 2004) with an 11 x 11 Gaussian window of sigma 1.5 and data range 1.

    Only windows that lie inside the image are evaluated: h = height - 10, w = width - 10. For images narrower than the
    window, the window shrinks to the image.
    """
    size = min(_WINDOW, *image.shape[:2])
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    stack = torch.stack([x, y, x * x, y * y, x * y])
    rows, columns = (_blur_matrix(n, size, image) for n in image.shape[:2])
    mx, my, xx, yy, xy = rows @ (stack @ columns.T)
    c1, c2 = 0.01**2, 0.03**2
    covariance = xy - mx * my
    variances = (xx - mx * mx) + (yy - my * my)
    value = (2 * mx * my + c1) * (2 * covariance + c2) / ((mx * mx + my * my + c1) * (variances + c2))
    return value.permute(1, 2, 0)


def _blur_matrix(length: int, size: int, like: Tensor) -> Tensor:
    """The window along one axis as a banded matrix (length - size + 1, length): several times as fast, with its
    gradient, as a convolution of single channels."""
    offset = torch.arange(size, dtype=like.dtype, device=like.device) - (size - 1) / 2
    kernel = torch.exp(-(offset**2) / (2 * _SIGMA**2))
    count = length - size + 1
    matrix = like.new_zeros(count, length)
    matrix.as_strided((count, size), (length + 1, 1)).copy_(kernel / kernel.sum())
    return matrix


def dssim(
    image: Float[Tensor, "height width channels"], target: Float[Tensor, "height width channels"]
) -> Float[Tensor, ""]:
    """Structural dissimilarity (1 - SSIM) / 2, mean over pixels and channels."""
    return (1 - ssim_map(image, target).mean()) / 2


def coverage_loss(
    reflection_transmittance: Float[Tensor, "height width"], mask: Bool[Tensor, "height width"]
) -> Float[Tensor, ""]:
    """Lp: mean transmittance of the reflection cloud over the projected volume: fills it, no effect outside.

    The paper's text calls T_out accumulated opacity; taken to the letter it would empty the reflector.
    """
    return (reflection_transmittance * mask).sum() / mask.sum().clamp_min(1)


def weight_loss(rho: Float[Tensor, "height width"], mask: Bool[Tensor, "height width"]) -> Float[Tensor, ""]:
    """Lm: |rho - mask of the projected volume|, mean over pixels."""
    return (rho - mask.to(rho.dtype)).abs().mean()


def total_variation(image: Float[Tensor, "height width *channels"]) -> Float[Tensor, ""]:
    """Anisotropic total variation, mean absolute difference along both axes (0 for an image of one pixel)."""
    total = image.new_zeros(())
    for difference in (image.diff(dim=0), image.diff(dim=1)):
        if difference.numel():
            total = total + difference.abs().mean()
    return total
