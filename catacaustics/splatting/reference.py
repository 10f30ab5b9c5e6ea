"""EWA splatting of oriented disks in PyTorch, with the linear two-pass backward: the specification of every backend.

Projection (Zwicker et al. 2001, "Surface Splatting"; paper eq. 1). A disk at X = (x, y, z) in the camera, with unit
normal n, tangents t1, t2 and squared radius s, has the screen-space covariance

    Sigma = s J J^T + nu I,     J = P [t1 t2],     P = [[fx/z, 0, -fx x/z^2], [0, fy/z, -fy y/z^2]]
    det J = fx fy (n . X) / z^3,   det Sigma = (s det J)^2 + nu s tr(J J^T) + nu^2      (no subtraction)

The determinant is computed divided by Sigma_22: for disks that are larger than the scene the square would overflow.

The quadratic form is kept as a sum of squares, so that it is never negative however thin the ellipse is:

    d^T Sigma^-1 d = w (dx - m dy)^2 + v dy^2,   w = Sigma_22 / det Sigma, m = Sigma_12 / Sigma_22, v = 1 / Sigma_22

Blending: alpha_i = o_i exp(-q_i / 2), front to back; T_{i+1} = T_i (1 - alpha_i); colour = sum_i c_i alpha_i T_i.
A pair is drawn where q_i <= reach^2 (SplatConfig.support, alpha_min) and T_i >= stop_transmittance, else alpha_i = 0.
Backward: R_N = dL/dT_out; dL/dalpha_i = T_i (g . c_i - R_i); R_{i-1} = alpha_i (g . c_i) + (1 - alpha_i) R_i.
It divides by nothing, hence is exact at alpha = 1.

How it is laid out: all splat-pixel pairs of a region of the image are listed splat by splat (near to far) and then
given slots by (rank within the pixel, pixel), pixels with many pairs first. The pairs of one rank are then one
contiguous slice over a prefix of the pixels, and the recursions above are a few whole-slice operations a rank.
"""

import math
import warnings
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from catacaustics.cameras import Camera, Viewport
from catacaustics.kernels import host_kernel
from catacaustics.shapes import Float, Int
from catacaustics.splatting.config import SplatConfig


class Disks(NamedTuple):
    """What is splatted. positions (n, 3) and unit normals (n, 3) in world space; footprints (n,): squared radii;
    opacities (n,) in [0, 1]; features (n, channels)."""

    positions: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    footprints: Float[Tensor, "n"]
    opacities: Float[Tensor, "n"]
    features: Float[Tensor, "n channels"]


class ProjectedSplats(NamedTuple):
    """Screen-space splats: means (n, 2) px; forms (n, 3) = (w, m, v); half_extent (n, 2) px of one standard deviation
    along x and y; depths (n,)."""

    means: Float[Tensor, "n 2"]
    forms: Float[Tensor, "n 3"]
    half_extent: Float[Tensor, "n 2"]
    depths: Float[Tensor, "n"]


def tangent_basis(normals: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Two unit tangents for each unit normal (Duff et al. 2017, "Building an Orthonormal Basis, Revisited")."""
    x, y, z = normals.unbind(-1)
    sign = torch.where(z < 0, -torch.ones_like(z), torch.ones_like(z))
    a = -1 / (sign + z)
    b = x * y * a
    return (
        torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1),
        torch.stack([b, sign + y * y * a, -y], -1),
    )


def project(
    positions: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    footprints: Float[Tensor, "n"],
    camera_from_world: Float[Tensor, "4 4"],
    focal: tuple[float, float],
    center: tuple[float, float],
    low_pass: float,
) -> ProjectedSplats:
    """Project oriented disks; differentiable. Depths must be positive (cull first).

    Args:
        positions, normals: world space, normals of unit length.
        footprints: squared radii, world units squared.
        focal, center: (fx, fy) and (cx, cy) in pixels.
        low_pass: nu in px^2.
    """
    rotation = camera_from_world[:3, :3]
    x, y, z = (positions @ rotation.T + camera_from_world[:3, 3]).unbind(-1)
    n = normals @ rotation.T
    (fx, fy), (cx, cy) = focal, center
    inv_z = 1 / z
    u, v = x * inv_z, y * inv_z
    # Columns of J: the tangents as they move on screen.
    (ax, ay, az), (bx, by, bz) = (t.unbind(-1) for t in tangent_basis(n))
    kx, ky = fx * inv_z, fy * inv_z
    j11, j21 = kx * (ax - u * az), ky * (ay - v * az)
    j12, j22 = kx * (bx - u * bz), ky * (by - v * bz)
    s11 = footprints * (j11 * j11 + j12 * j12)
    s22 = footprints * (j21 * j21 + j22 * j22)
    s12 = footprints * (j11 * j21 + j12 * j22)
    det_j = kx * ky * (n[:, 0] * u + n[:, 1] * v + n[:, 2])
    s_det, variance_x, variance_y = footprints * det_j, s11 + low_pass, s22 + low_pass
    inv_w = s_det * (s_det / variance_y) + low_pass * ((s11 + variance_y) / variance_y)
    return ProjectedSplats(
        torch.stack([fx * u + cx, fy * v + cy], -1),
        torch.stack([1 / inv_w, s12 / variance_y, 1 / variance_y], -1),
        torch.stack([variance_x, variance_y], -1).detach().sqrt(),
        z,
    )


class _Pairs(NamedTuple):
    """The splat-pixel pairs of a region, in splat-major order (int32 indices).

    splats, pixels: which splat, which pixel of the region; order: pairs sorted by pixel (stable, so by depth within);
    slots: where each pair stands in rank-major order; ranks: number of pixels with more than k pairs, k = 0, 1, ...;
    by_count: the region's pixels in rank-major order; falloff: exp(-q / 2); alpha: opacity times falloff;
    dx, dy: offset of the pixel from the splat's mean.
    """

    splats: Tensor
    pixels: Tensor
    order: Tensor
    slots: Tensor
    ranks: list[int]
    by_count: Tensor
    falloff: Tensor
    alpha: Tensor
    dx: Tensor
    dy: Tensor


def _expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """For counts (n,): the owner of each of sum(counts) items, and the item's number within its owner."""
    owner = torch.repeat_interleave(counts)
    first = torch.cumsum(counts, 0) - counts
    return owner, torch.arange(len(owner), device=counts.device) - first.index_select(0, owner)


def _list_pairs(means: Tensor, forms: Tensor, opacities: Tensor, reach2: Tensor, region: Viewport) -> _Pairs:
    """List a region's pairs: exact row spans of each ellipse, then their pixels."""
    x0, y0, width, height = region
    w, m, v = forms.unbind(-1)

    def pixel_range(low: Tensor, high: Tensor, start: int, size: int) -> tuple[Tensor, Tensor]:
        first = torch.ceil(low - 0.5 - start).clamp(0, size).long()
        last = torch.floor(high - 0.5 - start).clamp(-1, size - 1).long()
        return first, (last - first + 1).clamp_min(0)

    mean_x, mean_y = means.unbind(-1)
    reach_y = (reach2 / v).sqrt()
    first_row, rows = pixel_range(mean_y - reach_y, mean_y + reach_y, y0, height)
    owner, row = _expand(rows)
    row = row + first_row.index_select(0, owner)
    dy = row + (0.5 + y0) - mean_y.index_select(0, owner)
    reach2, w, m, v = (t.index_select(0, owner) for t in (reach2, w, m, v))
    half_width = ((reach2 - v * dy * dy).clamp_min(0) / w).sqrt()
    middle = mean_x.index_select(0, owner) + m * dy
    first_column, columns = pixel_range(middle - half_width, middle + half_width, x0, width)
    span, column = _expand(columns)
    column = column + first_column.index_select(0, span)
    splats = owner.index_select(0, span)
    pixels = row.index_select(0, span) * width + column
    dx, dy = column + (0.5 + x0) - mean_x.index_select(0, splats), dy.index_select(0, span)
    form = forms.index_select(0, splats)
    skewed = dx - form[:, 1] * dy
    falloff = torch.exp(-0.5 * (form[:, 0] * skewed * skewed + form[:, 2] * dy * dy))
    alpha = opacities.index_select(0, splats) * falloff

    splats, pixels = splats.int(), pixels.int()
    _, order = torch.sort(pixels, stable=True)
    counts = torch.bincount(pixels, minlength=width * height)
    by_count = torch.argsort(counts, descending=True)
    place = torch.empty_like(by_count)
    place[by_count] = torch.arange(len(by_count), device=by_count.device)
    _, rank = _expand(counts)
    deepest = int(counts.max()) if len(pixels) else 0
    per_rank = len(counts) - torch.cumsum(torch.bincount(counts, minlength=deepest + 1), 0)[:deepest]
    slots = torch.empty_like(order)
    slots[order] = (torch.cumsum(per_rank, 0) - per_rank).index_select(0, rank) + place.index_select(
        0, pixels.index_select(0, order)
    )
    return _Pairs(splats, pixels, order, slots, per_rank.tolist(), by_count, falloff, alpha, dx, dy)


def _transmittances(pairs: _Pairs, size: int, stop: float) -> tuple[_Pairs, Tensor, Tensor]:
    """The pairs with alpha and falloff 0 where T is below `stop`; T before each pair (splat-major); T behind the last
    one for each pixel of the region."""
    transparency = torch.empty_like(pairs.alpha)
    transparency[pairs.slots] = 1 - pairs.alpha
    before = torch.empty_like(transparency)
    running = torch.ones(size, dtype=transparency.dtype, device=transparency.device)
    start = 0
    for n in pairs.ranks:
        before[start : start + n] = running[:n]
        rank = transparency[start : start + n]
        running[:n] *= torch.where(running[:n] >= stop, rank, 1) if stop > 0 else rank
        start += n
    out = torch.empty_like(running)
    out[pairs.by_count] = running
    before = before.index_select(0, pairs.slots)
    if stop > 0:
        drawn = before >= stop
        pairs = pairs._replace(alpha=pairs.alpha * drawn, falloff=pairs.falloff * drawn)
    return pairs, before, out


def _accumulate(rows: Tensor, columns: Tensor, values: Tensor, dense: Tensor, count: int) -> Tensor:
    """out[r] = sum over pairs with rows == r of values * dense[columns]; rows ascending: a sparse matrix product."""
    if dense.device.type == "cpu" and not torch.backends.mkl.is_available():
        out = torch.zeros(count, dense.shape[1], dtype=dense.dtype, device=dense.device)
        return out.index_add_(0, rows, values[:, None] * dense[columns])
    starts = torch.searchsorted(rows, torch.arange(count + 1, device=rows.device, dtype=rows.dtype)).int()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        matrix = torch.sparse_csr_tensor(starts, columns, values, size=(count, len(dense)), check_invariants=False)
        return matrix @ dense


def _dot(g: Tensor, pixels: Tensor, features: Tensor, splats: Tensor) -> Tensor:
    """q = g[pixel] . features[splat] for each pair, a channel at a time (no pairs x channels array)."""
    q = torch.zeros(len(pixels), dtype=g.dtype, device=g.device)
    for g_channel, channel in zip(g.T.contiguous(), features.T.contiguous(), strict=True):
        q.addcmul_(g_channel.index_select(0, pixels), channel.index_select(0, splats))
    return q


def _split(region: Viewport, means: Tensor, extent: Tensor, budget: int) -> list[tuple[Viewport, Tensor]]:
    """Halve a region until the pairs in it fit the budget (or it is one pixel); returns regions and their splats."""
    stack = [(region, torch.arange(len(means), device=means.device))]
    regions = []
    while stack:
        region, index = stack.pop()
        low = torch.tensor(region[:2], dtype=means.dtype, device=means.device)
        high = low + torch.tensor(region[2:], dtype=means.dtype, device=means.device)
        mean, half = means[index], extent[index]
        overlap = (torch.minimum(mean + half, high) - torch.maximum(mean - half, low)).double()
        inside = (overlap >= 0).all(1)
        index, overlap = index[inside], overlap[inside]
        area = (overlap + 1).prod(1).sum()
        x0, y0, width, height = region
        if area <= budget or width * height == 1:
            regions.append((region, index))
        elif width >= height:
            half_width = width // 2
            stack.append((Viewport(x0 + half_width, y0, width - half_width, height), index))
            stack.append((Viewport(x0, y0, half_width, height), index))
        else:
            half_height = height // 2
            stack.append((Viewport(x0, y0 + half_height, width, height - half_height), index))
            stack.append((Viewport(x0, y0, width, half_height), index))
    return regions


class _Blend(torch.autograd.Function):
    """Blend splats that are sorted near to far. Pairs beyond the budget are listed again in the backward pass."""

    @staticmethod
    def forward(ctx, means, forms, opacities, features, reach2, extent, viewport, stop, budget):
        height, width, channels = viewport.height, viewport.width, features.shape[1]
        image = features.new_zeros(height, width, channels)
        transmittance = features.new_ones(height, width)
        regions = _split(viewport, means, extent, budget) if len(means) and width and height else []
        kept, room = [], budget
        for region, index in regions:
            pairs = _list_pairs(means[index], forms[index], opacities[index], reach2[index], region)
            pairs, before, out = _transmittances(pairs, region.width * region.height, stop)
            weights = (pairs.alpha * before).index_select(0, pairs.order)
            colors = _accumulate(
                pairs.pixels[pairs.order], pairs.splats[pairs.order], weights, features[index], len(out)
            )
            rows, columns = _window(region, viewport)
            image[rows, columns] = colors.view(region.height, region.width, channels)
            transmittance[rows, columns] = out.view(region.height, region.width)
            room -= len(before)
            kept.append((pairs, before) if room >= 0 else None)
        ctx.save_for_backward(means, forms, opacities, features, reach2)
        ctx.viewport, ctx.stop, ctx.regions, ctx.kept = viewport, stop, regions, kept
        return image, transmittance

    @staticmethod
    def backward(ctx, g_image, g_transmittance):  # pyright: ignore[reportIncompatibleMethodOverride]
        means, forms, opacities, features, reach2 = ctx.saved_tensors
        grads = [torch.zeros_like(t) for t in (means, forms, opacities, features)]
        for (region, index), kept in zip(ctx.regions, ctx.kept, strict=True):
            if kept is None:
                pairs = _list_pairs(means[index], forms[index], opacities[index], reach2[index], region)
                pairs, before, _ = _transmittances(pairs, region.width * region.height, ctx.stop)
            else:
                pairs, before = kept
            rows, columns = _window(region, ctx.viewport)
            g = g_image[rows, columns].reshape(region.width * region.height, g_image.shape[-1])
            g_out = g_transmittance[rows, columns].reshape(-1)
            parts = _backward_region(pairs, before, forms[index], features[index], g, g_out)
            for grad, part in zip(grads, parts, strict=True):
                grad.index_add_(0, index, part)
        return *grads, None, None, None, None, None


def _window(region: Viewport, viewport: Viewport) -> tuple[slice, slice]:
    x, y = region.x0 - viewport.x0, region.y0 - viewport.y0
    return slice(y, y + region.height), slice(x, x + region.width)


def _backward_region(
    pairs: _Pairs, before: Tensor, forms: Tensor, features: Tensor, g: Tensor, g_out: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients to means, forms, opacities and features from one region (the second pass, back to front)."""
    alpha = pairs.alpha
    q = _dot(g, pairs.pixels, features, pairs.splats)
    alpha_by_slot, q_by_slot = torch.empty_like(alpha), torch.empty_like(q)
    alpha_by_slot[pairs.slots], q_by_slot[pairs.slots] = alpha, q
    behind = torch.empty_like(alpha)
    running = g_out[pairs.by_count]
    end = len(alpha)
    for n in reversed(pairs.ranks):
        start = end - n
        behind[start:end] = running[:n]
        running[:n] += alpha_by_slot[start:end] * (q_by_slot[start:end] - running[:n])
        end = start
    g_alpha = before * (q - behind.index_select(0, pairs.slots))

    g_features = _accumulate(pairs.splats, pairs.pixels, alpha * before, g, len(features))
    w, m, _ = (f.index_select(0, pairs.splats) for f in forms.unbind(-1))
    skewed = pairs.dx - m * pairs.dy
    g_q = -0.5 * alpha * g_alpha
    g_skew = 2 * g_q * w * skewed
    v = forms[:, 2].index_select(0, pairs.splats)
    terms = torch.stack(
        [
            -g_skew,
            g_skew * m - 2 * g_q * v * pairs.dy,
            g_q * skewed * skewed,
            -g_skew * pairs.dy,
            g_q * pairs.dy * pairs.dy,
            pairs.falloff * g_alpha,
        ],
        1,
    )
    lengths = torch.bincount(pairs.splats, minlength=len(forms))
    sums = torch.segment_reduce(terms, "sum", lengths=lengths, axis=0)
    return sums[:, :2], sums[:, 2:5], sums[:, 5], g_features


class SplatOutput(NamedTuple):
    """image (height, width, channels); transmittance (height, width), T behind the last splat; visible (m,): which
    points can touch the viewport; screen (m, 2): their means in pixels, kept in the graph for densification."""

    image: Float[Tensor, "height width channels"]
    transmittance: Float[Tensor, "height width"]
    visible: Int[Tensor, "m"]
    screen: Float[Tensor, "m 2"]


def splat(disks: Disks, camera: Camera, viewport: Viewport, config: SplatConfig) -> SplatOutput:
    """`splat_points` in PyTorch. Points behind the near plane or outside the guard band are dropped."""
    positions, normals, footprints, opacities, features = disks
    check_values(**disks._asdict())
    pose = torch.tensor(camera.camera_from_world, dtype=positions.dtype, device=positions.device)
    lens = ((camera.fx, camera.fy), (camera.cx, camera.cy))
    with torch.no_grad():
        candidates = torch.nonzero(_in_guard_band(positions, pose, camera, config))[:, 0]
        near = [t.index_select(0, candidates) for t in (positions, normals, footprints)]
        rough = project(near[0], near[1], near[2], pose, *lens, config.low_pass)
        reach2 = _reach2(opacities[candidates], config)
        reach = rough.half_extent * reach2.sqrt()[:, None]
        low = torch.tensor([viewport.x0, viewport.y0]).to(positions)
        high = low + torch.tensor([viewport.width, viewport.height]).to(positions)
        touches = ((rough.means + reach > low) & (rough.means - reach < high)).all(1) & (reach2 > 0)
        visible = torch.nonzero(touches)[:, 0]
        visible = visible[torch.argsort(rough.depths[visible], stable=True)]
        reach2, reach, visible = reach2[visible], reach[visible], candidates[visible]
    positions, normals, footprints, opacities, features = (t.index_select(0, visible) for t in disks)
    splats = project(positions, normals, footprints, pose, *lens, config.low_pass)
    settings = (viewport, config.stop_transmittance, config.pair_budget)
    image, transmittance = _Blend.apply(splats.means, splats.forms, opacities, features, reach2, reach, *settings)
    return SplatOutput(image, transmittance, visible, splats.means)


def _in_guard_band(positions: Tensor, pose: Tensor, camera: Camera, config: SplatConfig) -> Tensor:
    """Points in front of the near plane whose centre lies in the guard band."""
    x, y, z = (positions @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    kept = z > config.near
    inv_z = torch.where(kept, 1 / z, 1)
    left, top, right, bottom = guard_sides(camera, config)
    axes = ((x, camera.fx, camera.cx, left, right), (y, camera.fy, camera.cy, top, bottom))
    for coordinate, focal, center, low, high in axes:
        mean = focal * coordinate * inv_z + center
        kept = kept & (mean > low) & (mean < high)
    return kept


def guard_sides(camera: Camera, config: SplatConfig) -> tuple[float, float, float, float]:
    """Left, top, right and bottom of the guard band, in pixels: points whose centre is farther out are dropped."""
    band, width, height = config.guard_band, camera.width, camera.height
    return -band * width, -band * height, (1 + band) * width, (1 + band) * height


def _reach2(opacities: Tensor, config: SplatConfig) -> Tensor:
    """Squared Mahalanobis radius in which a splat is drawn; 0 drops it."""
    reach2 = torch.full_like(opacities, config.support**2)
    if config.alpha_min > 0:
        reach2 = torch.minimum(reach2, 2 * torch.log(opacities.clamp_min(1e-30) / config.alpha_min)).clamp_min(0)
    return reach2


LARGEST_FOOTPRINT = 1e15
"""Squared radii up to here have gradients that 32 bits can hold, seen at some thousand pixels a unit; autograd squares
1 / w on the way, which 32 bits hold up to 1e12. The same as kLargestFootprint of cuda_ext/math/projection.h."""


def check_shapes(**arguments: object) -> None:
    """Raise ValueError, naming the argument, for things that are no tensors, and for shapes, types and devices that do
    not go together."""
    tensors: dict[str, Tensor] = {}
    for name, value in arguments.items():
        if not isinstance(value, Tensor):
            raise ValueError(f"{name} must be a torch.Tensor, got {type(value).__name__}")
        tensors[name] = value
    positions, features = tensors["positions"], tensors.get("features")
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"positions must have shape (n, 3), got {tuple(positions.shape)}")
    n, channels = len(positions), features.shape[-1] if features is not None and features.ndim else 0
    shapes = {"positions": (n, 3), "normals": (n, 3), "footprints": (n,), "opacities": (n,), "features": (n, channels)}
    for name, tensor in tensors.items():
        if tuple(tensor.shape) != shapes[name]:
            raise ValueError(f"{name} must have shape {shapes[name]}, got {tuple(tensor.shape)}")
        if tensor.dtype != positions.dtype or tensor.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"{name} must be float32 or float64 like positions, got {tensor.dtype}")
        if tensor.device != positions.device:
            raise ValueError(f"{name} must be on {positions.device} like positions, got {tensor.device}")


def check_view(camera: Camera, viewport: Viewport) -> None:
    """Raise ValueError, naming the value, for a camera that is not finite or a viewport that is no rectangle of pixels.
    What torch.compile traces is not checked: it would have to leave its graph."""
    if torch.compiler.is_compiling():
        return
    for name in ("fx", "fy", "cx", "cy"):
        if not math.isfinite(getattr(camera, name)):
            raise ValueError(f"camera.{name} must be finite, got {getattr(camera, name)}")
    bad = np.argwhere(~np.isfinite(camera.camera_from_world))
    if len(bad):
        raise ValueError(
            f"camera.camera_from_world has {len(bad)} values that are not finite, the first at {bad[0].tolist()}"
        )
    whole = all(isinstance(value, int | np.integer) for value in viewport)
    if not whole or viewport.width < 0 or viewport.height < 0:
        raise ValueError(f"viewport must be four whole numbers with width and height >= 0, got {tuple(viewport)}")


def check_values(**tensors: Tensor) -> None:
    """Raise ValueError for values that are not finite or out of range: which argument, how many, the first's place."""
    for name, tensor in tensors.items():
        finite = torch.isfinite(tensor)
        if not finite.all():
            bad = torch.nonzero(~finite)
            raise ValueError(f"{name} has {len(bad)} values that are not finite, the first at {bad[0].tolist()}")
    rules = {"footprints": (0, LARGEST_FOOTPRINT), "opacities": (0, 1)}
    for name, (least, most) in rules.items():
        if name not in tensors:
            continue
        for wanted, outside in ((f">= {least}", tensors[name] < least), (f"<= {most:g}", tensors[name] > most)):
            bad = torch.nonzero(outside)
            if len(bad):
                first = float(tensors[name][bad[0, 0]])
                raise ValueError(
                    f"{name} must be {wanted}: {len(bad)} are not, the first at {bad[0].tolist()} is {first:g}"
                )


def points_in_view(
    positions: Float[Tensor, "n 3"],
    footprints: Float[Tensor, "n"],
    camera: Camera,
    viewport: Viewport,
    config: SplatConfig | None = None,
) -> Int[Tensor, "m"]:
    """Indices of the points that may touch a viewport: a cheap cull before features and gradients are computed.

    Conservative: whatever its normal, a disk's variance along screen x is at most s (fx/z)^2 (1 + (x/z)^2) + nu.

    Raises:
        ValueError: wrong shapes, types or devices, a camera that is not finite, a viewport that is no rectangle of
            pixels; the argument is named.
    """
    config = config or SplatConfig()
    check_shapes(positions=positions, footprints=footprints)
    check_view(camera, viewport)
    with torch.no_grad():
        pose = torch.tensor(camera.camera_from_world, dtype=positions.dtype, device=positions.device)
        if kernel := host_kernel("cull", positions):
            lens = torch.tensor([camera.fx, camera.fy, camera.cx, camera.cy], dtype=positions.dtype)
            visible = torch.empty(len(positions), dtype=torch.int64)
            inputs = (positions.contiguous(), footprints.contiguous(), pose, lens)
            cuts = (config.low_pass, config.support, config.near, *guard_sides(camera, config))
            count, _ = kernel(len(positions), *inputs, *viewport, *cuts, visible)
            return visible[:count]
        x, y, z = (positions @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
        inside = _in_guard_band(positions, pose, camera, config)
        inv_z = torch.where(inside, 1 / z, 1)
        axes = (
            (x * inv_z, camera.fx, camera.cx, viewport.x0, viewport.width),
            (y * inv_z, camera.fy, camera.cy, viewport.y0, viewport.height),
        )
        for slope, focal, center, start, size in axes:
            reach = config.support * (footprints * (focal * inv_z) ** 2 * (1 + slope**2) + config.low_pass).sqrt()
            mean = focal * slope + center
            inside = inside & (mean + reach > start) & (mean - reach < start + size)
        return torch.nonzero(inside)[:, 0]
