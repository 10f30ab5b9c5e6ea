"""Splatting pixel by point, with the textbook formulas and autograd: nothing shared with the splatter."""

from typing import NamedTuple

import torch


class Screen(NamedTuple):
    """means (n, 2) px, covariances (n, 2, 2) px^2 and depths (n,) of projected disks."""

    means: torch.Tensor
    covariances: torch.Tensor
    depths: torch.Tensor


def project(positions, normals, footprints, pose, lens, low_pass) -> Screen:
    """Differentiable in the camera too: pose (4, 4) = camera_from_world, lens = fx, fy, cx, cy."""
    fx, fy, cx, cy = lens
    p = positions @ pose[:3, :3].T + pose[:3, 3]
    n = normals @ pose[:3, :3].T
    x, y, z = p.unbind(1)
    zero = torch.zeros_like(x)
    perspective = torch.stack(
        [torch.stack([fx / z, zero, -fx * x / z**2], 1), torch.stack([zero, fy / z, -fy * y / z**2], 1)], 1
    )
    disk = torch.eye(3, dtype=p.dtype) - n[:, :, None] * n[:, None, :]
    sigma = footprints[:, None, None] * perspective @ disk @ perspective.transpose(1, 2)
    means = torch.stack([fx * x / z + cx, fy * y / z + cy], 1)
    return Screen(means, sigma + low_pass * torch.eye(2, dtype=p.dtype), z)


class _Pairs(NamedTuple):
    """For every pixel and point, near to far: squared Mahalanobis distance q, that up to which the point is drawn, and
    alpha without cut-offs, 0 for points that are not drawn at all."""

    order: torch.Tensor
    q: torch.Tensor
    reach2: torch.Tensor
    alpha: torch.Tensor


def _pairs(positions, normals, footprints, opacities, camera, viewport, config) -> _Pairs:
    pose = torch.tensor(camera.camera_from_world, dtype=positions.dtype)
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    means, covariances, z = project(positions, normals, footprints, pose, lens, config.low_pass)
    columns = torch.arange(viewport.x0, viewport.x0 + viewport.width) + 0.5
    rows = torch.arange(viewport.y0, viewport.y0 + viewport.height) + 0.5
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1).to(positions.dtype)
    d = pixels[:, :, None] - means
    q = torch.einsum("hwni,nij,hwnj->hwn", d, torch.linalg.inv(covariances), d)
    size = torch.tensor([camera.width, camera.height])
    kept = ((means > -config.guard_band * size) & (means < (1 + config.guard_band) * size)).all(1) & (z > config.near)
    reach2 = torch.full_like(opacities, config.support**2)
    if config.alpha_min > 0:  # o exp(-q / 2) >= alpha_min
        reach2 = torch.minimum(reach2, 2 * torch.log(opacities / config.alpha_min))
    order = torch.argsort(z, stable=True)
    return _Pairs(order, *(t[..., order] for t in (q, reach2, torch.where(kept, opacities * torch.exp(-q / 2), 0))))


def splat(positions, normals, footprints, opacities, features, camera, viewport, config):
    """Image and transmittance."""
    order, q, reach2, alpha = _pairs(positions, normals, footprints, opacities, camera, viewport, config)
    alpha = torch.where(q <= reach2, alpha, 0)
    image, through = 0, torch.ones(alpha.shape[:2], dtype=positions.dtype)
    for alpha_i, feature in zip(alpha.unbind(2), features[order], strict=True):
        drawn = torch.where(through >= config.stop_transmittance, alpha_i, 0)
        image = image + (through * drawn)[..., None] * feature
        through = through * (1 - drawn)
    return image, through


def settled_pixels(scene, camera, viewport, config, room):
    """Pixels (height, width) in which no pair is so near to a cut-off of `config`, within this share of it, that
    rounding may decide on which side it is."""
    _, q, reach2, alpha = _pairs(*(t.double() for t in scene[:4]), camera, viewport, config)
    near = ((q - reach2).abs() < room * (1 + reach2.abs())) & (alpha > 0)
    alpha = torch.where(q <= reach2, alpha, 0)
    through = torch.cumprod(1 - alpha, 2)  # as long as all are drawn, which is up to the first stop
    stop = config.stop_transmittance
    return ~(near | ((through - stop).abs() < room * stop)).any(2)
