"""Where a mirror of revolution shows a point: Fermat's principle on x^2 + y^2 = q(z), q a cubic B-spline.

The squared radius q is smooth where the mirror meets its axis, and of an ellipsoid of revolution it is quadratic in z:
vases, bottles and lamps are as easy as balls. A lamp above a vase can be seen in its belly, its neck and its lip: all
images are found, where the length of the path changes between rising and falling along the mirror's profile.
"""

from typing import NamedTuple

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
from catacaustics.shapes import Bool, Float, Int

_RINGS = 2
"""Heights a spline cell at which images are looked for: two images of a point at less distance are not told apart."""
_TURNS = 3
"""Times that a ring's nearest point is improved before it is asked whether the path rises or falls there."""
_ASTRAY = 4.0
"""Rings that an image can be away from where it was looked for."""
_SAME = 1e-4
"""Images of a point that are nearer to each other than this, in units of the mean radius, are the same."""
_ITERATIONS = 8
_MAX_STEP = 0.1
"""Newton steps are cut to this, in units of the mean radius."""
_HIDERS = 6
"""Places along a path where it is asked whether the mirror itself is in the way."""
_BLOCK = 4096
"""Sources are searched in blocks that stay in the processor's cache."""
_OFF = 1e-3
"""A point farther from the mirror than this, in units of the mean radius, has not been found."""

_MARCH, _BISECTIONS = 129, 40
"""Steps in which rays look for the mirror, and then narrow down where they meet it."""


class Revolution(NamedTuple):
    """A surface of revolution, and an ellipsoid about as large.

    Args:
        center: (3,) on the axis, where z = 0.
        frame: (3, 3) rotation, the axis in its third column.
        radii: (3,) of the ellipsoid in that frame.
        ends: (2,) values of z between which the mirror is; beyond them q goes on in a straight line.
        squared: (k,) coefficients of q, k >= 4.
    """

    center: Float[Tensor, "3"]
    frame: Float[Tensor, "3 3"]
    radii: Float[Tensor, "3"]
    ends: Float[Tensor, "2"]
    squared: Float[Tensor, "k"]


def profile(
    surface: Revolution, z: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """The squared radius q at heights along the axis, and its first two derivatives; differentiable."""
    low, high = surface.ends
    cell = (high - low) / (len(surface.squared) - 3)
    place = (z - low) / cell
    first = place.detach().nan_to_num().floor().clamp(0, len(surface.squared) - 4)
    t = (place - first).clamp(0, 1)
    beyond = place - first - t
    a, b, c, d = (surface.squared[first.long() + i] for i in range(4))
    value = ((1 - t) ** 3 * a + (3 * t**3 - 6 * t**2 + 4) * b + (3 * (t + t**2 - t**3) + 1) * c + t**3 * d) / 6
    slope = (-((1 - t) ** 2) * a + (3 * t**2 - 4 * t) * b + (1 + 2 * t - 3 * t**2) * c + t**2 * d) / 2
    curvature = torch.where(beyond == 0, (1 - t) * a + (3 * t - 2) * b + (1 - 3 * t) * c + t * d, 0)
    return value + slope * beyond, slope / cell, curvature / cell**2


class _Level(NamedTuple):
    """F = x^2 + y^2 - q(z), its gradient in world coordinates; its second derivatives are 2 - bend e e', e the axis."""

    value: Float[Tensor, "n"]
    gradient: Float[Tensor, "n 3"]
    bend: Float[Tensor, "n"]


def _level(surface: Revolution, points: Float[Tensor, "n 3"]) -> _Level:
    local = (points - surface.center) @ surface.frame
    q, slope, curvature = profile(surface, local[:, 2])
    across = local[:, :2]
    gradient = torch.cat([2 * across, -slope[:, None]], 1) @ surface.frame.T
    return _Level((across * across).sum(1) - q, gradient, 2 + curvature)


def distances(surface: Revolution, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Signed distances from the surface, outside positive, to first order (Taubin 1991); differentiable."""
    level = _level(surface, points)
    return level.value / level.gradient.norm(dim=1).clamp_min(1e-9 * float(surface.radii.detach().mean()))


def ray_distances(surface: Revolution, origin: Float[Tensor, "3"], rays: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Distances along unit rays to where they first meet the surface, nan where they miss it; they pass nothing that is
    thinner than 1 % of its length."""
    middle = surface.center + surface.ends.mean() * surface.frame[:, 2]
    reach = ((surface.ends[1] - surface.ends[0]).square() / 4 + surface.squared.max().clamp_min(0)).sqrt()
    nearest = rays @ (middle - origin)
    first = (nearest - reach).clamp_min(0)

    def inside(points: Tensor) -> Tensor:
        local = (points - surface.center) @ surface.frame
        between = (local[:, 2] > surface.ends[0]) & (local[:, 2] < surface.ends[1])
        return between & (local[:, :2].square().sum(1) < profile(surface, local[:, 2])[0])

    low, high = first, torch.full_like(first, torch.nan)
    for share in torch.linspace(0, 1, _MARCH)[1:].tolist():
        here = first + share * (nearest + reach - first)
        met = high.isnan() & inside(origin + here[:, None] * rays)
        high = torch.where(met, here, high)
        low = torch.where(high.isnan(), here, low)
    for _ in range(_BISECTIONS):
        here = (low + high) / 2
        met = inside(origin + here[:, None] * rays)
        low, high = torch.where(met, low, here), torch.where(met, here, high)
    z = (origin + high[:, None] * rays - surface.center) @ surface.frame[:, 2]
    margin = 1e-6 * (surface.ends[1] - surface.ends[0])
    on_mirror = (z > surface.ends[0] + margin) & (z < surface.ends[1] - margin)  # and not on a flat end
    return torch.where(on_mirror & (high > 0), high, torch.nan)


def specular_points(
    sources: Float[Tensor, "n 3"],
    camera: Float[Tensor, "3"],
    surface: Revolution,
    start: Float[Tensor, "n 3"] | None = None,
) -> Specular:
    """Points of reflection on the outside of a surface of revolution, with exact first derivatives by all arguments.

    As `quadric.specular_points`: the solution x is found without gradients; one more Newton step of grad L = m grad F,
    F = 0, differentiated with its matrix held fixed, is the implicit function theorem.

    Args:
        sources: world positions of what is mirrored.
        camera: camera centre.
        start: what an earlier call returned for the rows of these sources and the same camera.
    """
    rows, at = None, start
    size = float(surface.radii.detach().mean())
    if at is None:
        with torch.no_grad():
            rows, at = _images(sources, camera, surface, size)
        sources = sources[rows]
    with torch.no_grad():
        path, level = path_over(at, sources, camera), _level(surface, at)
        steepness = level.gradient.norm(dim=1, keepdim=True).clamp_min(1e-9 * size)
        normal = level.gradient / steepness
        basis = tangents(normal)
        multiplier = -((path.to_camera + path.to_source) * normal).sum(1, keepdim=True) / steepness
        hessian, slant = _lagrangian(path, level, surface.frame[:, 2], multiplier, basis, normal)
    here, towards = _level(surface, at), path_over(at, sources, camera)
    off = (-here.value[:, None] / steepness).clamp(-_MAX_STEP * size, _MAX_STEP * size)
    rest = -(towards.to_camera + towards.to_source) - multiplier * here.gradient
    step = solve2(hessian, torch.einsum("nij,ni->nj", basis, rest) + slant * off)
    points = at - torch.einsum("nij,nj->ni", basis, shortened(step, _MAX_STEP * size)) + normal * off
    if rows is None:
        return Specular(points, None, None, at)
    with torch.no_grad():
        z = (at - surface.center) @ surface.frame[:, 2]
        visible = reflects(path, normal) & (z > surface.ends[0]) & (z < surface.ends[1])
        visible &= level.value.abs() < _OFF * size * steepness[:, 0]
        visible[visible.clone()] = _unhidden(surface, at[visible], camera, sources[visible])
        jacobian = display_jacobian(path, hessian, basis)
    return Specular(points, visible, jacobian, at, rows)


def _lagrangian(
    path: Path, level: _Level, axis: Tensor, multiplier: Tensor, basis: Tensor, normal: Tensor
) -> tuple[Float[Tensor, "n 2 2"], Float[Tensor, "n 2"]]:
    """Second derivatives of L - m F, m the multiplier: along the mirror's tangents, and along them and the normal."""
    along = torch.einsum("nij,i->nj", basis, axis)
    bend = multiplier * level.bend[:, None]
    hessian = (bend * along)[:, :, None] * along[:, None, :]
    slant = bend * (normal @ axis)[:, None] * along
    round_part = -2 * multiplier
    for direction, distance in (path[::2], path[1::2]):
        flat = torch.einsum("nij,ni->nj", basis, direction)
        hessian = hessian - (flat / distance)[:, :, None] * flat[:, None, :]
        slant = slant - (direction * normal).sum(1, keepdim=True) / distance * flat
        round_part = round_part + 1 / distance
    hessian.diagonal(dim1=1, dim2=2).add_(round_part)
    return hessian, slant


def _images(
    sources: Tensor, camera: Tensor, surface: Revolution, size: float
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m 3"]]:
    """Rows of sources, and stationary points on the mirror's outside, one for each of their images: Newton's method
    from where the path stops rising or falling along the profile."""
    parts = [_roughly(block, camera, surface) for block in sources.split(_BLOCK)]
    rows = torch.cat([part[0] + i * _BLOCK for i, part in enumerate(parts)])
    x = torch.cat([part[1] for part in parts])
    first = (x - surface.center) @ surface.frame[:, 2]
    # Newton's method doubles the digits: the last, differentiated step reaches the rest.
    tolerance = size * torch.finfo(x.dtype).eps ** 0.6
    active = torch.arange(len(x), device=x.device)
    for _ in range(_ITERATIONS):
        here = x[active]
        path, level = path_over(here, sources[rows[active]], camera), _level(surface, here)
        steepness = level.gradient.norm(dim=1, keepdim=True).clamp_min(1e-9 * size)
        normal, uphill = level.gradient / steepness, -(path.to_camera + path.to_source)
        basis, multiplier = tangents(normal), (uphill * normal).sum(1, keepdim=True) / steepness
        hessian, _ = _lagrangian(path, level, surface.frame[:, 2], multiplier, basis, normal)
        step = solve2(hessian, torch.einsum("nij,ni->nj", basis, uphill))
        step = torch.einsum("nij,nj->ni", basis, shortened(step, _MAX_STEP * size))
        moved = _onto(surface, here - step, size)
        x[active] = moved
        active = active[(moved - here).abs().amax(1) >= tolerance]
        if not len(active):
            break
    z = (x - surface.center) @ surface.frame[:, 2]
    ring = (surface.ends[1] - surface.ends[0]) / (_RINGS * (len(surface.squared) - 3))
    kept = (z - first).abs() < _ASTRAY * ring
    # Images of one source follow each other: two that were found from different rings, and are the same, do too.
    kept[1:] &= (rows[1:] != rows[:-1]) | ((x[1:] - x[:-1]).abs().amax(1) > _SAME * size)
    return rows[kept], x[kept]


def _roughly(
    sources: Float[Tensor, "n 3"], camera: Tensor, surface: Revolution
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m 3"]]:
    """Rows of sources, and about where on the mirror's outside their images are.

    On a ring about the axis the shortest path leads over the point in whose direction from the axis the unit vectors to
    camera and source add up. From ring to ring, the path's change along the profile is followed to where its sign does.
    """
    z = torch.linspace(0, 1, _RINGS * (len(surface.squared) - 3) + 1, dtype=sources.dtype, device=sources.device)
    z = surface.ends[0] + z * (surface.ends[1] - surface.ends[0])
    q, slope, _ = profile(surface, z)
    radius = q.clamp_min(0).sqrt()
    eye = (camera - surface.center) @ surface.frame
    there = (sources - surface.center) @ surface.frame
    tiny = torch.finfo(z.dtype).tiny ** 0.5

    def unit(point: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        a, b, c = point[..., 0, None] - x, point[..., 1, None] - y, point[..., 2, None] - z
        inverse = torch.rsqrt(a * a + b * b + c * c + tiny)
        return a * inverse, b * inverse, c * inverse, inverse

    def both(x: Tensor, y: Tensor) -> list[Tensor]:
        return [a + b for a, b in zip(unit(eye, x, y), unit(there, x, y), strict=True)]

    e = torch.zeros_like(z), torch.zeros_like(z)
    for _ in range(_TURNS):
        a, b, _, close = both(radius * e[0], radius * e[1])
        # Near things turn as the point does: about Newton's step for the angle on the ring.
        a, b = a + radius * close * e[0], b + radius * close * e[1]
        inverse = torch.rsqrt(a * a + b * b + tiny)
        e = a * inverse, b * inverse
    a, b, up, _ = both(radius * e[0], radius * e[1])
    outward = a * e[0] + b * e[1]
    rise = outward * (slope / 2) + radius * up  # minus the path's change, times the radius
    facing = radius * outward - slope / 2 * up
    falls = rise > 0
    turns = (falls[:, 1:] != falls[:, :-1]) & (torch.maximum(facing[:, 1:], facing[:, :-1]) > 0)
    row, ring = torch.nonzero(turns, as_tuple=True)
    below, above = rise[row, ring], rise[row, ring + 1]
    share = (below / (below - above)).nan_to_num(0.5)
    height = z[ring] + share * (z[ring + 1] - z[ring])
    direction = torch.stack([(1 - share) * v[row, ring] + share * v[row, ring + 1] for v in e], 1)
    direction = torch.nn.functional.normalize(direction, dim=1)
    r = profile(surface, height)[0].clamp_min(0).sqrt()[:, None]
    return row, surface.center + torch.cat([r * direction, height[:, None]], 1) @ surface.frame.T


def _unhidden(
    surface: Revolution, points: Float[Tensor, "n 3"], camera: Float[Tensor, "3"], sources: Float[Tensor, "n 3"]
) -> Bool[Tensor, "n"]:
    """Whether the ways from points on the mirror to camera and source are free of the mirror itself."""
    start = (points - surface.center) @ surface.frame
    widest = surface.squared.max().clamp_min(0).sqrt()
    free = torch.ones(len(points), dtype=torch.bool, device=points.device)
    for target in (camera.expand_as(points), sources):
        way = (target - surface.center) @ surface.frame - start
        # Beyond the widest ring, above and below the ends there is nothing to pass.
        flat = way[:, :2].norm(dim=1).clamp_min(1e-9 * float(widest))
        end = torch.where(way[:, 2] > 0, surface.ends[1] - start[:, 2], start[:, 2] - surface.ends[0])
        reach = torch.minimum((end / way[:, 2].abs().clamp_min(1e-9 * float(widest))), 2 * widest / flat).clamp(0, 1)
        for i in range(1, _HIDERS + 1):
            at = start + (i / _HIDERS) * reach[:, None] * way
            free &= at[:, :2].square().sum(1) > profile(surface, at[:, 2])[0] * 0.999
    return free


def _onto(surface: Revolution, points: Tensor, size: float) -> Tensor:
    """Towards the surface along its normals, by a step of Newton's method."""
    level = _level(surface, points)
    squared = level.gradient.square().sum(1, keepdim=True).clamp_min((1e-3 * size) ** 2)
    return points - shortened(level.value[:, None] / squared * level.gradient, _MAX_STEP * size)
