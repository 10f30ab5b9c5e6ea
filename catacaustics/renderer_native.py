"""The neural renderer in native code, for CPUs (cuda_ext/cpu/network.cpp); renderer.py is what it has to agree with."""

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from catacaustics.kernels import host_kernel, library_for


def _addresses(tensors: Sequence[Tensor]) -> ctypes.Array:
    return (ctypes.c_void_p * len(tensors))(*(t.data_ptr() for t in tensors))


def _sizes(primary: Tensor, parameters: Sequence[Tensor]) -> tuple[int, int, int, int]:
    """Pixels, features, width, residual blocks: three MLPs of 2 + 5 blocks parameters, and the head's 2."""
    return primary[..., 0].numel(), primary.shape[-1], len(parameters[1]), (len(parameters) - 8) // 15


class _Decode(torch.autograd.Function):
    """Not an operator of torch.library: those take 0.3 ms more for this many tensors."""

    @staticmethod
    def forward(ctx, primary: Tensor, reflection: Tensor, directions: Tensor, *parameters: Tensor) -> Tensor:
        inputs = [t.contiguous() for t in (primary, reflection, directions)]
        parameters = tuple(p.contiguous() for p in parameters)
        image = directions.new_empty(directions.shape)
        sizes, addresses = _sizes(primary, parameters), _addresses(parameters)
        library_for(primary).call("network", primary, *sizes, *inputs, addresses, image)
        ctx.save_for_backward(*inputs, *parameters)
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx, g_image: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        tensors, needed = ctx.saved_tensors, ctx.needs_input_grad
        inputs, parameters = tensors[:3], tensors[3:]
        learns = any(needed[3:])
        g = [torch.empty_like(t) if n else None for t, n in zip(inputs, needed[:3], strict=True)]
        g_parameters = [torch.empty_like(p) for p in parameters] if learns else []
        sizes, addresses = _sizes(inputs[0], parameters), _addresses(parameters)
        gradients = (g_image.contiguous(), *g, _addresses(g_parameters) if learns else None)
        library_for(inputs[0]).call("network_backward", inputs[0], *sizes, *inputs, addresses, *gradients)
        return *g, *(g_parameters if learns else [None] * len(parameters))


def decode(primary: Tensor, reflection: Tensor, directions: Tensor, parameters: Sequence[Tensor]) -> Tensor | None:
    """RGB of a NeuralRenderer with these parameters (in the order of its `parameters()`); differentiable once in all.

    Args:
        primary, reflection: (height, width, 6). directions: (height, width, 3).

    Returns:
        (height, width, 3), or None where PyTorch is to compute it (see `host_kernel`).
    """
    tensors = (reflection, directions, *parameters)
    kind = primary.dtype, primary.device
    if host_kernel("network", primary) is None or any((t.dtype, t.device) != kind for t in tensors):
        return None
    return _Decode.apply(primary, *tensors)
