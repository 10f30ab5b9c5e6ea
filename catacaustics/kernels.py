"""Native kernels: libraries found, checked, loaded with ctypes and called.

`cuda_ext/` builds one library for each level of x86-64 (one plain library elsewhere), and one for NVIDIA's GPUs where
there is a CUDA compiler, into `catacaustics/_native`. All have the C ABI of `cuda_ext/abi.h`. A library that is
missing, damaged, made for another processor or without a GPU to run on is refused with a reason; nothing here ends the
process.
"""

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import struct
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

import catacaustics
from catacaustics.errors import UserError

Backend = Literal["auto", "reference", "cpu", "cuda"]
_CHOICE = "CATACAUSTICS_BACKEND"

_ABI = 3
INVALID_VALUES = -1
_OUT_OF_MEMORY, _TOO_LARGE = -2, -3
# Best first.
_NAMES = {
    "cpu": ("catacaustics_cpu_v4", "catacaustics_cpu_v3", "catacaustics_cpu_v2", "catacaustics_cpu"),
    "cuda": ("catacaustics_cuda",),
}
_ALLOCATE = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int64)
_P, _I, _D = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
# Of the splatter, in every library.
_SIGNATURES = {
    "project": [_P, _I, *[_P] * 6, *[_I] * 4, *[_D] * 8, *[_P] * 3],
    "project_backward": [_P, _I, *[_P] * 5, _D, _I, _P, *[_P] * 7],
    "bin": [_P, _I, *[_P] * 4, *[_I] * 4, *[_D] * 2, *[_P] * 3],
    "blend": [_P, _I, _I, *[_P] * 5, *[_I] * 4, _D, *[_P] * 2],
    "blend_backward": [_P, _I, _I, *[_P] * 5, *[_I] * 4, _D, *[_P] * 6],
    "finite": [_P, _P, _I],
}
# In the CPU's libraries alone: PyTorch does these on a GPU.
_HOST_SIGNATURES = {
    "adam": [_P, _I, _I, _P, _P, *[_D] * 5, *[_P] * 4],
    "cull": [_P, _I, *[_P] * 4, *[_I] * 4, *[_D] * 7, _P],
    "environment": [_P, _I, *[_I] * 3, *[_P] * 4],
    "environment_backward": [_P, _I, *[_I] * 3, *[_P] * 7],
    "network": [_P, *[_I] * 4, *[_P] * 5],
    "network_backward": [_P, *[_I] * 4, *[_P] * 9],
    "quadric_images": [_P, _I, *[_P] * 4, _I, _I, *[_P] * 6],
    "quadric_positions": [_P, _I, *[_P] * 7],
    "quadric_backward": [_P, _I, *[_P] * 8],
}


class NativeError(Exception):
    """Why a native library cannot be used."""


class _Run(ctypes.Structure):
    """How a call runs: `Run` of cuda_ext/abi.h."""

    _fields_ = [
        ("allocate", _ALLOCATE),
        ("threads", ctypes.c_int64),
        ("stream", ctypes.c_void_p),
        ("device", ctypes.c_int64),
        ("deterministic", ctypes.c_int64),
    ]


class _Memory:
    """Blocks of bytes that a call asks for, and why there was none."""

    def __init__(self, device: torch.device):
        self.blocks: list[Tensor] = []
        self.error: Exception | None = None
        self._device = device

    def allocate(self, size: int) -> int | None:
        try:
            self.blocks.append(torch.empty(size, dtype=torch.uint8, device=self._device))
            return self.blocks[-1].data_ptr()
        except Exception as error:  # out of memory: nothing may be raised through C
            self.error = error
            return None


class NativeLibrary(NamedTuple):
    """A loaded library: where it lies, how it was built, the side of its tiles in pixels."""

    path: Path
    description: str
    tile: int
    handle: ctypes.CDLL

    def call(
        self, name: str, like: Tensor, *arguments: object, deterministic: bool = False
    ) -> tuple[int, list[Tensor]]:
        """Call a function for the scalar type and the device of `like`; tensors pass as their address.

        Tensors must be contiguous and on that device. The CPU uses as many threads as torch, the GPU torch's stream.

        Returns:
            what the function returned, and the blocks of bytes that it asked for.

        Raises:
            MemoryError, ValueError: out of memory; more points or pixels than the library can number.
            NativeError: the GPU failed.
        """
        memory = _Memory(like.device)
        on_gpu = like.device.type == "cuda"
        stream = torch.cuda.current_stream(like.device).cuda_stream if on_gpu else None
        run = _Run(_ALLOCATE(memory.allocate), torch.get_num_threads(), stream, like.device.index or 0, deterministic)
        function = getattr(self.handle, f"catacaustics_{name}_{'f32' if like.dtype == torch.float32 else 'f64'}")
        values = [a.data_ptr() if isinstance(a, Tensor) else a for a in arguments]
        with torch.cuda.device(like.device) if on_gpu else contextlib.nullcontext():
            status = function(ctypes.byref(run), *values)
        if status >= 0 or status == INVALID_VALUES:
            return status, memory.blocks
        if status == _OUT_OF_MEMORY:
            raise MemoryError("a native kernel ran out of memory") from memory.error
        if status == _TOO_LARGE:
            raise ValueError(
                "the native splatter takes up to 2^31 points, viewports of up to a million pixels a side, and on a GPU"
                " 2^31 entries in the lists of its tiles"
            )
        raise NativeError(f"{self.path.name}: {self.handle.catacaustics_problem().decode()}")

    def bin(self, like: Tensor, *arguments: object) -> Tensor:
        """Call `bin`; returns the list that it has asked for."""
        entries = ctypes.c_void_p()
        count, blocks = self.call("bin", like, *arguments, ctypes.byref(entries))
        listed = next(block for block in blocks if block.data_ptr() == entries.value)
        return listed[: 4 * count].view(torch.int32)


def load_library(path: Path) -> NativeLibrary:
    """Load one native library after checking that it is whole, made for this machine, and right about one splat.

    Raises:
        NativeError: it is not; the message says why.
    """
    _check_file(path)
    try:
        handle = ctypes.CDLL(str(path))
        handle.catacaustics_abi.restype = handle.catacaustics_tile.restype = ctypes.c_int64
        abi = handle.catacaustics_abi()
        if abi != _ABI:
            raise NativeError(f"{path.name} has interface version {abi}, this package needs {_ABI}: build it again")
        handle.catacaustics_description.restype = handle.catacaustics_problem.restype = ctypes.c_char_p
        description, problem = handle.catacaustics_description().decode(), handle.catacaustics_problem().decode()
        if problem:
            raise NativeError(f"{path.name} ({description}): {problem}")
        host = path.stem.startswith("libcatacaustics_cpu")
        for name, arguments in (_SIGNATURES | (_HOST_SIGNATURES if host else {})).items():
            for suffix in ("f32", "f64"):
                function = getattr(handle, f"catacaustics_{name}_{suffix}")
                function.restype, function.argtypes = ctypes.c_int64, arguments
        library = NativeLibrary(path, description, handle.catacaustics_tile(), handle)
    except (OSError, AttributeError) as error:
        raise NativeError(f"{path.name} cannot be loaded: {error}") from error
    _check_one_splat(library, "cuda" if path.stem.endswith("cuda") else "cpu")
    return library


def _check_file(path: Path) -> None:
    """Refuse a file that is not what was installed, that the system would map beyond its end, or that is for another
    kind of processor (the last two on Linux)."""
    if not path.is_file():
        raise NativeError(f"{path.name} is not there")
    data, sums = path.read_bytes(), path.with_name("SHA256SUMS")
    listed = f"{hashlib.sha256(data).hexdigest()}  {path.name}".encode()
    if sums.is_file() and listed not in sums.read_bytes().splitlines():
        raise NativeError(
            f"{path.name} is not what {sums.name} beside it says: damaged, or copied alone; install again"
        )
    if not sys.platform.startswith("linux"):
        return
    with Path(sys.executable).open("rb") as own:
        python = own.read(64)
    if data[:4] != b"\x7fELF" or len(data) < 64:
        raise NativeError(f"{path.name} is not a shared library")
    if data[4:6] != python[4:6] or data[18:20] != python[18:20]:
        raise NativeError(f"{path.name} was built for another kind of processor")
    start, (size, count) = struct.unpack_from("<Q", data, 32)[0], struct.unpack_from("<HH", data, 54)
    if size < 56 or start + size * count > len(data):
        raise NativeError(f"{path.name} is cut short or damaged")
    for segment in range(start, start + size * count, size):
        offset, length = struct.unpack_from("<Q", data, segment + 8)[0], struct.unpack_from("<Q", data, segment + 32)[0]
        if offset + length > len(data):
            raise NativeError(f"{path.name} is cut short or damaged")


def _check_one_splat(library: NativeLibrary, device: str) -> None:
    """A facing disk of opacity 1/2 over the centre of one pixel leaves half of the light."""
    for dtype in (torch.float32, torch.float64):

        def tensor(values: list, dtype: torch.dtype = dtype) -> Tensor:
            return torch.tensor(values, dtype=dtype, device=device)

        half = tensor([0.5])
        disk = (tensor([[0.0, 0, 2]]), tensor([[0.0, 0, 1]]), half, half)
        view = (tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), tensor([10.0, 10, 0.5, 0.5]))
        window = (0, 0, 1, 1)
        means, forms, visible = tensor([[0.0] * 2]), tensor([[0.0] * 3]), torch.empty(1, dtype=torch.int64).to(device)
        records, starts = tensor([[0.0] * 8]), torch.empty(2, dtype=torch.int64).to(device)
        cuts = (0.3, 3.0, 0.0, 0.01, 0, 0, 1, 1)
        count, _ = library.call("project", half, 1, *disk, *view, *window, *cuts, means, forms, visible)
        splats = (means, forms, half, visible)
        entries = library.bin(half, count, *splats, *window, 3.0, 0.0, records, starts)
        out = tensor([0.0, 0.0])
        if count == len(entries) == 1:
            bins = (half, visible, records, starts, entries)
            library.call("blend", half, 1, 1, *bins, *window, 0.0, out, out[1:])
        if (out.cpu() - torch.tensor([0.25, 0.5], dtype=dtype)).abs().max() > 1e-6:
            raise NativeError(f"{library.path.name} failed its self test: {count} splats, values {out.tolist()}")


class Found(NamedTuple):
    """A library, or None; and why there is none, or no better one."""

    library: NativeLibrary | None
    problem: str


def _folders() -> list[Path]:
    """Where an install, or an editable one, puts libraries."""
    roots = [*catacaustics.__path__, str(Path(sysconfig.get_path("platlib")) / "catacaustics")]
    return [Path(root) / "_native" for root in dict.fromkeys(roots)]


@functools.cache
def find_library(device: str) -> Found:
    """The best library for the tensors of a device ("cpu" or "cuda"), and what is wrong with better ones. Looked for
    once."""
    if device == "cuda" and not torch.cuda.is_available():
        built = any((folder / f"lib{_NAMES[device][0]}.so").is_file() for folder in _folders())
        return Found(None, f"torch sees no NVIDIA GPU (the library for one is {'' if built else 'not '}built)")
    problems = []
    for folder in _folders():
        for path in (folder / f"lib{name}.so" for name in _NAMES[device]):
            if path.is_file():
                try:
                    return Found(load_library(path), "; ".join(problems))
                except NativeError as error:
                    problems.append(str(error))
        failure = folder / "cuda_failure.txt"
        if device == "cuda" and failure.is_file():
            problems.append(f"it could not be built: {failure.read_text().strip()}")
    compiler = {"cpu": "a C++17 compiler (GCC or Clang)", "cuda": "NVIDIA's compiler, nvcc, on the PATH"}[device]
    return Found(None, "; ".join(problems) or f"not built: install again with {compiler}")


def library_for(tensor: Tensor) -> NativeLibrary:
    """The library for a tensor's device. Raises NativeError where there is none."""
    library, problem = find_library(tensor.device.type)
    if library is None:
        raise NativeError(f"no native kernels: {problem}")
    return library


@functools.cache
def _say_once(message: str) -> None:
    logging.getLogger("catacaustics").warning(message)


@torch.compiler.assume_constant_result
def backend_for(device: str, backend: Backend | None = None) -> str:
    """The backend that computes with tensors of a device: `cpu`, `cuda` (native code) or `reference` (PyTorch).

    Args:
        device: "cpu" or "cuda".
        backend: which one to take; None asks the environment variable CATACAUSTICS_BACKEND. auto takes the fastest
            there is, and says so once where that is the reference.

    Raises:
        UserError: no such backend, or it does not run here.
    """
    choice = backend or os.environ.get(_CHOICE) or "auto"
    if choice not in get_args(Backend):
        known = ", ".join(get_args(Backend))
        raise UserError(f"backend {choice!r}", known, f"check {_CHOICE} in the environment")
    if choice == "reference":
        return "reference"
    if choice not in ("auto", device):
        raise UserError(f"backend {choice} for tensors on {device}", f"{device} or auto", "use backend auto")
    library, problem = find_library(device) if device in ("cpu", "cuda") else (None, f"there is none for {device}")
    if library is not None:
        return device
    if choice == device:
        raise UserError(
            f"no native kernels: {problem}",
            "the libraries that the build installs into catacaustics/_native",
            "use backend auto, or install again with the compiler; `catacaustics doctor` shows what there is",
        )
    _say_once(f"computing in PyTorch, which is many times slower than native code: {problem}")
    return "reference"


def host_kernel(name: str, tensor: Tensor) -> Callable[..., tuple[int, list[Tensor]]] | None:
    """A kernel that only the CPU's libraries have, to be called with its arguments after `like`; None where PyTorch is
    to compute instead: on other devices, for other types, without a library, and by choice (see `backend_for`)."""
    if tensor.device.type != "cpu" or tensor.dtype not in (torch.float32, torch.float64):
        return None
    library = find_library("cpu").library if backend_for("cpu") == "cpu" else None
    if library is None or not hasattr(library.handle, f"catacaustics_{name}_f32"):
        return None
    return functools.partial(library.call, name, tensor)
