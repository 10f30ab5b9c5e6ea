"""Images in quadrics in native code: what quadric.specular_points and warps._displayed compute, in one pass on a CPU.

Newton's method starts between the directions of camera and source and needs no angles; concave mirrors, which have
several images, are solved in PyTorch.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from catacaustics.kernels import host_kernel, library_for
from catacaustics.reflectors import quadric
from catacaustics.shapes import Bool, Float


class QuadricImages(NamedTuple):
    """Fields of warps.Displayed of the same names; `normals`, `stretch` and `visible` None where `start` was given."""

    positions: Float[Tensor, "n 3"]
    near: Float[Tensor, "n"]
    start: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"] | None = None
    stretch: Float[Tensor, "n"] | None = None
    visible: Bool[Tensor, "n"] | None = None


def quadric_images(
    sources: Float[Tensor, "n 3"],
    camera: Float[Tensor, "3"],
    center: Float[Tensor, "3"],
    axes: Float[Tensor, "3 3"],
    concave: bool,
    start: Float[Tensor, "n 3"] | None,
) -> QuadricImages | None:
    """Images of sources in a sphere or an ellipsoid, see quadric.specular_points for the arguments. Positions have
    gradients to sources, camera, center and axes. None where there is no kernel for the tensors."""
    kernel = host_kernel("quadric_images", sources)
    if kernel is None:
        return None
    inputs = (sources, camera, center, axes)
    if start is not None:
        positions, near = _Positions.apply(*inputs, start)
        return QuadricImages(positions, near, start)
    a, b, c, d = (t.detach().contiguous() for t in inputs)
    n = len(sources)
    u = quadric.stationary(a, b, c, d, concave) if concave else sources.new_empty(n, 3)
    positions, normals = sources.new_empty(n, 3), sources.new_empty(n, 3)
    stretch, near = sources.new_empty(n), sources.new_empty(n)
    visible = torch.empty(n, dtype=torch.bool)
    kernel(n, a, b, c, d, concave, not concave, u, positions, normals, stretch, near, visible)
    if torch.is_grad_enabled() and any(t.requires_grad for t in inputs):
        positions, near = _Positions.apply(*inputs, u)
    return QuadricImages(positions, near, u, normals, stretch, visible)


class _Positions(torch.autograd.Function):
    """Displayed positions, and distances of the points of reflection from the camera, for known solutions. An autograd
    function and not an operator of torch's, which takes longer to call than the kernel takes."""

    @staticmethod
    def forward(
        ctx, sources: Tensor, camera: Tensor, center: Tensor, axes: Tensor, start: Tensor
    ) -> tuple[Tensor, Tensor]:
        inputs = [t.contiguous() for t in (sources, start, camera, center, axes)]
        positions, near = torch.empty_like(inputs[0]), sources.new_empty(len(sources))
        library_for(sources).call("quadric_positions", sources, len(sources), *inputs, positions, near)
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(near)
        return positions, near

    @staticmethod
    @once_differentiable
    def backward(ctx, g: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        sources = ctx.saved_tensors[0]
        g_sources, g_mirror = torch.empty_like(sources), sources.new_empty(15)
        gradients = (g.contiguous(), g_sources, g_mirror)
        library_for(sources).call("quadric_backward", sources, len(sources), *ctx.saved_tensors, *gradients)
        return g_sources, g_mirror[:3], g_mirror[3:6], g_mirror[6:].view(3, 3), None
