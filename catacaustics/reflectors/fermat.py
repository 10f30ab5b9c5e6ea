"""Fermat's principle on any mirror: the path from the camera to a mirror and on to a source is stationary.

Shared by the mirrors that solve for it (quadric.py, revolution.py).
"""

from typing import NamedTuple

import torch
from torch import Tensor

from catacaustics.shapes import Bool, Float, Int

_GRAZING = 1e-3
"""Cosine of incidence below which a point counts as invisible: the rim, where the image shrinks to nothing."""
_STATIONARY = 1e-2
"""Length along the mirror of the sum of the unit vectors to camera and source, below which a path is one of light."""
_STRETCH = 30.0
"""Magnification is cut to this: a concave mirror with the source at the focus would show it infinitely large."""


class Specular(NamedTuple):
    """Points of reflection: differentiable `points`; `visible` where camera and source face the mirror there and the
    path is stationary; `jacobian` (no gradients), the map from displacements of the source to displacements of the
    displayed point, which lies on the ray at the length of the path; `start`, the solution, which saves solving again
    for the same arguments: then `visible` and `jacobian` are None, as they are known; `rows`, which source each is an
    image of, where the mirror shows some several times and others not at all (None: one each, in order)."""

    points: Float[Tensor, "n 3"]
    visible: Bool[Tensor, "n"] | None
    jacobian: Float[Tensor, "n 3 3"] | None
    start: Float[Tensor, "n 3"]
    rows: Int[Tensor, "n"] | None = None


class Path(NamedTuple):
    """Unit vectors from the mirror to camera and source, and the distances."""

    to_camera: Tensor
    to_source: Tensor
    camera_distance: Tensor
    source_distance: Tensor


def path_over(points: Float[Tensor, "n 3"], sources: Float[Tensor, "n 3"], camera: Float[Tensor, "3"]) -> Path:
    """The path from the camera over points of a mirror to sources."""
    a, b = camera - points, sources - points
    tiny = torch.finfo(points.dtype).tiny ** 0.5
    da, db = (torch.sqrt((v * v).sum(1, keepdim=True) + tiny) for v in (a, b))
    return Path(a / da, b / db, da, db)


def reflects(path: Path, normal: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Whether camera and source face the mirror there and the path is stationary."""
    cosine = torch.minimum((normal * path.to_camera).sum(1), (normal * path.to_source).sum(1))
    tangential = path.to_camera + path.to_source
    tangential = tangential - (tangential * normal).sum(1, keepdim=True) * normal
    return (cosine > _GRAZING) & (tangential.norm(dim=1) < _STATIONARY)


def solve2(matrix: Tensor, vector: Tensor) -> Tensor:
    """Solve symmetric 2x2 systems; a singular one gives a large finite answer."""
    a, b, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    x, y = vector.unbind(1)
    return torch.stack([d * x - b * y, a * y - b * x], 1) / _determinant(matrix)[:, None]


def _determinant(matrix: Tensor) -> Tensor:
    value = matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] ** 2
    floor = 1e-6 * matrix.square().sum((1, 2)) + torch.finfo(matrix.dtype).tiny ** 0.5
    return torch.where(value.abs() < floor, torch.where(value < 0, -floor, floor), value)


def shortened(step: Tensor, limit: float) -> Tensor:
    return step / (step.norm(dim=1, keepdim=True) / limit).clamp_min(1)


def tangents(u: Tensor) -> Tensor:
    """Two orthonormal tangents of the unit sphere, (n, 3, 2) (Duff et al. 2017)."""
    x, y, z = u.unbind(1)
    sign = torch.where(z < 0, -torch.ones_like(z), torch.ones_like(z))
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], 1)
    return torch.stack([first, torch.stack([b, sign + y * y * a, -y], 1)], 2)


def display_jacobian(
    path: Path, hessian: Float[Tensor, "n 2 2"], edges: Float[Tensor, "n 3 2"]
) -> Float[Tensor, "n 3 3"]:
    """d(displayed) / d(source) across the ray: D / (d1 d2) (I - a a') E H^-1 E' (I - b b'), E the mirror's tangents.

    For a sphere this is Coddington's pair of magnifications, 1 / (1 + 2 d1 d2 cos(i) / (r D)) across the plane of
    incidence and 1 / (1 + 2 d1 d2 / (r cos(i) D)) in it, D = d1 + d2.
    """
    columns = []
    for direction, distance in (path[::2], path[1::2]):
        across = edges - direction[:, :, None] * torch.einsum("ni,nij->nj", direction, edges)[:, None, :]
        columns.append(across / distance[:, :, None])
    a, b, d = hessian[:, 0, 0], hessian[:, 0, 1], hessian[:, 1, 1]
    inverse = torch.stack([d, -b, -b, a], 1).view(-1, 2, 2) / _determinant(hessian)[:, None, None]
    length = (path.camera_distance + path.source_distance)[:, :, None]
    return length * columns[0] @ inverse @ columns[1].transpose(1, 2)


def tilted_disks(
    jacobian: Float[Tensor, "n 3 3"], to_camera: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
    """Normals and factors of the squared radius of disks that look like the images of round sources under a Jacobian.

    A disk whose normal is tilted by t against the ray looks like an ellipse of axes 1 and cos t, so that every ellipse
    can be shown by a disk.

    Args:
        jacobian: across the rays (its columns are perpendicular to `to_camera`).
        to_camera: unit vectors.
    """
    basis = tangents(to_camera)
    flat = basis.transpose(1, 2) @ jacobian
    covariance = flat @ flat.transpose(1, 2)
    a, b, d = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    middle, half = (a + d) / 2, (a - d) / 2
    spread = (half * half + b * b).sqrt()
    major, minor = (middle + spread), (middle - spread).clamp_min(0)
    aspect = (minor / major.clamp_min(torch.finfo(a.dtype).tiny)).clamp(0, 1)
    # The major axis is at half the angle of (half, b); the minor one across it.
    turn = torch.atan2(b, half) / 2
    axis = torch.stack([-torch.sin(turn), torch.cos(turn)], 1)
    sideways = torch.einsum("nij,nj->ni", basis, axis)
    normals = aspect.sqrt()[:, None] * to_camera + (1 - aspect).sqrt()[:, None] * sideways
    return normals, major.clamp(1e-8, _STRETCH**2)
