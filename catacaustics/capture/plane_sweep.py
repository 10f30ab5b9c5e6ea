"""Depth and normals of one photograph from its neighbours: plane sweep with normalised cross-correlation.

A field of inverse depth w(p) = 1 / z(p) over the reference image warps a neighbour onto it:
q ~ A p + b w(p), with A = K' R K^-1 and b = K' t. A plane in space is an affine w, so slanted and curved surfaces need
nothing special: the correlation windows follow the field. The steps:

1. Sweep fronto-parallel planes, even in inverse depth, at a low resolution; the score of a plane is the mean of the
   best correlations among the neighbours, which tolerates occlusion. Semi-global aggregation (Hirschmüller 2008).
2. At each finer resolution: fit affine pieces to the field, let pixels take over the planes of pixels near by, and move
   each to the peak of its score (parabola), well below the spacing of the planes.
3. Normals from the affine pieces; pixels without texture or with a low score are dropped, not invented.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from catacaustics.cameras import Camera, pixel_centers
from catacaustics.geometry import rigid_inverse
from catacaustics.shapes import Float


@dataclass(frozen=True)
class SweepConfig:
    """Settings of the matching; lengths in pixels of the resolution at hand."""

    sweep_size: int = 256
    """The planes are swept at the largest halving of the image whose longer side is at most this."""
    window_radius: int = 3
    """Correlation windows have 2 r + 1 pixels a side."""
    best: int = 2
    """The score of a depth is the mean over this many best neighbours."""
    plane_step: float = 0.7
    """Spacing of the swept planes as seen in the neighbours."""
    max_planes: int = 192
    smooth_penalty: float = 0.15
    """Cost of a step of one plane between adjacent pixels; a correlation of 1 costs 0, of -1 costs 2."""
    jump_penalty: float = 0.7
    """Cost of a larger step; less across an edge of the image."""
    iterations: int = 2
    """Rounds of refinement at each resolution."""
    min_score: float = 0.55
    """Pixels whose mean correlation is lower are dropped."""
    noise: float = 0.75 / 255
    """Standard deviation of the image noise: it holds correlations down where the texture is no stronger than it."""
    min_contrast: float = 1.0 / 255
    """Windows of lower standard deviation are dropped as textureless."""


class GrayView(NamedTuple):
    """A gray image in [0, 1] and its camera."""

    pixels: Float[torch.Tensor, "height width"]
    camera: Camera

    def halved(self) -> "GrayView":
        height, width = max(1, self.pixels.shape[0] // 2), max(1, self.pixels.shape[1] // 2)
        pixels = F.interpolate(self.pixels[None, None], size=(height, width), mode="area")[0, 0]
        return GrayView(pixels, self.camera.resized(width, height))


class DepthEstimate(NamedTuple):
    """Depth z (0 where there is none), unit normals in camera coordinates facing the camera, mean correlation."""

    depth: Float[np.ndarray, "height width"]
    normals: Float[np.ndarray, "height width 3"]
    score: Float[np.ndarray, "height width"]


def _box_mean(x: torch.Tensor, radius: int) -> torch.Tensor:
    """Mean over windows of 2 r + 1 pixels; smaller by r on each side. Sums by doubling do not drift."""
    window = 2 * radius + 1
    for dim in (-2, -1):
        length = x.shape[dim] - window + 1
        block, size, offset, pieces = x, 1, 0, []
        while size <= window:
            if window & size:
                pieces.append(block.narrow(dim, offset, length))
                offset += size
            if 2 * size <= window:
                reach = block.shape[dim] - size
                block = block.narrow(dim, 0, reach) + block.narrow(dim, size, reach)
            size *= 2
        x = sum(pieces[1:], pieces[0])
    return x / window**2


def _pad(x: torch.Tensor, radius: int) -> torch.Tensor:
    return F.pad(x[None], (radius,) * 4, mode="replicate")[0]


class _Matcher:
    """Scores fields of inverse depth of one reference image at one resolution."""

    def __init__(self, reference: GrayView, neighbors: list[GrayView], config: SweepConfig):
        self.radius, self.best, self.floor = config.window_radius, min(config.best, len(neighbors)), config.noise**2
        self.neighbors = neighbors
        self.padded = _pad(reference.pixels[None] - 0.5, self.radius)
        self.mean = _box_mean(self.padded, self.radius)
        self.variance = (_box_mean(self.padded**2, self.radius) - self.mean**2).clamp_min(0)
        device, camera = reference.pixels.device, reference.camera
        homogeneous = np.concatenate([pixel_centers(camera.viewport), np.ones((camera.height, camera.width, 1))], -1)
        world_from_reference = rigid_inverse(camera.camera_from_world)
        self.maps = []
        for neighbor in neighbors:
            relative = neighbor.camera.camera_from_world @ world_from_reference
            rotated = homogeneous @ (neighbor.camera.intrinsics @ relative[:3, :3] @ np.linalg.inv(camera.intrinsics)).T
            direction = torch.tensor(rotated, dtype=torch.float32, device=device).permute(2, 0, 1).contiguous()
            self.maps.append((direction, [float(v) for v in neighbor.camera.intrinsics @ relative[:3, 3]]))

    def _warp(self, index: int, inverse_depth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A neighbour resampled onto the reference, and where that misses the neighbour's image."""
        direction, (bx, by, bz) = self.maps[index]
        image = self.neighbors[index].pixels
        height, width = image.shape
        z = direction[2] + bz * inverse_depth
        scale = 2 / z.clamp_min(1e-6)
        x = (direction[0] + bx * inverse_depth).mul_(scale).div_(width).sub_(1)
        y = (direction[1] + by * inverse_depth).mul_(scale).div_(height).sub_(1)
        outside = (x.abs() > 1) | (y.abs() > 1) | (z < 1e-6)
        grid = torch.stack([x, y], -1)
        samples = F.grid_sample(
            image[None, None].expand(len(grid), 1, height, width), grid, padding_mode="border", align_corners=False
        )
        return samples[:, 0], outside

    def _correlation(self, samples: torch.Tensor) -> torch.Tensor:
        samples = _pad(samples.sub_(0.5), self.radius)
        mean = _box_mean(samples, self.radius)
        variance = _box_mean(samples * samples, self.radius).sub_(mean * mean).clamp_min_(0)
        covariance = _box_mean(samples * self.padded, self.radius).sub_(mean * self.mean)
        return covariance.mul_(variance.add_(self.floor).mul_(self.variance + self.floor).rsqrt_())

    def score(self, inverse_depth: torch.Tensor) -> torch.Tensor:
        """Mean of the best correlations for (p, height, width) or (p, 1, 1) inverse depths; -1 counts for a miss."""
        ranked: list[torch.Tensor] = []
        for index in range(len(self.neighbors)):
            samples, outside = self._warp(index, inverse_depth)
            value = self._correlation(samples).masked_fill_(outside, -1)
            for place, kept in enumerate(ranked):
                ranked[place], value = torch.maximum(kept, value), torch.minimum(kept, value)
            if len(ranked) < self.best:
                ranked.append(value)
        return torch.stack(ranked).mean(0) if len(ranked) > 1 else ranked[0]

    def score_all(self, inverse_depth: torch.Tensor) -> torch.Tensor:
        """`score` in chunks that stay in the processor's cache."""
        chunk = max(1, 200_000 // self.mean[0].numel())
        return torch.cat([self.score(part) for part in inverse_depth.split(chunk)])


def plane_count(
    reference: Camera, neighbors: list[Camera], inverse_range: tuple[float, float], config: SweepConfig
) -> int:
    """Planes that keep the spacing in the neighbours near config.plane_step, measured at the image's centre."""
    center = np.array([reference.width / 2, reference.height / 2])
    motion = []
    for neighbor in neighbors:
        points = reference.unproject(np.stack([center, center]), 1 / np.array(inverse_range))
        pixels, depth = neighbor.project(points)
        motion.append(np.linalg.norm(pixels[1] - pixels[0]) if (depth > 0).all() else np.inf)
    return int(np.clip(np.ceil(np.median(motion) / config.plane_step), 16, config.max_planes))


def _aggregate(cost: torch.Tensor, image: torch.Tensor, config: SweepConfig) -> torch.Tensor:
    """Semi-global aggregation of a (planes, height, width) cost along four directions."""
    total = torch.zeros_like(cost)
    for dim in (1, 2):
        lines = cost.movedim(dim, 0).contiguous()
        pixels = image if dim == 1 else image.T
        contrast = (pixels[1:] - pixels[:-1]).abs()
        jump = (config.jump_penalty / (1 + 20 * contrast)).clamp_min(2 * config.smooth_penalty)
        for backward in (False, True):
            order = range(len(lines) - 1, -1, -1) if backward else range(len(lines))
            out = torch.empty_like(lines)
            previous = None
            for i in order:
                if previous is None:
                    out[i] = lines[i]
                else:
                    lowest = previous.amin(0)
                    step = torch.minimum(previous, lowest + jump[i if backward else i - 1])
                    raised = previous + config.smooth_penalty
                    torch.minimum(step[1:], raised[:-1], out=step[1:])
                    torch.minimum(step[:-1], raised[1:], out=step[:-1])
                    torch.sub(step.add_(lines[i]), lowest, out=out[i])
                previous = out[i]
            total += out.movedim(0, dim)
    return total


def _peak(below: torch.Tensor, at: torch.Tensor, above: torch.Tensor) -> torch.Tensor:
    """Where a parabola through three scores peaks, in steps from the middle one, at most one half."""
    curvature = below + above - 2 * at
    shift = 0.5 * (below - above) / torch.where(curvature < -1e-6, curvature, torch.full_like(curvature, -1e6))
    return shift.clamp_(-0.5, 0.5)


def _sweep(matcher: _Matcher, image: torch.Tensor, planes: torch.Tensor, config: SweepConfig) -> torch.Tensor:
    """Inverse depth (height, width) of the best plane of each pixel, refined between planes."""
    scores = matcher.score_all(planes[:, None, None])
    index = _aggregate(1 - scores, image, config).argmin(0, keepdim=True).clamp_(1, len(planes) - 2)
    shift = _peak(*(scores.gather(0, index + step) for step in (-1, 0, 1)))
    return (planes[index] + shift * (planes[1] - planes[0]))[0]


def _median(field: torch.Tensor) -> torch.Tensor:
    """Median over 3 x 3 pixels."""
    patches = F.unfold(_pad(field[None], 1)[None], 3)[0]
    return patches.median(0).values.reshape(field.shape)


def _fit_planes(
    field: torch.Tensor, weight: torch.Tensor, slope: torch.Tensor, tolerance: float, spacing: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Affine pieces around each pixel by weighted least squares over 5 x 5 pixels.

    A pixel near by counts by its weight and by how well the centre's plane (value and slope) predicts it: pieces do not
    reach across depth edges.

    Returns:
        the fitted value at each pixel, and the slope (2, height, width) per pixel along x and y.
    """
    height, width = field.shape
    reach = 2 * spacing
    padded, weights = _pad(field[None], reach)[0], F.pad(weight, (reach,) * 4)
    sums = [torch.zeros_like(field) for _ in range(9)]
    for dy in range(-reach, reach + 1, spacing):
        for dx in range(-reach, reach + 1, spacing):
            rows, columns = slice(reach + dy, reach + dy + height), slice(reach + dx, reach + dx + width)
            difference = padded[rows, columns] - field
            residual = (difference - (dx * slope[0] + dy * slope[1])).div_(tolerance)
            w = weights[rows, columns] / (1 + residual.square_()).square_()
            wx, wy, wd = w * dx, w * dy, w * difference
            for total, value in zip(sums, (w, wx, wy, wx * dx, wx * dy, wy * dy, wd, wd * dx, wd * dy), strict=True):
                total += value
    s, sx, sy, sxx, sxy, syy, sd, sdx, sdy = sums
    s = s.clamp_min(1e-12)
    mx, my, md = sx / s, sy / s, sd / s
    # A little of the unit matrix keeps lone pixels solvable: they come out flat.
    cxx, cxy, cyy = sxx / s - mx * mx + 1e-2, sxy / s - mx * my, syy / s - my * my + 1e-2
    cdx, cdy = sdx / s - mx * md, sdy / s - my * md
    determinant = cxx * cyy - cxy * cxy
    fitted = torch.stack([(cyy * cdx - cxy * cdy) / determinant, (cxx * cdy - cxy * cdx) / determinant])
    return field + md - fitted[0] * mx - fitted[1] * my, fitted


def _shifted(field: torch.Tensor, slope: torch.Tensor, dx: int, dy: int) -> torch.Tensor:
    """The field that gives each pixel the plane of the pixel at (dx, dy) from it."""
    height, width = field.shape
    reach = max(abs(dx), abs(dy))
    stacked = _pad(torch.stack([field, *slope]), reach)
    moved = stacked[:, reach + dy : reach + dy + height, reach + dx : reach + dx + width]
    return moved[0] - dx * moved[1] - dy * moved[2]


def _refine(
    matcher: _Matcher, field: torch.Tensor, step: float, bounds: tuple[float, float], config: SweepConfig
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Improve a field of inverse depth. Returns the field, its slope and the score.

    Args:
        step: change of inverse depth that moves a match by about a pixel.
    """
    slope = torch.zeros(2, *field.shape, device=field.device)
    score = matcher.score(field[None])[0]
    for iteration in range(config.iterations):
        if iteration == 0:
            field = _median(field)
        weight = score.clamp_min(0.05) ** 2
        smooth, slope = _fit_planes(field, weight, slope, 2 * step, 1)
        smooth, slope = _fit_planes(smooth, weight, slope, step, 2)
        reach = 4 >> iteration
        moves = [(reach, 0), (-reach, 0), (0, reach), (0, -reach)]
        candidates = torch.stack([smooth, field] + [_shifted(smooth, slope, *move) for move in moves])
        best, index = matcher.score_all(candidates.clamp_(*bounds)).max(0)
        chosen = candidates.gather(0, index[None])[0]
        small = step * 0.5 / (1 + iteration)
        below, above = matcher.score_all(torch.stack([chosen - small, chosen + small]))
        at_peak = (best >= below) & (best >= above)
        uphill = torch.where(above > below, 1.0, -1.0)
        offset = torch.where(at_peak, _peak(below, best, above), uphill)
        field = (chosen + small * offset).clamp_(*bounds)
        score = torch.maximum(best, torch.maximum(below, above))
    weight = score.clamp_min(0.05) ** 2
    _, slope = _fit_planes(field, weight, slope, 0.5 * step, 2)
    smooth, slope = _fit_planes(field, weight, slope, 0.5 * step, 2)
    return smooth, slope, matcher.score(smooth[None])[0]


def _normals(field: torch.Tensor, slope: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Normals (height, width, 3) facing the camera: the plane w(p) = g . (x, y, 1) has the normal K^T g."""
    offsets = torch.tensor(pixel_centers(camera.viewport), dtype=torch.float32, device=field.device)
    away = torch.stack(
        [
            camera.fx * slope[0],
            camera.fy * slope[1],
            field - slope[0] * (offsets[..., 0] - camera.cx) - slope[1] * (offsets[..., 1] - camera.cy),
        ],
        -1,
    )
    return -away * away.square().sum(-1, keepdim=True).clamp_min(1e-24).rsqrt()


def estimate_depth(
    reference: GrayView,
    neighbors: list[GrayView],
    inverse_range: tuple[float, float],
    config: SweepConfig,
    refine: bool = True,
) -> DepthEstimate:
    """Depth and normals of the reference image.

    Args:
        reference, neighbors: gray images on one device; neighbours may differ in size.
        inverse_range: smallest and largest inverse depth to search.
        refine: False stops after the sweep and returns at the sweep's resolution.
    """
    pyramid = [(reference, neighbors)]
    while max(pyramid[-1][0].pixels.shape) > config.sweep_size:
        view, others = pyramid[-1]
        pyramid.append((view.halved(), [other.halved() for other in others]))
    view, others = pyramid[-1]
    count = plane_count(view.camera, [other.camera for other in others], inverse_range, config)
    planes = torch.linspace(*inverse_range, count, device=view.pixels.device)
    matcher = _Matcher(view, others, config)
    field = _sweep(matcher, view.pixels, planes, config)
    # A pixel's worth of inverse depth at the sweep's resolution; it halves with each finer one.
    step = float(planes[1] - planes[0]) / config.plane_step
    bounds = (inverse_range[0] * 0.8, inverse_range[1] * 1.1)
    if refine:
        field, slope, score = _refine(matcher, field, step, bounds, config)
        for view, others in reversed(pyramid[:-1]):
            matcher, step = _Matcher(view, others, config), step / 2
            field = F.interpolate(field[None, None], size=view.pixels.shape, mode="bilinear")[0, 0]
            field, slope, score = _refine(matcher, field, step, bounds, config)
    else:
        flat = torch.zeros(2, *field.shape, device=field.device)
        field, slope = _fit_planes(_median(field), torch.ones_like(field), flat, step, 1)
        score = matcher.score(field[None])[0]
    keep = (score > config.min_score) & (matcher.variance[0] > config.min_contrast**2)
    depth = torch.where(keep, 1 / field, 0)
    return DepthEstimate(depth.cpu().numpy(), _normals(field, slope, view.camera).cpu().numpy(), score.cpu().numpy())
