"""The splatter as tests call it: tensors of the CPU, whatever the backend under test (fixture `backend`).

Scenes, cameras, one table of tolerances, and the comparison with the reference in float64 on the same numbers.
"""

import dataclasses
import functools
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

from catacaustics import splatting
from catacaustics.cameras import Camera
from catacaustics.geometry import look_at
from catacaustics.kernels import Found, NativeError, find_library, load_library
from catacaustics.splatting.config import SplatConfig

BACKENDS = ("reference", "cpu", "cuda", "emulated")
KERNELS = Path(__file__).parent.parent / "cuda_ext"
EMULATION = Path(__file__).parent / "cuda_emulation"
NAMES = ("positions", "normals", "footprints", "opacities", "features")
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
needs_native = pytest.mark.skipif(
    find_library("cpu").library is None, reason=f"no native splatter: {find_library('cpu').problem}"
)

# Largest difference from the reference in float64, as a share of the largest value of each result.
TOLERANCE = {torch.float32: 2e-5, torch.float64: 1e-13}
# No pixel lies where rounding decides whether it is drawn.
WIDE = SplatConfig(support=8.0)
# Sides of a guard band that drops nothing.
EVERYWHERE = [-1e9, -1e9, 1e9, 1e9]


class _Device:
    name = "cpu"
    backend = ""


device = _Device()
errors: dict[tuple[str, str, str], dict[str, float]] = {}
"""Largest errors seen: by backend, type and case, then by result; shares of the largest value."""


def note_error(dtype: torch.dtype, case: str, result: str, error: float) -> None:
    """Remember an error against the reference in float64, for the table that ends the tests."""
    seen = errors.setdefault((device.backend, str(dtype).removeprefix("torch."), case), {})
    seen[result] = max(seen.get(result, 0.0), error)


def splat_points(positions, normals, footprints, opacities, features, camera, *settings, **named):
    """`catacaustics.splatting.splat_points` on the device under test; its results come back, but for `screen`."""
    scene = (t.to(device.name) for t in (positions, normals, footprints, opacities, features))
    out = splatting.splat_points(*scene, camera, *settings, **named)
    return out._replace(image=out.image.cpu(), transmittance=out.transmittance.cpu(), visible=out.visible.cpu())


def front_camera(width=24, height=18, focal=30.0):
    return Camera(width, height, focal, focal * 1.1, width / 2 + 0.3, height / 2 - 0.2, np.eye(4))


def moved_camera(width=24, height=18, focal=30.0, dtype=torch.float64):
    """Shifted and turned; sees what `front_camera` sees. Its pose is rounded to a type: all are given the same one."""
    pose = look_at(np.array([0.3, -0.2, -0.5]), np.array([0.0, 0.0, 1.5]), np.array([0.0, -1.0, 0.1]))
    pose = torch.tensor(pose).to(dtype).double().numpy()
    return dataclasses.replace(front_camera(width, height, focal), camera_from_world=pose)


def pinhole(width, height=None, focal=10.0):
    height = height or width
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def random_scene(n, channels=3, seed=0, dtype=torch.float64, size=0.02):
    g = torch.Generator().manual_seed(seed)
    positions = torch.rand(n, 3, generator=g, dtype=dtype) * torch.tensor([1.0, 0.8, 1.0]) + torch.tensor(
        [-0.5, -0.4, 1.0]
    )
    normals = torch.nn.functional.normalize(torch.randn(n, 3, generator=g, dtype=dtype), dim=1)
    footprints = size**2 * (0.5 + torch.rand(n, generator=g, dtype=dtype))
    opacities = 0.05 + 0.9 * torch.rand(n, generator=g, dtype=dtype)
    features = torch.rand(n, channels, generator=g, dtype=dtype)
    return [t.to(dtype) for t in (positions, normals, footprints, opacities, features)]


def facing(depths, opacities, features, footprint=1e-4, dtype=torch.float32):
    """Disks on the axis of a pinhole camera, facing it."""
    n = len(depths)
    positions = torch.zeros(n, 3, dtype=dtype)
    positions[:, 2] = torch.as_tensor(depths, dtype=dtype)
    normals = torch.tensor([[0.0, 0, -1]], dtype=dtype).expand(n, 3)
    features = torch.as_tensor(features, dtype=dtype).reshape(n, -1)
    opacities = torch.as_tensor(opacities, dtype=dtype).expand(n).clone()
    return [positions, normals, torch.full((n,), footprint, dtype=dtype), opacities, features]


def weighted_sum(image, transmittance, pixels=None):
    """A loss that weighs every value differently; only those of `pixels` (height, width), where given, count."""
    g = torch.Generator().manual_seed(5)
    weights = torch.rand((*image.shape[:2], image.shape[2] + 1), generator=g, dtype=image.dtype) - 0.3
    if pixels is not None:
        weights = weights * pixels[..., None]
    return (image * weights[..., 1:]).sum() + (transmittance * (weights[..., 0] + 0.5)).sum()


def results(scene, camera, viewport=None, config=WIDE, backend=None, pixels=None):
    """Image, transmittance and every gradient of `weighted_sum`, by name, as float64."""
    scene = [t.detach().clone().requires_grad_() for t in scene]
    out = splat_points(*scene, camera, viewport, config, backend)
    out.screen.retain_grad()
    weighted_sum(out.image.double(), out.transmittance.double(), pixels).backward()
    named = {"image": out.image, "transmittance": out.transmittance}
    if len(out.visible):
        # By point: two backends may put points that are drawn nowhere on different sides of the cull.
        screen = torch.zeros(len(scene[0]), 2, dtype=torch.float64)
        named["screen"] = screen.index_copy(0, out.visible, out.screen.grad.double().cpu())
    if pixels is not None:
        named |= {"image": out.image * pixels[..., None], "transmittance": out.transmittance * pixels}
    grads = {name: torch.zeros_like(t) if t.grad is None else t.grad for name, t in zip(NAMES, scene, strict=True)}
    return {name: t.detach().double() for name, t in (named | grads).items()}


def reference_results(scene, camera, viewport=None, config=WIDE, pixels=None):
    """The same of the reference in float64, on the same numbers."""
    return results([t.double() for t in scene], camera, viewport, config, "reference", pixels)


def tangential(gradients, normals):
    """Gradients to normals without what lies along the normal itself, where a unit vector never moves: formulas that
    agree about unit normals may differ there."""
    n = normals.double()
    return gradients - (gradients * n).sum(1, keepdim=True) * n


def assert_close(got, want, dtype, case, factor=1.0, least=1e-30, room=0.0):
    """Results of one type agree with those of the reference in float64.

    Args:
        factor: how much more than TOLERANCE is allowed.
        least: errors are shares of the largest value, or of this one where that is smaller.
        room: how much error does not count, absolute.
    """
    for name, expected in want.items():
        value = got.get(name, torch.zeros_like(expected))
        assert value.shape == expected.shape
        assert torch.isfinite(value).all(), name
        if expected.numel():
            error = max(float((value - expected).abs().max()) - room, 0) / max(float(expected.abs().max()), least)
            note_error(dtype, case, name, error)
            allowed = factor * TOLERANCE[dtype]
            assert error <= allowed, f"{name}: off by {error:.2e} of the largest value, allowed {allowed:.2e}"


def assert_like_reference(scene, camera, viewport=None, config=WIDE, *, case, pixels=None, want=None, **allowed):
    """The backend under test agrees with the reference in float64; `want` gives results of that which are at hand."""
    got = results(scene, camera, viewport, config, None, pixels)
    want = want or reference_results(scene, camera, viewport, config, pixels)
    assert_close(got, want, scene[0].dtype, case, **allowed)
    return got


@functools.cache
def emulated_library() -> Found:
    """The GPU's library compiled for a CPU core: its kernels, binning and memory, thread by thread."""
    compiler = shutil.which("g++") or shutil.which("clang++")
    if not compiler or platform.machine() != "x86_64" or sys.platform != "linux":
        return Found(None, "the emulation of CUDA needs a C++ compiler on x86-64 Linux")
    path = Path(tempfile.mkdtemp()) / "libcatacaustics_emulated.so"
    flags = ["-x", "c++", "-std=c++17", "-O1", "-shared", "-fPIC", "-Wno-unknown-pragmas", f"-I{EMULATION}"]
    flags += ["-fdata-sections", f"-Wl,-T,{EMULATION / 'shared_memory.ld'}"]
    sources = sorted(map(str, (KERNELS / "cuda").glob("*.cu")))
    command = [compiler, *flags, "-DCATACAUSTICS_ARCHS=one CPU core", *sources, "-o", str(path)]
    subprocess.run(command, check=True, timeout=200)
    return Found(load_library(path), "")


def problem(backend: str) -> str:
    """Why a backend cannot be tested here; empty where it can."""
    if backend == "reference":
        return ""
    try:
        found = emulated_library() if backend == "emulated" else find_library(backend)
        return "" if found.library else found.problem
    except NativeError as error:
        return str(error)
