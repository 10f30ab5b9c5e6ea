"""What is installed and what it can do here."""

import importlib.metadata
import os
import platform
import shutil
from typing import TYPE_CHECKING, Literal

from catacaustics.config import DoctorConfig

if TYPE_CHECKING:
    import torch


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
    """How a backend was built, its time for a small forward and backward pass and its error against the reference in
    float64, or what is wrong with it."""
    import time

    import torch

    from catacaustics.kernels import find_library

    built, passed_over = "PyTorch", ""
    if backend != "reference":
        library, problem = find_library(backend)
        if library is None:
            return f"not available: {problem}"
        built, passed_over = library.description, f"; passed over: {problem}" if problem else ""
    try:
        expected = _small_splat("reference", torch.float64)
        _small_splat(backend, torch.float32)  # warm up
        start = time.perf_counter()
        results = _small_splat(backend, torch.float32)
        seconds = time.perf_counter() - start
    except Exception as error:  # a report goes on
        return f"FAILED ({built}): {error}"
    for name, wanted in expected.items():
        error = float((results[name] - wanted).abs().max() / wanted.abs().max())
        if not error < 1e-4:
            return f"FAILED ({built}): {name} is off by {error:.1e} of its largest value"
    return f"ok ({built}), {1000 * seconds:.0f} ms forward and backward (2000 splats, 160 x 120){passed_over}"


def _small_splat(backend: Literal["reference", "cpu", "cuda"], dtype: "torch.dtype") -> "dict[str, torch.Tensor]":
    """Image, transmittance and all gradients of 2000 splats, in float64 on the CPU."""
    import numpy as np
    import torch

    from catacaustics.cameras import Camera
    from catacaustics.splatting import splat_points
    from catacaustics.splatting.config import SplatConfig
    from catacaustics.splatting.reference import Disks

    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    positions, normals = random(2000, 3) + torch.tensor([-0.5, -0.5, 1.0]), random(2000, 3) - 0.5
    normals = torch.nn.functional.normalize(normals, dim=1)
    values = Disks(positions, normals, 1e-4 * random(2000), 0.1 + 0.8 * random(2000), random(2000, 3))
    device = "cuda" if backend == "cuda" else "cpu"
    disks = Disks(*(value.to(device, dtype).requires_grad_() for value in values))
    camera = Camera(160, 120, 120.0, 120.0, 80.0, 60.0, np.eye(4))
    # With wide supports no pixel is drawn or not by rounding.
    out = splat_points(*disks, camera, config=SplatConfig(support=8.0), backend=backend)
    (out.image**2).sum().backward()
    results = {"the image": out.image, "the transmittance": out.transmittance}
    for name, disk in disks._asdict().items():
        results[f"the gradient of {name}"] = disk.grad
    return {name: result.detach().double().cpu() for name, result in results.items()}


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
