"""Warps: where a reflection point is displayed for a camera centre. A ladder, from no motion to optics to a network.

Every warp is a module with forward(points (n, 3), center (3,), start) -> Displayed; `start` is what an earlier call
returned for the same points and centre: only positions are worked out then. What the points are depends on the rung:
of `plane` and the quadrics they are the world positions of what is mirrored, of the others positions where it is seen.
"""

import itertools
from typing import NamedTuple

import torch
from torch import Tensor, nn

from catacaustics.reflectors import native, quadric, revolution
from catacaustics.reflectors.fermat import Specular, tilted_disks
from catacaustics.reflectors.revolution import Revolution
from catacaustics.shapes import Bool, Float, Int

Points = Float[Tensor, "n 3"]


class Displayed(NamedTuple):
    """Where points appear. `normals` None: disks face the camera; `stretch` multiplies squared radii (the footprint's
    Jacobian, no gradients); points that are not `visible` are not drawn; `start` can be handed to the next call;
    `near` is the distance from the centre to the mirror along a point's ray, where the rung knows its mirror; `rows`
    tells which point each is an image of, where a mirror can show one several times (None: one each, in order)."""

    positions: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"] | None = None
    stretch: Float[Tensor, "n"] | None = None
    visible: Bool[Tensor, "n"] | None = None
    start: Float[Tensor, "n 3"] | None = None
    near: Float[Tensor, "n"] | None = None
    rows: Int[Tensor, "n"] | None = None


def painted(shown: Displayed, center: Float[Tensor, "3"], eye: Float[Tensor, "3"]) -> Displayed:
    """What the camera centre sees, painted on the mirror and looked at by another eye: every point is seen where the
    centre's ray to it meets the mirror. On the eye's ray it is kept at the length of the path, so that nearer mirrored
    points still hide farther ones.

    For the eye at the centre nothing changes. From elsewhere the reflection stays on the mirror; images at their
    optical depth would leave its outline. Rungs that do not know their mirror are returned as they are.
    """
    if shown.near is None:
        return shown
    rays = shown.positions - center
    length = rays.norm(dim=1).clamp_min(1e-12)
    view = center + (shown.near / length)[:, None] * rays - eye
    distance = view.norm(dim=1).clamp_min(1e-12)
    stretch = (shown.near / distance) ** 2 if shown.stretch is None else (shown.near / distance) ** 2 * shown.stretch
    return shown._replace(positions=eye + (length / distance)[:, None] * view, stretch=stretch.detach(), near=None)


def rotation_matrix(vector: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The rotation about a vector by its length in radians, differentiable at zero too."""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    return torch.linalg.matrix_exp(cross)


class StaticWarp(nn.Module):
    """p' = p: painted-on highlights, and flat mirrors, whose image does not move with the camera."""

    def forward(self, points: Points, center: Float[Tensor, "3"], start: Points | None = None) -> Displayed:
        return Displayed(points)


class PlaneWarp(nn.Module):
    """p' = mirror image of a world point in a learned plane, seen where camera and point are on its front side.

    Args:
        point, normal: (3,) of the plane at the start; the normal points to the front.
        scale: length in which the plane's offset is learned.
    """

    start_point: Tensor
    start_normal: Tensor
    scale: Tensor

    def __init__(self, point: Float[Tensor, "3"], normal: Float[Tensor, "3"], scale: float):
        super().__init__()
        self.register_buffer("start_point", point)
        self.register_buffer("start_normal", torch.nn.functional.normalize(normal, dim=0))
        self.register_buffer("scale", torch.as_tensor(float(scale)))
        self.tilt = nn.Parameter(torch.zeros(3))
        self.offset = nn.Parameter(torch.zeros(()))

    def plane(self) -> tuple[Float[Tensor, "3"], Float[Tensor, ""]]:
        """Unit normal n and distance d of the plane n . x = d."""
        normal = torch.nn.functional.normalize(self.start_normal + self.tilt, dim=0)
        return normal, normal @ self.start_point + self.offset * self.scale

    def forward(self, points: Points, center: Float[Tensor, "3"], start: Points | None = None) -> Displayed:
        normal, distance = self.plane()
        height, own = points @ normal - distance, center @ normal - distance
        images = points - 2 * height[:, None] * normal
        with torch.no_grad():
            near = own / (own + height).clamp_min(1e-12) * (images - center).norm(dim=1)
        return Displayed(images, visible=(height > 0) & (own > 0), near=near)


class QuadricWarp(nn.Module):
    """The image of a world point in a learned sphere or ellipsoid (reflectors/quadric.py), on the ray at the length of
    the path, so that nearer mirrored points hide farther ones. Its disk has the shape that the mirror gives it.

    Args:
        center: (3,) at the start.
        axes: (3, 3), half-axes in columns, at the start.
        sphere: the three radii stay equal.
        concave: the inner side mirrors.
    """

    start_center: Tensor
    start_axes: Tensor
    concave: Tensor

    def __init__(self, center: Float[Tensor, "3"], axes: Float[Tensor, "3 3"], sphere: bool, concave: bool = False):
        super().__init__()
        self.register_buffer("start_center", center)
        self.register_buffer("start_axes", axes)
        self.register_buffer("concave", torch.tensor(concave))
        # In units of the mean radius and of radians: one learning rate fits all.
        self.shift = nn.Parameter(torch.zeros(3))
        self.log_radii = nn.Parameter(torch.zeros(1 if sphere else 3))
        self.turn = None if sphere else nn.Parameter(torch.zeros(3))

    def shape(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]:
        """Centre, and half-axes in columns."""
        center = self.start_center + self.shift * self.start_axes.norm(dim=0).mean()
        axes = self.start_axes * self.log_radii.exp()
        if self.turn is not None:
            axes = rotation_matrix(self.turn) @ axes
        return center, axes

    def forward(self, points: Points, center: Float[Tensor, "3"], start: Points | None = None) -> Displayed:
        shape, concave = self.shape(), bool(self.concave)
        images = native.quadric_images(points, center, *shape, concave, start)
        if images is not None:
            return Displayed(**images._asdict())
        return _displayed(quadric.specular_points(points, center, *shape, concave, start), points, center)


def _displayed(found: Specular, points: Points, center: Float[Tensor, "3"]) -> Displayed:
    """Points on their rays at the length of the path, so that nearer mirrored points hide farther ones."""
    ray = found.points - center
    near = ray.norm(dim=1, keepdim=True).clamp_min(1e-12)
    direction = ray / near
    points = points if found.rows is None else points[found.rows]
    length = near + (points - found.points).norm(dim=1, keepdim=True)
    shown = Displayed(center + length * direction, start=found.start, near=near.detach()[:, 0])
    if found.jacobian is None:
        return shown
    normals, stretch = tilted_disks(found.jacobian, -direction.detach())
    return shown._replace(normals=normals, stretch=stretch, visible=found.visible, rows=found.rows)


class RevolutionWarp(nn.Module):
    """The image of a world point in a learned surface of revolution (reflectors/revolution.py), as of QuadricWarp.

    Args:
        surface: at the start. Its ends stay.
    """

    start_center: Tensor
    start_frame: Tensor
    start_squared: Tensor
    radii: Tensor
    ends: Tensor

    def __init__(self, surface: Revolution):
        super().__init__()
        for name, value in zip(("start_center", "start_frame", "radii", "ends", "start_squared"), surface, strict=True):
            self.register_buffer(name, value)
        self.shift = nn.Parameter(torch.zeros(3))
        self.turn = nn.Parameter(torch.zeros(3))
        self.bulge = nn.Parameter(torch.zeros(len(surface.squared)))

    def surface(self) -> Revolution:
        """The learned surface."""
        size = self.radii.mean()
        # One rate fits all: a single coefficient tilts the mirror as fast as a radius of a quadric does.
        squared = self.start_squared + self.bulge * size**2 / len(self.bulge)
        frame = rotation_matrix(self.turn) @ self.start_frame
        return Revolution(self.start_center + self.shift * size, frame, self.radii, self.ends, squared)

    def forward(self, points: Points, center: Float[Tensor, "3"], start: Points | None = None) -> Displayed:
        return _displayed(revolution.specular_points(points, center, self.surface(), start), points, center)


class NeuralWarp(nn.Module):
    """p' = p + F(p, c), an MLP of position and camera centre, both normalised to [-1, 1] (paper section 4.2).

    Args:
        low, high: (3,) corners of a box around the reflection points and the camera centres.
        layers, width: hidden layers and their width (paper: 4 x 256).
    """

    middle: Tensor
    half_size: Tensor

    def __init__(self, low: Float[Tensor, "3"], high: Float[Tensor, "3"], layers: int = 4, width: int = 256):
        super().__init__()
        self.register_buffer("middle", (low + high) / 2)
        # One scale for all axes keeps directions undistorted.
        self.register_buffer("half_size", ((high - low) / 2).max())
        sizes = [6] + [width] * layers
        hidden = [m for a, b in itertools.pairwise(sizes) for m in (nn.Linear(a, b), nn.ReLU())]
        self.network = nn.Sequential(*hidden, nn.Linear(width, 3))

    def forward(self, points: Points, center: Float[Tensor, "3"], start: Points | None = None) -> Displayed:
        p = (points - self.middle) / self.half_size
        c = ((center - self.middle) / self.half_size).expand_as(p)
        # Scaled so that training starts with almost no motion.
        return Displayed(points + 0.01 * self.half_size * self.network(torch.cat([p, c], -1)))


class QuadricNeuralWarp(nn.Module):
    """Physics first, a network for what the quadric misses: p' = q + F(q, c), q the quadric's image of the point."""

    def __init__(self, quadric: QuadricWarp, neural: NeuralWarp):
        super().__init__()
        self.quadric = quadric
        self.neural = neural

    def forward(self, points: Points, center: Float[Tensor, "3"], start: Points | None = None) -> Displayed:
        image = self.quadric(points, center, start)
        return image._replace(positions=self.neural(image.positions, center).positions)


Mirror = PlaneWarp | QuadricWarp | RevolutionWarp
"""Rungs that are a mirror and world points."""


class MovedWarp(nn.Module):
    """A reflector that was moved together with what it mirrors: the image is computed for the camera as the reflector
    would see it at its old place, then moved along. x_new = scale * rotation x_old + shift.

    Physically right where the surroundings move too; `moved_mirror` is the mirror moved in resting surroundings.
    """

    scale: Tensor
    rotation: Tensor
    shift: Tensor

    def __init__(self, warp: nn.Module, scale: float, rotation: Float[Tensor, "3 3"], shift: Float[Tensor, "3"]):
        super().__init__()
        self.warp = warp
        self.register_buffer("scale", torch.as_tensor(float(scale)))
        self.register_buffer("rotation", rotation)
        self.register_buffer("shift", shift)

    def forward(self, points: Points, center: Float[Tensor, "3"], start: Points | None = None) -> Displayed:
        old_center = (center - self.shift) @ self.rotation / self.scale
        shown = self.warp(points, old_center, start)
        stretch = torch.ones_like(shown.positions[:, 0]) if shown.stretch is None else shown.stretch
        return shown._replace(
            positions=self.scale * shown.positions @ self.rotation.T + self.shift,
            normals=None if shown.normals is None else shown.normals @ self.rotation.T,
            stretch=self.scale**2 * stretch,
            near=None if shown.near is None else self.scale * shown.near,
        )


class DecoupledWarp(nn.Module):
    """Reflections that follow another camera than the view's: for the centre c they are those that
    w = c + strength ((gain - 1) (c - pivot) + offset) sees, painted on the mirror.

    An edit without a counterpart in physics. Where w = c nothing changes, bit for bit.

    Args:
        offset: (3,) world units.
        gain: how many times as fast as the view's camera the warp's moves.
        pivot: (3,) where both are at the same place.
        strength: 0 leaves reflections as they are.
    """

    offset: Tensor
    gain: Tensor
    pivot: Tensor
    strength: Tensor

    def __init__(
        self, warp: nn.Module, offset: Float[Tensor, "3"], gain: float, pivot: Float[Tensor, "3"], strength: float = 1.0
    ):
        super().__init__()
        self.warp = warp
        self.register_buffer("offset", offset)
        self.register_buffer("gain", torch.as_tensor(float(gain)))
        self.register_buffer("pivot", pivot)
        self.register_buffer("strength", torch.as_tensor(float(strength)))

    def forward(self, points: Points, center: Float[Tensor, "3"], start: Points | None = None) -> Displayed:
        followed = center + self.strength * ((self.gain - 1) * (center - self.pivot) + self.offset)
        shown = self.warp(points, followed, start)
        return shown if torch.equal(followed, center) else painted(shown, followed, center)._replace(near=None)


def inner_warp(warp: nn.Module) -> nn.Module:
    """The rung below what edits have put around it."""
    return inner_warp(warp.warp) if isinstance(warp, MovedWarp | DecoupledWarp) else warp


def moved_mirror(
    warp: nn.Module, scale: float, rotation: Float[Tensor, "3 3"], shift: Float[Tensor, "3"]
) -> Mirror | None:
    """The mirror at x_new = scale * rotation x + shift, in surroundings that stay where they are: physically right.
    None for rungs that do not consist of a mirror and world points."""
    with torch.no_grad():
        if isinstance(warp, PlaneWarp):
            normal, distance = warp.plane()
            return PlaneWarp(scale * rotation @ (distance * normal) + shift, rotation @ normal, float(warp.scale))
        if isinstance(warp, QuadricWarp):
            center, axes = warp.shape()
            moved = scale * rotation @ center + shift, scale * rotation @ axes
            return QuadricWarp(*moved, len(warp.log_radii) == 1, bool(warp.concave))
        if isinstance(warp, RevolutionWarp):
            center, frame, radii, ends, squared = warp.surface()
            center, frame = scale * rotation @ center + shift, rotation @ frame
            return RevolutionWarp(Revolution(center, frame, scale * radii, scale * ends, scale**2 * squared))
    return None


def mirror_of(warp: nn.Module) -> Mirror | None:
    """The mirror of a rung at its place in the world, with what edits have done to it; None where there is none."""
    if isinstance(warp, Mirror):
        return warp
    if isinstance(warp, QuadricNeuralWarp):
        return warp.quadric
    if isinstance(warp, DecoupledWarp):
        return mirror_of(warp.warp)
    if isinstance(warp, MovedWarp) and (mirror := mirror_of(warp.warp)) is not None:
        return moved_mirror(mirror, float(warp.scale), warp.rotation, warp.shift)
    return None


def learns_positions(warp: nn.Module) -> bool:
    """Whether a cloud's points move in training: the network alone displaces points that stay fixed (paper 4.2)."""
    return not isinstance(inner_warp(warp), NeuralWarp)


def warp_from_state(state: dict[str, Tensor]) -> nn.Module:
    """The warp that a state dictionary belongs to, filled."""
    if any(k.startswith("warp.") for k in state) or {"rotation", "pivot"} & state.keys():
        inner = warp_from_state({k.removeprefix("warp."): v for k, v in state.items() if k.startswith("warp.")})
        if "pivot" in state:
            return DecoupledWarp(inner, state["offset"], float(state["gain"]), state["pivot"], float(state["strength"]))
        return MovedWarp(inner, float(state["scale"]), state["rotation"], state["shift"])
    if "quadric.start_axes" in state:
        quadric, neural = (
            warp_from_state({k.removeprefix(part): v for k, v in state.items() if k.startswith(part)})
            for part in ("quadric.", "neural.")
        )
        assert isinstance(quadric, QuadricWarp)
        assert isinstance(neural, NeuralWarp)
        return QuadricNeuralWarp(quadric, neural)
    if "start_axes" in state:
        sphere = len(state["log_radii"]) == 1
        warp: nn.Module = QuadricWarp(state["start_center"], state["start_axes"], sphere, bool(state["concave"]))
    elif "start_squared" in state:
        warp = RevolutionWarp(
            Revolution(*(state[k] for k in ("start_center", "start_frame", "radii", "ends", "start_squared")))
        )
    elif "start_point" in state:
        warp = PlaneWarp(state["start_point"], state["start_normal"], float(state["scale"]))
    elif "network.0.weight" in state:
        layers = sum(k.startswith("network.") and k.endswith("weight") for k in state) - 1
        width = len(state["network.0.weight"])
        warp = NeuralWarp(torch.zeros(3), torch.ones(3), layers, width)
    else:
        return StaticWarp()
    warp.load_state_dict(state)
    return warp
