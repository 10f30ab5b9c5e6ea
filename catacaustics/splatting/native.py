"""The splatter's native backends as custom operators of torch, the same for the CPU and for NVIDIA's GPUs.

Three operators, so that the screen positions in between are part of the graph, and lists are made once for both passes:

    splat_project   points and camera -> means, forms (see reference.ProjectedSplats) and indices, near to far
    splat_bin       those and opacities -> a record for each splat, and the splats of each tile of the viewport
    splat_blend     those and features -> image and transmittance

All results are tensors; their memory is torch's. On the CPU they do not depend on the number of threads (torch's), and
are the same bit for bit in every run; on a GPU gradients are, where SplatConfig.deterministic asks for it.
"""

import torch
from torch import Tensor

from catacaustics.cameras import Camera, Viewport
from catacaustics.kernels import INVALID_VALUES, NativeError, library_for
from catacaustics.splatting.config import SplatConfig
from catacaustics.splatting.reference import Disks, SplatOutput, check_values, guard_sides

_RECORD = 8  # values of a record


@torch.library.custom_op("catacaustics::splat_project", mutates_args=(), device_types=("cpu", "cuda"))
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
    visible = positions.new_empty(n, dtype=torch.int64)
    window, guard = (x0, y0, width, height), (left, top, right, bottom)
    cuts = (low_pass, support, alpha_min, near, *guard)
    count, _ = library_for(means).call("project", means, n, *inputs, *window, *cuts, means, forms, visible)
    if count == INVALID_VALUES:
        check_values(positions=positions, normals=normals, footprints=footprints, opacities=opacities)
        raise NativeError("the library refuses values that PyTorch takes: install again")
    return means[:count], forms[:count], visible[:count]


@splat_project.register_fake
def _(positions, *_):
    count = torch.library.get_ctx().new_dynamic_size()
    return (
        positions.new_empty(count, 2),
        positions.new_empty(count, 3),
        positions.new_empty(count, dtype=torch.int64),
    )


@torch.library.custom_op("catacaustics::splat_project_backward", mutates_args=(), device_types=("cpu", "cuda"))
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
    chosen = (len(visible), visible)
    call = library_for(positions).call
    call("project_backward", positions, len(positions), *inputs, low_pass, *chosen, *g_screen, *g_inputs)
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


@torch.library.custom_op("catacaustics::splat_bin", mutates_args=(), device_types=("cpu", "cuda"))
def splat_bin(
    means: Tensor,
    forms: Tensor,
    opacities: Tensor,
    visible: Tensor,
    x0: int,
    y0: int,
    width: int,
    height: int,
    support: float,
    alpha_min: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """List projected splats, near to far, tile by tile of the viewport.

    Args:
        means (m, 2), forms (m, 3), visible (m,): as given by `splat_project`. opacities (n,): of all points.

    Returns:
        records (m, 8): what blending needs of each splat.
        starts (tiles + 1,): where the list of each tile starts among the entries.
        entries (e,) int32: numbers of splats.
    """
    inputs = [t.contiguous() for t in (means, forms, opacities, visible)]
    library, records = library_for(means), means.new_empty(len(means), _RECORD)
    tiles = -(width // -library.tile) * -(height // -library.tile)
    starts, window = visible.new_empty(tiles + 1), (x0, y0, width, height)
    entries = library.bin(means, len(means), *inputs, *window, support, alpha_min, records, starts)
    return records, starts, entries


@splat_bin.register_fake
def _(means, forms, opacities, visible, *_):
    context = torch.library.get_ctx()
    return (
        means.new_empty(means.shape[0], _RECORD),
        visible.new_empty(context.new_dynamic_size()),
        visible.new_empty(context.new_dynamic_size(), dtype=torch.int32),
    )


@torch.library.custom_op("catacaustics::splat_blend", mutates_args=(), device_types=("cpu", "cuda"))
def splat_blend(
    means: Tensor,
    forms: Tensor,
    opacities: Tensor,
    features: Tensor,
    visible: Tensor,
    records: Tensor,
    starts: Tensor,
    entries: Tensor,
    x0: int,
    y0: int,
    width: int,
    height: int,
    stop_transmittance: float,
    deterministic: bool,
) -> tuple[Tensor, Tensor]:
    """Blend projected splats; differentiable in means, forms, opacities (by way of the records) and features.

    Args:
        means (m, 2), forms (m, 3), visible (m,), opacities (n,): as given to `splat_bin`. features (n, channels).
        records, starts, entries: as given by `splat_bin`.

    Returns:
        image (height, width, channels) and transmittance (height, width).

    Raises:
        ValueError: features that are not finite.
    """
    inputs = [t.contiguous() for t in (features, visible, records, starts, entries)]
    image, transmittance = means.new_empty(height, width, features.shape[1]), means.new_empty(height, width)
    library, window = library_for(means), (x0, y0, width, height)
    if library.call("finite", features, inputs[0], features.numel())[0] == INVALID_VALUES:
        check_values(features=features)
        raise NativeError("the library refuses values that PyTorch takes: install again")
    sizes, outputs = (len(visible), features.shape[1]), (image, transmittance)
    library.call("blend", means, *sizes, *inputs, *window, stop_transmittance, *outputs)
    return image, transmittance


@splat_blend.register_fake
def _(means, forms, opacities, features, visible, records, starts, entries, x0, y0, width, height, *_):
    return means.new_empty(height, width, features.shape[1]), means.new_empty(height, width)


@torch.library.custom_op("catacaustics::splat_blend_backward", mutates_args=(), device_types=("cpu", "cuda"))
def splat_blend_backward(
    g_image: Tensor,
    g_transmittance: Tensor,
    features: Tensor,
    visible: Tensor,
    records: Tensor,
    starts: Tensor,
    entries: Tensor,
    x0: int,
    y0: int,
    width: int,
    height: int,
    stop_transmittance: float,
    deterministic: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients to means, forms, opacities and features."""
    inputs = [t.contiguous() for t in (features, visible, records, starts, entries)]
    m, n = len(visible), len(features)
    shapes = ((m, 2), (m, 3), (n,), (n, features.shape[1]))
    g_means, g_forms, g_opacities, g_features = (records.new_zeros(shape) for shape in shapes)
    arguments = (x0, y0, width, height, stop_transmittance, g_image.contiguous(), g_transmittance.contiguous())
    g_inputs = (g_means, g_forms, g_opacities, g_features)
    call = library_for(records).call
    call("blend_backward", records, m, shapes[3][1], *inputs, *arguments, *g_inputs, deterministic=deterministic)
    return g_means, g_forms, g_opacities, g_features


@splat_blend_backward.register_fake
def _(g_image, g_transmittance, features, visible, *_):
    m, n = visible.shape[0], features.shape[0]
    return tuple(features.new_empty(shape) for shape in ((m, 2), (m, 3), (n,), features.shape))


def _save_blend(ctx, inputs, output):
    ctx.save_for_backward(*inputs[3:8])
    ctx.settings = inputs[8:]


def _blend_gradients(ctx, g_image, g_transmittance):
    return *splat_blend_backward(g_image, g_transmittance, *ctx.saved_tensors, *ctx.settings), *[None] * 10


splat_blend.register_autograd(_blend_gradients, setup_context=_save_blend)


def splat(disks: Disks, camera: Camera, viewport: Viewport, config: SplatConfig) -> SplatOutput:
    """`splat_points` in native code. Raises NativeError where there is none for the tensors' device."""
    like = {"dtype": disks.positions.dtype, "device": disks.positions.device}
    pose = torch.as_tensor(camera.camera_from_world, **like)
    lens = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], **like)
    reach = (config.support, config.alpha_min)
    means, forms, visible = splat_project(
        *disks[:4], pose, lens, *viewport, config.low_pass, *reach, config.near, *guard_sides(camera, config)
    )
    opacities, features = disks[3:]
    bins = splat_bin(means.detach(), forms.detach(), opacities.detach(), visible, *viewport, *reach)
    settings = (*viewport, config.stop_transmittance, config.deterministic)
    image, transmittance = splat_blend(means, forms, opacities, features, visible, *bins, *settings)
    return SplatOutput(image, transmittance, visible, means)
