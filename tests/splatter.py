"""The splatter as tests call it: tensors of the CPU, whatever the backend under test (fixture `backend`)."""

import functools
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

import torch

from catacaustics import splatting
from catacaustics.kernels import Found, NativeError, find_library, load_library

BACKENDS = ("reference", "cpu", "cuda", "emulated")
KERNELS = Path(__file__).parent.parent / "cuda_ext"
EMULATION = Path(__file__).parent / "cuda_emulation"


class _Device:
    name = "cpu"
    backend = ""


device = _Device()
errors: dict[tuple[str, str], dict[str, float]] = {}
"""Largest errors seen: by backend and type, then by result; shares of the largest value."""


def note_error(dtype: torch.dtype, result: str, error: float) -> None:
    """Remember an error against the reference in float64, for the table that ends the tests."""
    seen = errors.setdefault((device.backend, str(dtype).removeprefix("torch.")), {})
    seen[result] = max(seen.get(result, 0.0), error)


def splat_points(positions, normals, footprints, opacities, features, camera, *settings, **named):
    """`catacaustics.splatting.splat_points` on the device under test; its results come back, but for `screen`."""
    scene = (t.to(device.name) for t in (positions, normals, footprints, opacities, features))
    out = splatting.splat_points(*scene, camera, *settings, **named)
    return out._replace(image=out.image.cpu(), transmittance=out.transmittance.cpu(), visible=out.visible.cpu())


@functools.cache
def emulated_library() -> Found:
    """The GPU's library compiled for a CPU core: its kernels, binning and memory, thread by thread."""
    compiler = shutil.which("g++") or shutil.which("clang++")
    if not compiler or platform.machine() != "x86_64":
        return Found(None, "the emulation of CUDA needs a C++ compiler on x86-64")
    path = Path(tempfile.mkdtemp()) / "libcatacaustics_emulated.so"
    flags = ["-x", "c++", "-std=c++17", "-O1", "-shared", "-fPIC", "-Wno-unknown-pragmas", f"-I{EMULATION}"]
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
