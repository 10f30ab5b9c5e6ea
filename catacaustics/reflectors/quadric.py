"""Where a curved mirror shows a point: Fermat's principle on a sphere or an ellipsoid.

A mirror is the image x = s + A u of the unit sphere (|u| = 1), A = rotation times diag(radii), seen from outside
(convex) or from inside (concave). From camera centre c, a source P is seen at the point x where the path
L = |c - x| + |x - P| is stationary. A convex mirror has one such point that c and P both face. A concave one has up to
four (Alhazen's problem). Where camera and source are outside the sphere, the one is kept whose normal lies between
their directions from the centre; where one of them is inside, the one with the smallest angle of incidence: the mirror
image of paraxial optics, upright or inverted. An ellipsoid follows from the sphere of its mean radius.
"""

import math

import torch
from torch import Tensor

from catacaustics.reflectors.fermat import (
    Path,
    Specular,
    display_jacobian,
    path_over,
    reflects,
    shortened,
    solve2,
    tangents,
)
from catacaustics.shapes import Float

_ITERATIONS = 40
_SCAN = 65
"""Angles at which a concave mirror's roots are looked for, where several can be."""
_MAX_STEP = 0.4
"""Newton steps on the ellipsoid are cut to this many radians."""


def sphere_angle(
    camera: Float[Tensor, "*n"], source: Float[Tensor, "*n"], between: Float[Tensor, "*n"], radius: Float[Tensor, ""]
) -> Float[Tensor, "*n"]:
    """Angle of the mirror's normal from the camera's direction, seen from the centre of a sphere.

    A root of (angle of incidence of the camera) - (angle of incidence of the source). It is always bracketed, for a
    convex mirror and for camera and source outside the sphere by [0, between], so that bisection saves Newton's method
    wherever that leaves the bracket.

    Args:
        camera, source: distances of camera and source from the centre.
        between: angle between their directions, in [0, pi].
        radius: of the sphere, negative for its concave side.
    """
    low, high = torch.zeros_like(between), between.clone()
    inside = (torch.minimum(camera, source) < -radius).nonzero()[:, 0] if between.ndim else []
    if len(inside):
        ends = _paraxial_bracket(camera[inside], source[inside], between[inside], radius)
        low[inside], high[inside] = ends
    angle = (low + high) / 2
    tolerance = 16 * torch.finfo(between.dtype).eps
    for _ in range(_ITERATIONS):
        value_c, slope_c = _incidence(camera, angle, radius)
        value_p, slope_p = _incidence(source, between - angle, radius)
        value, slope = value_c - value_p, slope_c + slope_p
        low, high = torch.where(value < 0, angle, low), torch.where(value < 0, high, angle)
        newton = angle - value / torch.where(slope.abs() < 1e-12, 1e-12, slope)
        # A root that is found sits on an end of its bracket; rounding alone would send it to the middle again.
        found = (newton - angle).abs() < tolerance
        enclosed = (newton - low) * (newton - high) < 0
        following = torch.where(enclosed, newton, torch.where(found, angle, (low + high) / 2))
        done = (following - angle).abs().max() if angle.numel() else angle.new_zeros(())
        angle = following
        if done < tolerance:
            break
    return angle


def _paraxial_bracket(camera: Tensor, source: Tensor, between: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Angles with a negative and a positive difference of incidence, around the root of least incidence; [0, between]
    where the scan finds none."""
    grid = torch.linspace(-math.pi, math.pi, _SCAN, dtype=between.dtype, device=between.device)
    value_c = _incidence(camera[:, None], grid, radius)[0]
    value_p = _incidence(source[:, None], between[:, None] - grid, radius)[0]
    value = value_c - value_p
    facing = (value_c.abs() < math.pi / 2) & (value_p.abs() < math.pi / 2)
    changes = (value[:, :-1] < 0) != (value[:, 1:] < 0)
    changes &= facing[:, :-1] & facing[:, 1:]
    incidence = torch.where(changes, (value_c[:, :-1] + value_c[:, 1:]).abs(), torch.inf)
    least, cell = incidence.min(1)
    first, second = grid[cell], grid[cell + 1]
    rising = value.gather(1, cell[:, None])[:, 0] < 0
    low, high = torch.where(rising, first, second), torch.where(rising, second, first)
    found = torch.isfinite(least)
    return torch.where(found, low, 0), torch.where(found, high, between)


def _incidence(distance: Tensor, angle: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Angle between the normal and the ray to a point at `distance` from the centre, `angle` from the normal; and its
    derivative by `angle`."""
    across, along = distance * torch.sin(angle), distance * torch.cos(angle) - radius
    squared = (across**2 + along**2).clamp_min(torch.finfo(angle.dtype).tiny)
    return torch.atan2(across, along), (distance**2 - radius * distance * torch.cos(angle)) / squared


def specular_points(
    sources: Float[Tensor, "n 3"],
    camera: Float[Tensor, "3"],
    center: Float[Tensor, "3"],
    axes: Float[Tensor, "3 3"],
    concave: bool = False,
    start: Float[Tensor, "n 3"] | None = None,
) -> Specular:
    """Points of reflection on an ellipsoid, with exact first derivatives by all arguments.

    The solution is found without gradients; one more Newton step, differentiated with its Hessian held fixed, is the
    implicit function theorem. Points inside, on or behind the mirror get a finite answer that is not visible.

    Args:
        sources: world positions of what is mirrored.
        camera: camera centre.
        center, axes: x = center + axes @ u for unit u; the columns are the half-axes.
        concave: the inner side mirrors.
        start: what an earlier call returned for the same arguments.
    """
    with torch.no_grad():
        u = stationary(sources, camera, center, axes, concave) if start is None else start
        basis = tangents(u)
        path = path_over(center + u @ axes.T, sources, camera)
        hessian = _hessian(path, u, basis, axes)
    gradient = _gradient(path_over(center + u @ axes.T, sources, camera), axes)
    step = solve2(hessian, torch.einsum("nij,ni->nj", basis, gradient))
    moved = u - torch.einsum("nij,nj->ni", basis, shortened(step, _MAX_STEP))
    points = center + torch.nn.functional.normalize(moved, dim=1) @ axes.T
    if start is not None:
        return Specular(points, None, None, u)
    with torch.no_grad():
        normal = torch.nn.functional.normalize(u @ torch.linalg.inv(axes), dim=1) * (-1 if concave else 1)
        visible = reflects(path, normal)
        jacobian = display_jacobian(path, hessian, torch.einsum("ij,njk->nik", axes, basis))
    return Specular(points, visible, jacobian, u)


def _gradient(path: Path, axes: Tensor) -> Tensor:
    """dL/du."""
    return -(path.to_camera + path.to_source) @ axes


def _hessian(path: Path, u: Tensor, basis: Tensor, axes: Tensor) -> Tensor:
    """Second derivatives of L along the tangents of the unit sphere, (n, 2, 2), kept away from singular."""
    edges = torch.einsum("ij,njk->nik", axes, basis)
    total = edges.new_zeros(len(u), 2, 2)
    for direction, distance in (path[::2], path[1::2]):
        along = torch.einsum("nij,ni->nj", edges, direction)
        total += (edges.transpose(1, 2) @ edges - along[:, :, None] * along[:, None, :]) / distance[:, :, None]
    curvature = -(u * _gradient(path, axes)).sum(1)
    total.diagonal(dim1=1, dim2=2).add_(curvature[:, None])
    return total


def distances(
    points: Float[Tensor, "n 3"], center: Float[Tensor, "3"], axes: Float[Tensor, "3 3"]
) -> Float[Tensor, "n"]:
    """Signed distances from an ellipsoid, outside positive, to first order (Taubin 1991); differentiable."""
    inverse = torch.linalg.inv(axes)
    scaled = (points - center) @ inverse.T
    norms = scaled.norm(dim=1).clamp_min(1e-9)
    return (norms - 1) * norms / (scaled @ inverse).norm(dim=1).clamp_min(1e-9)


def stationary(
    sources: Float[Tensor, "n 3"],
    camera: Float[Tensor, "3"],
    center: Float[Tensor, "3"],
    axes: Float[Tensor, "3 3"],
    concave: bool,
) -> Float[Tensor, "n 3"]:
    """Unit vectors u of the stationary points: exact for a sphere, from there by Newton's method."""
    radii = axes.norm(dim=0)
    v, w = (camera - center).expand_as(sources), sources - center
    dv, dw = v.norm(dim=1), w.norm(dim=1)
    tiny = torch.finfo(sources.dtype).tiny
    unit_v, unit_w = v / dv.clamp_min(tiny)[:, None], w / dw.clamp_min(tiny)[:, None]
    # Across v, in the plane of v and w; any perpendicular where they are in line.
    across = unit_w - (unit_w * unit_v).sum(1, keepdim=True) * unit_v
    between = torch.atan2(across.norm(dim=1), (unit_w * unit_v).sum(1))
    sideways = torch.where(across.norm(dim=1, keepdim=True) > 1e-6, across, tangents(unit_v)[:, :, 0])
    sideways = torch.nn.functional.normalize(sideways, dim=1)
    sign = -1.0 if concave else 1.0
    angle = sphere_angle(dv, dw, between, sign * radii.mean())[:, None]
    normal = torch.cos(angle) * unit_v + torch.sin(angle) * sideways
    u = sign * torch.nn.functional.normalize(normal @ axes, dim=1)
    if float(radii.max() - radii.min()) <= 1e-6 * float(radii.max()):
        return u
    return _newton(u, sources, camera, center, axes, concave)


def _newton(
    u: Float[Tensor, "n 3"],
    sources: Float[Tensor, "n 3"],
    camera: Float[Tensor, "3"],
    center: Float[Tensor, "3"],
    axes: Float[Tensor, "3 3"],
    concave: bool,
) -> Float[Tensor, "n 3"]:
    """From u by Newton's method. On a convex mirror L has a minimum: a step that makes the path longer is taken back,
    and cut to a quarter; where a source is near the mirror, L is no parabola."""
    # The digits double: the last, differentiated step reaches the rest.
    eps = torch.finfo(u.dtype).eps
    active = torch.arange(len(u), device=u.device)
    here, best, move = u, u.clone(), torch.zeros_like(u)
    least = torch.full_like(u[:, 0], torch.inf)
    for _ in range(_ITERATIONS // 2):
        path, basis = path_over(center + here @ axes.T, sources[active], camera), tangents(here)
        gradient = torch.einsum("nij,ni->nj", basis, _gradient(path, axes))
        hessian = _hessian(path, here, basis, axes)
        step = solve2(hessian if concave else _convex(hessian), gradient)
        following = torch.einsum("nij,nj->ni", basis, shortened(step, _MAX_STEP))
        total = (path.camera_distance + path.source_distance)[:, 0]
        better = (total <= least * (1 + 8 * eps)) | concave
        least = torch.where(better, total, least)
        best = torch.where(better[:, None], here, best)
        move = torch.where(better[:, None], following, move / 4)
        here = torch.nn.functional.normalize(best - move, dim=1)
        u[active] = here
        going = move.norm(dim=1) >= eps**0.6
        active, here, best, move, least = (t[going] for t in (active, here, best, move, least))
        if not len(active):
            break
    return u


def _convex(hessian: Float[Tensor, "n 2 2"]) -> Float[Tensor, "n 2 2"]:
    """With the diagonal raised until both eigenvalues are positive: Newton's method then goes downhill."""
    middle = (hessian[:, 0, 0] + hessian[:, 1, 1]) / 2
    spread = ((hessian[:, 0, 0] - hessian[:, 1, 1]) ** 2 / 4 + hessian[:, 0, 1] ** 2).sqrt()
    lift = (1e-3 * (middle.abs() + spread) - (middle - spread)).clamp_min(0)
    return hessian + lift[:, None, None] * torch.eye(2, dtype=hessian.dtype, device=hessian.device)
