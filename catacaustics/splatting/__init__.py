"""EWA splatting of oriented disks: one entry, several backends that compute the same."""

import functools
import logging
import os
from typing import Literal, get_args

import torch
from torch import Tensor

from catacaustics.cameras import Camera, Viewport
from catacaustics.config import SplatConfig
from catacaustics.errors import UserError
from catacaustics.shapes import Float
from catacaustics.splatting import native, reference
from catacaustics.splatting.library import find_library
from catacaustics.splatting.reference import Disks, SplatOutput, check_shapes, points_in_view

__all__ = ["Backend", "SplatOutput", "backend_for", "points_in_view", "splat_points"]

Backend = Literal["auto", "reference", "cpu", "cuda"]
_CHOICE = "CATACAUSTICS_SPLATTER"


@functools.cache
def _say_once(message: str) -> None:
    logging.getLogger("catacaustics").warning(message)


@torch.compiler.assume_constant_result
def backend_for(device: str, backend: Backend | None = None) -> str:
    """The backend that splats tensors of a device: `cpu`, `cuda` (native code) or `reference` (PyTorch).

    Args:
        device: "cpu" or "cuda".
        backend: which one to take; None asks the environment variable CATACAUSTICS_SPLATTER. auto takes the fastest
            there is, and says so once where that is the reference.

    Raises:
        UserError: no such backend, or it does not run here.
    """
    choice = backend or os.environ.get(_CHOICE) or "auto"
    if choice not in get_args(Backend):
        known = ", ".join(get_args(Backend))
        raise UserError(f"splatter backend {choice!r}", known, f"check {_CHOICE} in the environment")
    if choice == "reference":
        return "reference"
    if choice not in ("auto", device):
        raise UserError(f"splatter backend {choice} for tensors on {device}", f"{device} or auto", "use backend auto")
    problem = find_library(device).problem if device in ("cpu", "cuda") else f"there is none for {device}"
    if not problem:
        return device
    if choice == device:
        raise UserError(
            f"no native splatter: {problem}",
            "the libraries that the build installs into catacaustics/_native",
            "use backend auto, or install again with the compiler; `catacaustics doctor` shows what there is",
        )
    _say_once(f"splatting in PyTorch, which is many times slower than native code: {problem}")
    return "reference"


def splat_points(
    positions: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    footprints: Float[Tensor, "n"],
    opacities: Float[Tensor, "n"],
    features: Float[Tensor, "n channels"],
    camera: Camera,
    viewport: Viewport | None = None,
    config: SplatConfig | None = None,
    backend: Backend | None = None,
) -> SplatOutput:
    """Splat oriented disks into a viewport; differentiable in every tensor.

    Points at equal depth keep their input order. The colour is not normalised and has no background: blend one with
    `transmittance`.

    Args:
        positions, normals: world space; normals of unit length.
        footprints: squared radii, world units squared, non-negative.
        opacities: in [0, 1].
        camera: pinhole camera in world units.
        viewport: pixels to compute; the whole image by default.
        backend: see `backend_for`.

    Raises:
        ValueError: wrong shapes, types or devices, values that are not finite or out of range; the argument is named.
        UserError: the backend does not run here.
    """
    disks = Disks(positions, normals, footprints, opacities, features)
    check_shapes(disks)
    splat = reference.splat if backend_for(positions.device.type, backend) == "reference" else native.splat
    return splat(disks, camera, viewport or camera.viewport, config or SplatConfig())
