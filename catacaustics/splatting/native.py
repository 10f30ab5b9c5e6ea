"""The splatter's native CPU backend: plain C libraries loaded with ctypes, and their custom operators.

`cuda_ext/` builds one library for each level of x86-64 (one plain library elsewhere) into `catacaustics/_native`. The
best that this processor supports is loaded at the first call. A library that is missing, damaged or made for another
processor is refused with a reason; nothing here ends the process. All results are tensors allocated by torch and passed
in as pointers; the number of threads is torch's, and does not change the results.

Two operators, so that the screen positions in between are part of the graph:

    splat_project   points and camera -> means, forms (see reference.ProjectedSplats) and indices, near to far
    splat_blend     those, opacities and features -> image and transmittance
"""

import ctypes
import functools
import struct
import sys
import sysconfig
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

import catacaustics
from catacaustics.cameras import Camera, Viewport
from catacaustics.config import SplatConfig
from catacaustics.shapes import Float
from catacaustics.splatting.reference import SplatOutput, check_shapes, check_values

_ABI = 1
_INVALID_VALUES, _OUT_OF_MEMORY, _TOO_LARGE = -1, -2, -3
_NAMES = ("catacaustics_cpu_v4", "catacaustics_cpu_v3", "catacaustics_cpu_v2", "catacaustics_cpu")

_P, _I, _D = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
_SIGNATURES = {
    "project": [_I, *[_P] * 6, *[_I] * 4, *[_D] * 8, _I, *[_P] * 3],
    "project_backward": [_I, *[_P] * 5, _D, _I, _P, _I, *[_P] * 7],
    "finite": [_P, _I, _I],
    "blend": [_I, _I, *[_P] * 5, *[_I] * 4, _D, _D, _I, *[_P] * 2],
    "blend_backward": [_I, _I, *[_P] * 5, *[_I] * 4, _D, _D, _I, *[_P] * 6],
}


class NativeError(Exception):
    """Why a native library cannot be used."""


class NativeLibrary(NamedTuple):
    """A loaded library: where it lies and how it was built."""

    path: Path
    description: str
    handle: ctypes.CDLL

    def call(self, name: str, dtype: torch.dtype, *arguments: object) -> int:
        """Call a function for a scalar type; tensors pass as their address (contiguous ones only).

        Raises:
            MemoryError, ValueError: the library ran out of memory; more points or pixels than it can number.
        """
        function = getattr(self.handle, f"catacaustics_{name}_{'f32' if dtype == torch.float32 else 'f64'}")
        values = [a.data_ptr() if isinstance(a, Tensor) else a for a in arguments]
        status = function(*values)
        if status == _OUT_OF_MEMORY:
            raise MemoryError("the native splatter ran out of memory")
        if status == _TOO_LARGE:
            raise ValueError("the native splatter takes up to 2^31 points and viewports of up to 2^21 pixels a side")
        return status


def load_library(path: Path) -> NativeLibrary:
    """Load one native library after checking that it is whole, made for this processor, and right about one splat.

    Raises:
        NativeError: it is not; the message says why.
    """
    _check_file(path)
    try:
        handle = ctypes.CDLL(str(path))
        handle.catacaustics_abi.restype = ctypes.c_int64
        handle.catacaustics_supported.restype = ctypes.c_int64
        handle.catacaustics_description.restype = ctypes.c_char_p
        abi = handle.catacaustics_abi()
        if abi != _ABI:
            raise NativeError(f"{path.name} has interface version {abi}, this package needs {_ABI}: build it again")
        description = handle.catacaustics_description().decode()
        if not handle.catacaustics_supported():
            raise NativeError(f"{path.name} ({description}) needs instructions that this processor lacks")
        for name, arguments in _SIGNATURES.items():
            for suffix in ("f32", "f64"):
                function = getattr(handle, f"catacaustics_{name}_{suffix}")
                function.restype, function.argtypes = ctypes.c_int64, arguments
    except (OSError, AttributeError) as error:
        raise NativeError(f"{path.name} cannot be loaded: {error}") from error
    library = NativeLibrary(path, description, handle)
    _check_one_splat(library)
    return library


def _check_file(path: Path) -> None:
    """Refuse a file that the system would map beyond its end, or that is for another kind of processor (Linux)."""
    if not path.is_file():
        raise NativeError(f"{path.name} is not there")
    if not sys.platform.startswith("linux"):
        return
    with path.open("rb") as file, Path(sys.executable).open("rb") as own:
        data, python = file.read(), own.read(64)
    if data[:4] != b"\x7fELF" or len(data) < 64:
        raise NativeError(f"{path.name} is not a shared library")
    if data[4:6] != python[4:6] or data[18:20] != python[18:20]:
        raise NativeError(f"{path.name} was built for another kind of processor")
    start, (size, count) = struct.unpack_from("<Q", data, 32)[0], struct.unpack_from("<HH", data, 54)
    if start + size * count > len(data):
        raise NativeError(f"{path.name} is cut short")
    for segment in range(start, start + size * count, size):
        offset, length = struct.unpack_from("<Q", data, segment + 8)[0], struct.unpack_from("<Q", data, segment + 32)[0]
        if offset + length > len(data):
            raise NativeError(f"{path.name} is cut short")


def _check_one_splat(library: NativeLibrary) -> None:
    """A facing disk of opacity 1/2 over the centre of one pixel leaves half of the light."""
    for dtype in (torch.float32, torch.float64):
        position, normal = torch.tensor([[0.0, 0, 2]], dtype=dtype), torch.tensor([[0.0, 0, 1]], dtype=dtype)
        half = torch.full((1,), 0.5, dtype=dtype)
        pose, lens = torch.eye(4, dtype=dtype), torch.tensor([10.0, 10, 0.5, 0.5], dtype=dtype)
        means, forms, visible = half.new_empty(1, 2), half.new_empty(1, 3), torch.empty(1, dtype=torch.int64)
        points = (position, normal, half, half)
        cuts = (0.3, 3.0, 0.0, 0.01, 0, 0, 1, 1, 1)
        count = library.call("project", dtype, 1, *points, pose, lens, 0, 0, 1, 1, *cuts, means, forms, visible)
        out = half.new_empty(2)
        splats = (means, forms, half, half, visible)
        if count == 1:
            library.call("blend", dtype, 1, 1, *splats, 0, 0, 1, 1, 3.0, 0.0, 1, out, out[1:])
        if count != 1 or (out - torch.tensor([0.25, 0.5], dtype=dtype)).abs().max() > 1e-6:
            raise NativeError(f"{library.path.name} failed its self test: {count} splats, values {out.tolist()}")


class _Found(NamedTuple):
    library: NativeLibrary | None
    problem: str


def _folders() -> list[Path]:
    """Where an install, or an editable one, puts libraries."""
    roots = [*catacaustics.__path__, str(Path(sysconfig.get_path("platlib")) / "catacaustics")]
    return [Path(root) / "_native" for root in dict.fromkeys(roots)]


@functools.cache
def find_library() -> _Found:
    """The best library for this processor, or why there is none. Looked for once."""
    problems = []
    for folder in _folders():
        for path in (folder / f"lib{name}.so" for name in _NAMES):
            if path.is_file():
                try:
                    return _Found(load_library(path), "")
                except NativeError as error:
                    problems.append(str(error))
    return _Found(None, "; ".join(problems) or "not built: install again with a C++17 compiler (GCC or Clang)")


def _library() -> NativeLibrary:
    library, problem = find_library()
    if library is None:
        raise NativeError(f"no native splatter: {problem}")
    return library


@torch.library.custom_op("catacaustics::splat_project", mutates_args=(), device_types="cpu")
def splat_project(
    positions: Tensor,
    normals: Tensor,
    footprints: Tensor,
    opacities: Tensor,
    pose: Tensor,
    lens: Tensor,
    x0: int,
    y0: int,
    width: int,
    height: int,
    low_pass: float,
    support: float,
    alpha_min: float,
    near: float,
    left: float,
    top: float,
    right: float,
    bottom: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Project the points that can touch a viewport; differentiable in all tensors but `opacities`, which only cull.

    Args:
        pose: camera_from_world (4, 4). lens: (4,) = fx, fy, cx, cy.
        x0, y0, width, height: the viewport.
        left, top, right, bottom: in pixels; points whose mean is not between them are dropped.

    Returns:
        means (m, 2), forms (m, 3) and indices (m,) of visible points, near to far, points at equal depth in order.

    Raises:
        ValueError: values that are not finite or out of range.
    """
    inputs = [t.contiguous() for t in (positions, normals, footprints, opacities, pose, lens)]
    n = len(positions)
    means, forms = positions.new_empty(n, 2), positions.new_empty(n, 3)
    visible = torch.empty(n, dtype=torch.int64)
    window, guard = (x0, y0, width, height), (left, top, right, bottom)
    cuts = (low_pass, support, alpha_min, near, *guard, torch.get_num_threads())
    count = _library().call("project", positions.dtype, n, *inputs, *window, *cuts, means, forms, visible)
    if count == _INVALID_VALUES:
        check_values(positions=positions, normals=normals, footprints=footprints, opacities=opacities)
    return means[:count], forms[:count], visible[:count]


@splat_project.register_fake
def _(positions, *_):
    count = torch.library.get_ctx().new_dynamic_size()
    return (
        positions.new_empty(count, 2),
        positions.new_empty(count, 3),
        positions.new_empty(count, dtype=torch.int64),
    )


@torch.library.custom_op("catacaustics::splat_project_backward", mutates_args=(), device_types="cpu")
def splat_project_backward(
    g_means: Tensor,
    g_forms: Tensor,
    positions: Tensor,
    normals: Tensor,
    footprints: Tensor,
    pose: Tensor,
    lens: Tensor,
    visible: Tensor,
    low_pass: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients to positions, normals, footprints, pose and lens."""
    inputs = [t.contiguous() for t in (positions, normals, footprints, pose, lens)]
    g_inputs = [torch.zeros_like(t) for t in inputs]
    g_screen = (g_means.contiguous(), g_forms.contiguous())
    chosen = (len(visible), visible, torch.get_num_threads())
    n = len(positions)
    _library().call("project_backward", positions.dtype, n, *inputs, low_pass, *chosen, *g_screen, *g_inputs)
    g_positions, g_normals, g_footprints, g_pose, g_lens = g_inputs
    return g_positions, g_normals, g_footprints, g_pose, g_lens


@splat_project_backward.register_fake
def _(g_means, g_forms, positions, normals, footprints, pose, lens, visible, low_pass):
    return tuple(t.new_empty(t.shape) for t in (positions, normals, footprints, pose, lens))


def _save_project(ctx, inputs, output):
    positions, normals, footprints, _, pose, lens, *_ = inputs
    ctx.low_pass = inputs[10]
    ctx.save_for_backward(positions, normals, footprints, pose, lens, output[2])


def _project_gradients(ctx, g_means, g_forms, _):
    g = splat_project_backward(g_means, g_forms, *ctx.saved_tensors, ctx.low_pass)
    return *g[:3], None, *g[3:], *[None] * 12


splat_project.register_autograd(_project_gradients, setup_context=_save_project)


@torch.library.custom_op("catacaustics::splat_blend", mutates_args=(), device_types="cpu")
def splat_blend(
    means: Tensor,
    forms: Tensor,
    opacities: Tensor,
    features: Tensor,
    visible: Tensor,
    x0: int,
    y0: int,
    width: int,
    height: int,
    support: float,
    alpha_min: float,
) -> tuple[Tensor, Tensor]:
    """Blend projected splats, near to far; differentiable in means, forms, opacities and features.

    Args:
        means (m, 2), forms (m, 3), visible (m,): as given by `splat_project`.
        opacities (n,), features (n, channels): of all points.

    Returns:
        image (height, width, channels) and transmittance (height, width).
    """
    inputs = [t.contiguous() for t in (means, forms, opacities, features, visible)]
    image, transmittance = means.new_empty(height, width, features.shape[1]), means.new_empty(height, width)
    sizes, cuts = (len(means), features.shape[1]), (support, alpha_min, torch.get_num_threads())
    _library().call("blend", means.dtype, *sizes, *inputs, x0, y0, width, height, *cuts, image, transmittance)
    return image, transmittance


@splat_blend.register_fake
def _(means, forms, opacities, features, visible, x0, y0, width, height, support, alpha_min):
    return means.new_empty(height, width, features.shape[1]), means.new_empty(height, width)


@torch.library.custom_op("catacaustics::splat_blend_backward", mutates_args=(), device_types="cpu")
def splat_blend_backward(
    g_image: Tensor,
    g_transmittance: Tensor,
    means: Tensor,
    forms: Tensor,
    opacities: Tensor,
    features: Tensor,
    visible: Tensor,
    x0: int,
    y0: int,
    width: int,
    height: int,
    support: float,
    alpha_min: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients to means, forms, opacities and features."""
    inputs = [t.contiguous() for t in (means, forms, opacities, features, visible)]
    g_inputs = [torch.zeros_like(t) for t in inputs[:4]]
    g_outputs = (g_image.contiguous(), g_transmittance.contiguous())
    sizes, cuts = (len(means), features.shape[1]), (support, alpha_min, torch.get_num_threads())
    window = (x0, y0, width, height)
    _library().call("blend_backward", means.dtype, *sizes, *inputs, *window, *cuts, *g_outputs, *g_inputs)
    g_means, g_forms, g_opacities, g_features = g_inputs
    return g_means, g_forms, g_opacities, g_features


@splat_blend_backward.register_fake
def _(g_image, g_transmittance, means, forms, opacities, features, *_):
    return tuple(t.new_empty(t.shape) for t in (means, forms, opacities, features))


def _save_blend(ctx, inputs, output):
    ctx.save_for_backward(*inputs[:5])
    ctx.settings = inputs[5:]


def _blend_gradients(ctx, g_image, g_transmittance):
    return *splat_blend_backward(g_image, g_transmittance, *ctx.saved_tensors, *ctx.settings), *[None] * 7


splat_blend.register_autograd(_blend_gradients, setup_context=_save_blend)


def splat_points(
    positions: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    footprints: Float[Tensor, "n"],
    opacities: Float[Tensor, "n"],
    features: Float[Tensor, "n channels"],
    camera: Camera,
    viewport: Viewport | None = None,
    config: SplatConfig | None = None,
) -> SplatOutput:
    """`catacaustics.splatting.splat_points` on the CPU in native code. Raises NativeError where there is none."""
    config = config or SplatConfig()
    viewport = viewport or camera.viewport
    check_shapes(positions, normals, footprints, opacities, features)
    flat = features.detach().contiguous()
    if _library().call("finite", flat.dtype, flat, flat.numel(), torch.get_num_threads()) == _INVALID_VALUES:
        check_values(features=features)
    pose = torch.tensor(camera.camera_from_world, dtype=positions.dtype)
    lens = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=positions.dtype)
    band, width, height = config.guard_band, camera.width, camera.height
    guard = (-band * width, -band * height, (1 + band) * width, (1 + band) * height)
    cuts = (config.low_pass, config.support, config.alpha_min, config.near, *guard)
    means, forms, visible = splat_project(positions, normals, footprints, opacities, pose, lens, *viewport, *cuts)
    blend_cuts = (config.support, config.alpha_min)
    image, transmittance = splat_blend(means, forms, opacities, features, visible, *viewport, *blend_cuts)
    return SplatOutput(image, transmittance, visible, means)
