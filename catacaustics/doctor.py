"""What is installed and what it can do here."""

import importlib.metadata
import os
import platform
import shutil
from typing import Literal

from catacaustics.config import DoctorConfig


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _stereo() -> str:
    if not _version("pycolmap"):
        return "pycolmap is not installed: `catacaustics calibrate` needs it; training and rendering do not"
    import pycolmap

    if pycolmap.has_cuda:
        return "COLMAP PatchMatch (CUDA)"
    return "plane sweep in PyTorch (this pycolmap has no CUDA; a CUDA build would use COLMAP PatchMatch)"


def _splat_self_test(backend: Literal["reference", "cpu", "cuda"]) -> str:
    """How a backend was built and its time for a small forward and backward pass, or what is wrong with it."""
    import time

    import numpy as np
    import torch

    from catacaustics.cameras import Camera
    from catacaustics.kernels import find_library
    from catacaustics.splatting import splat_points

    built, device = "PyTorch", "cpu"
    if backend != "reference":
        device = backend
        library, problem = find_library(backend)
        if library is None:
            return f"not available: {problem}"
        built = library.description
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(2000, 3, generator=generator) + torch.tensor([-0.5, -0.5, 1.0])
    positions = positions.to(device).requires_grad_()
    normals = torch.tensor([0.0, 0.0, -1.0], device=device).expand(2000, 3)
    one, camera = torch.ones(2000, 3, device=device), Camera(160, 120, 120.0, 120.0, 80.0, 60.0, np.eye(4))

    def splat() -> float:
        """Features are 1 and the background is black: image and transmittance add up to 1."""
        output = splat_points(positions, normals, 1e-4 * one[:, 0], 0.5 * one[:, 0], one, camera, backend=backend)
        output.image.sum().backward()
        return float(output.image.detach()[..., 0].mean() + output.transmittance.detach().mean())

    try:
        splat()  # warm up
        start = time.perf_counter()
        total = splat()
        seconds = time.perf_counter() - start
    except Exception as error:  # a report goes on
        return f"FAILED ({built}): {error}"
    if abs(total - 1) > 1e-4 or positions.grad is None or not torch.isfinite(positions.grad).all():
        return f"FAILED ({built}): opacity and transmittance add up to {total:.6f} instead of 1"
    return f"ok ({built}), {1000 * seconds:.0f} ms forward and backward (2000 splats, 160 x 120)"


def doctor(config: DoctorConfig) -> None:
    """Print a report for people and bug reports."""
    import torch

    cuda = torch.cuda.get_device_name() if torch.cuda.is_available() else "none: training runs on the CPU"
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30 if hasattr(os, "sysconf") else 0
    rows = [
        ("catacaustics", _version("catacaustics")),
        ("python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"),
        ("processor", f"{os.cpu_count()} cores, torch uses {torch.get_num_threads()} threads, {memory:.0f} GiB"),
        ("GPU", cuda),
        ("free disk here", f"{shutil.disk_usage('.').free / 2**30:.0f} GiB"),
        ("splatter: reference", _splat_self_test("reference")),
        ("splatter: cpu", _splat_self_test("cpu")),
        ("splatter: cuda", _splat_self_test("cuda")),
        ("multi-view stereo", _stereo()),
    ]
    packages = ["torch", "numpy", "scipy", "pycolmap", "open3d", "opencv-contrib-python-headless", "torchmetrics"]
    packages += ["flip-evaluator", "safetensors", "plyfile", "av", "matplotlib", "mitsuba", "lpips"]
    optional = {"mitsuba": "optional, for making scenes", "lpips": "optional, for the LPIPS metric"}
    rows += [(name, _version(name) or f"not installed ({optional.get(name, 'needed')})") for name in packages]
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:<{width}}  {value}")
