"""The networks: encoder of transparent objects, U-Net, R-buffer generator and renderer. Images are channels first.

Nothing is normalised over pixels or channels: an object that is nowhere seen contributes exactly nothing.
"""

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize, relu, softplus

from catacaustics.refraction.buffers import Buffers
from catacaustics.shapes import Bool, Float


class Size(NamedTuple):
    """Channels of the U-Nets' first level, levels below it, and octaves of the positional encoding."""

    width: int
    levels: int
    octaves: int


SIZES = {"small": Size(16, 3, 4), "base": Size(32, 3, 6), "paper": Size(64, 4, 8)}


def encode(values: Float[Tensor, "*n c"], octaves: int) -> Float[Tensor, "*n d"]:
    """Positional encoding x, sin(2^i pi x), cos(2^i pi x), i < octaves; d = c (1 + 2 octaves)."""
    waves = [values * (torch.pi * 2**i) for i in range(octaves)]
    return torch.cat([values, *(f(wave) for wave in waves for f in (torch.sin, torch.cos))], -1)


def _pixels(image: Float[Tensor, "*b c h w"]) -> Float[Tensor, "*b h w c"]:
    """Channels last: there the layers that see one pixel at a time are fastest."""
    return image.movedim(-3, -1).contiguous()


def _image(pixels: Float[Tensor, "b h w c"]) -> Float[Tensor, "b c h w"]:
    return pixels.movedim(-1, 1)


def _join(*parts: Tensor) -> Tensor:
    """Channels side by side, in the memory layout in which convolutions are fastest."""
    return torch.cat(parts, 1).contiguous(memory_format=torch.channels_last)


def _conv(inputs: int, outputs: int, side: int = 3, stride: int = 1) -> nn.Conv2d:
    conv = nn.Conv2d(inputs, outputs, side, stride, side // 2)
    nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")
    return _biased(conv, [0.0] * outputs)


def _biased(conv: nn.Conv2d, bias: list[float]) -> nn.Conv2d:
    """The convolution with this bias."""
    assert conv.bias is not None
    conv.bias.data = torch.tensor(bias)
    return conv


def precise(layer: nn.Module, x: Tensor) -> Tensor:
    """A layer in float32, also where others compute with less: its result is coordinates or colours."""
    with torch.autocast(x.device.type, enabled=False):
        return layer(x.float())


class UNet(nn.Module):
    """Encoder and decoder with skips. Level i has width * min(2^i, 4) channels; the result has `width`."""

    def __init__(self, inputs: int, size: Size):
        super().__init__()
        widths = [size.width * min(2**i, 4) for i in range(size.levels + 1)]
        self.first = _conv(inputs, widths[0], 1)
        pairs = list(pairwise(widths))
        self.down = nn.ModuleList(_conv(a, b, stride=2) for a, b in pairs)
        self.middle = nn.ModuleList(_conv(b, b) for _, b in pairs)
        self.narrow = nn.ModuleList(_conv(b, a, 1) for a, b in pairs)
        self.up = nn.ModuleList(_conv(a, a) for a, _ in pairs)

    def forward(self, x: Tensor) -> Tensor:
        x = relu(self.first(x))
        skips = []
        for down, middle in zip(self.down, self.middle, strict=True):
            skips.append(x)
            x = relu(down(x))
            x = x + relu(middle(x))
        for narrow, up in zip(reversed(self.narrow), reversed(self.up), strict=True):
            x = interpolate(narrow(x), scale_factor=2, mode="bilinear", align_corners=False) + skips.pop()
            x = relu(up(x))
        return x


def refract(
    directions: Float[Tensor, "*n 3"], normals: Float[Tensor, "*n 3"], ratio: Float[Tensor, "*n 1"]
) -> Float[Tensor, "*n 3"]:
    """Snell's law in vectors; `ratio` of the indices before and behind, normals against the ray. Beyond the critical
    angle the ray grazes the surface."""
    cosine = -(directions * normals).sum(-1, keepdim=True)
    along = (1 - ratio**2 * (1 - cosine**2)).clamp_min(1e-9).sqrt()
    return ratio * directions + (ratio * cosine - along) * normals


def back_guesses(
    inside: Float[Tensor, "*n 3"], normal: Float[Tensor, "*n 3"], mean_normal: Float[Tensor, "*n 3"]
) -> tuple[Float[Tensor, "*n 3"], Float[Tensor, "*n 3"]]:
    """Outward normals where a ray leaves a body, as far as the surface tells where it entered: were the body a ball, by
    symmetry of the chord; were its back the mirror image of its front.

    Args:
        inside: unit direction of the ray in the body.
        normal: where it entered.
        mean_normal: of the body's seen part, unit length.
    """
    ball = normal - 2 * (inside * normal).sum(-1, keepdim=True) * inside
    return ball, normal - 2 * (normal * mean_normal).sum(-1, keepdim=True) * mean_normal


TURNS = 2
"""Octaves of directions, and of how a ray passes a body's centre."""
_SEGMENTS = 3
"""Of a path in the nearest body: all but the last may end in a reflection."""
_LEFT = 0.01
"""A path of which less than this is still in the body is not followed on."""
_SHARPNESS = 20.0
"""How sharply light passes from reflection to refraction at the critical angle."""


class Views(NamedTuple):
    """The transparent objects as the pixels see them, in each body's own coordinates: how it bends rays does not change
    when it is moved. Everything of an object that is nowhere seen is zero."""

    features: Float[Tensor, "b k h w v"]
    mask: Float[Tensor, "b k h w 1"]
    depth: Float[Tensor, "b k h w 1"]
    seen: Bool[Tensor, "b k 1 1 1"]
    path: Float[Tensor, "b k h w 12"]
    """Where the ray meets the body, its direction in it, normals there and on average."""
    poses: Float[Tensor, "b k h w 14"]
    """The first values of `Buffers.poses`."""


def _view_channels(size: Size) -> int:
    return 4 + 2 * 3 * (1 + 2 * size.octaves) + 3 * 3 * (1 + 2 * TURNS) + 3 * 3


def object_views(buffers: Buffers, octaves: int) -> Views:
    """What the pixels see of every object; of bodies beside a pixel, how its ray passes them."""
    objects, poses = _pixels(buffers.objects), buffers.poses[:, :, None, None]
    mask, position, normal, depth = objects.split([1, 3, 3, 1, 1], -1)[:4]
    rotation = buffers.poses[:, :, :9].unflatten(2, (3, 3))
    center, size, ior, mean_normal = poses[..., 9:].split([3, 1, 1, 3], -1)
    seen = size > 0
    scale, refraction = torch.where(seen, size, 1.0), torch.where(seen, ior, 1.0)

    def to_body(vectors: Tensor) -> Tensor:
        with torch.autocast(vectors.device.type, enabled=False):  # geometry in float32
            return (vectors.flatten(2, 3) @ rotation).unflatten(2, vectors.shape[2:4])

    rays = _pixels(buffers.rays)[:, None].expand_as(position)
    ray, normal_here = to_body(rays), to_body(normal)
    mean_normal = to_body(normalize(mean_normal, dim=-1).expand_as(normal))
    inside = torch.where(mask > 0, refract(ray, normal_here, (1 / refraction).expand_as(mask)), ray)
    at = to_body(position - center) / scale * mask
    line = to_body(_pixels(buffers.position)[:, None] - center) / scale
    passing = line - (line * ray).sum(-1, keepdim=True) * ray
    channels = [
        *(mask, depth, ior.expand_as(mask), size.expand_as(mask)),
        *(encode(v, octaves) for v in (position, at)),
        *(encode(v, TURNS) for v in (ray, inside, passing)),
        *(rays, normal, normal_here),
    ]
    path = torch.cat([at, inside, normal_here, mean_normal], -1)
    every = poses[..., :14].expand(-1, -1, *mask.shape[2:4], -1)
    return Views(torch.cat(channels, -1) * seen, mask, depth, seen, path * seen, every)


class ObjectEncoder(nn.Module):
    """Sum over the transparent objects of one shared network's features (GlassNet: k(sum h(x_k))).

    Order, and objects that are nowhere seen, do not matter.
    """

    def __init__(self, size: Size):
        super().__init__()
        self.layers = layers(_view_channels(size), 3 * size.width, size.width)

    def forward(self, views: Views) -> Float[Tensor, "b h w c"]:
        x = self.layers(views.features) * views.seen
        # Summed in float64: rounding then depends on the order only far below float32's last digit.
        return x.sum(1, dtype=torch.float64).to(x.dtype)


class Rows(NamedTuple):
    """The n pixels that show glass, each with its nearest object."""

    covered: Bool[Tensor, "b h w"]
    features: Float[Tensor, "n v"]
    path: Float[Tensor, "n 12"]
    poses: Float[Tensor, "n 14"]


def nearest_rows(views: Views) -> Rows:
    """The object whose surface comes first."""
    index = torch.where(views.mask > 0, views.depth, torch.inf).argmin(1, keepdim=True)
    covered = (views.mask > 0).any(1)[..., 0]

    def own(values: Tensor) -> Tensor:
        return torch.gather(values, 1, index.expand(-1, -1, -1, -1, values.shape[-1]))[:, 0][covered]

    return Rows(covered, own(views.features), own(views.path), own(views.poses))


class Segment(nn.Module):
    """A ray's way through a body to the next surface, in the body's coordinates, and what becomes of it there.

    How far it is, and how the surface stands where that leads, is learned; how the ray is bent then follows from
    Snell's law, past the critical angle by reflection, but for what the network adds.
    """

    def __init__(self, context: int, size: Size):
        super().__init__()
        self.octaves, inside = size.octaves, 4 * size.width
        place, turn = 3 * (1 + 2 * size.octaves), 3 * (1 + 2 * TURNS)
        self.length = layers(context + place + turn + 3, inside, inside)
        self.onwards = flat(inside, [-1.0, 0.0, 0.0, 0.0, 0.0])
        self.surface = layers(context + place + 6, inside, inside)
        self.normal = flat(inside, [0.5, 0.5, 0.0, 0.0, 0.0])

    def forward(self, context: Tensor, path: Tensor, ior: Tensor, within: Tensor) -> tuple[Tensor, Tensor]:
        """The path at its next surface (n 12, as Views.path) and how much of the ray is still in the body (n 1)."""
        at, direction, normal, mean_normal = path.split(3, -1)
        x = self.length(torch.cat([context, encode(at, self.octaves), encode(direction, TURNS), normal], -1))
        length, leaning, more = precise(self.onwards, x).split([1, 1, 3], -1)
        at = at + within * softplus(length) * direction
        ball, sheet = back_guesses(direction, normal, mean_normal)
        x = self.surface(torch.cat([context, encode(at, self.octaves), ball, sheet], -1))
        shares, correction = precise(self.normal, x).split([2, 3], -1)
        back = normalize(shares[:, :1] * ball + shares[:, 1:] * sheet + correction, dim=-1)
        cosine = (direction * back).sum(-1, keepdim=True)
        leaves = torch.sigmoid(_SHARPNESS * (1 - ior**2 * (1 - cosine**2)) + leaning)
        mirrored = direction - 2 * cosine * back
        bent = leaves * refract(direction, -back, ior) + (1 - leaves) * mirrored + more
        direction = normalize(within * bent + (1 - within) * direction, dim=-1)
        return torch.cat([at, direction, back, mean_normal], -1), within * (1 - leaves)


class Generator(nn.Module):
    """R-buffer generator: objects and opaque geometry in, `outputs` channels of normals, coordinates, logits out.

    A ray is followed through the nearest body, segment by segment; from where it leaves the body it goes
    distance * direction, to a point in the world. How rays are bent is a smooth function that knows nothing of the
    scene behind, unlike the point where they land. The point is channels 3 to 5 of the output; the last layers turn it
    into other coordinates, where there are any. Zero where there is no glass.

    Args:
        outputs: channels, 6 or more.
    """

    def __init__(self, outputs: int, size: Size):
        super().__init__()
        self.octaves, self.outputs = size.octaves, outputs
        self.objects = ObjectEncoder(size)
        self.trunk = UNet(size.width + 3 * (1 + 2 * size.octaves) + 3 + 1 + 3, size)
        inside, place = 4 * size.width, 3 * (1 + 2 * size.octaves)
        self.context = layers(2 * size.width + _view_channels(size), inside, 2 * size.width)
        self.segment = Segment(2 * size.width, size)
        self.reach = layers(2 * size.width + place + 3 * (1 + 2 * TURNS) + 1, inside, inside)
        self.leave = flat(inside, [0.5, 0.0, 0.0, 0.0])
        self.last = flat(inside, [0.0] * 3)
        self.land = layers(inside + place, inside, inside) if outputs > 6 else None
        self.other = flat(inside, [0.0] * (outputs - 6)) if outputs > 6 else None

    def forward(self, buffers: Buffers) -> Float[Tensor, "b outputs h w"]:
        views = object_views(buffers, self.octaves)
        objects, rows = self.objects(views), nearest_rows(views)
        position, normal, depth, rays = (
            _pixels(v) for v in (buffers.position, buffers.normal, buffers.depth, buffers.rays)
        )
        geometry = [encode(position, self.octaves), normal, depth, rays]
        x = self.trunk(_image(torch.cat([objects, *geometry], -1)))
        around = torch.cat([_pixels(x), objects], -1)[rows.covered]
        x = self.context(torch.cat([around, rows.features], -1))
        path, within = self._follow(x, rows.path, rows.poses[:, 13:14])
        rotation = rows.poses[:, :9].unflatten(1, (3, 3))
        start = rows.poses[:, 9:12] + rows.poses[:, 12:13] * (rotation * path[:, None, :3]).sum(-1)
        direction = (rotation * path[:, None, 3:6]).sum(-1)
        x = self.reach(torch.cat([x, encode(start, self.octaves), encode(direction, TURNS), within], -1))
        distance, more = precise(self.leave, x).split([1, 3], -1)
        landing = start + softplus(distance) * normalize(direction + more, dim=-1)
        found = torch.cat([precise(self.last, x), landing], -1)
        if self.land is not None and self.other is not None:
            x = self.land(torch.cat([x, encode(landing, self.octaves)], -1))
            found = torch.cat([found, precise(self.other, x)], -1)
        whole = found.new_zeros(*rows.covered.shape, self.outputs)
        whole[rows.covered] = found
        return _image(whole)

    def _follow(self, context: Tensor, path: Tensor, ior: Tensor) -> tuple[Tensor, Tensor]:
        """The path where it leaves the body, and how much of it has not left."""
        path, within = self.segment(context, path, ior, torch.ones_like(ior))
        for _ in range(_SEGMENTS - 1):
            on = (within[:, 0] > _LEFT).nonzero()[:, 0]
            own = self.segment(context[on], path[on], ior[on], within[on])
            path, within = (a.index_copy(0, on, b) for a, b in zip((path, within), own, strict=True))
        return path, within


def layers(inputs: int, width: int, outputs: int) -> nn.Sequential:
    """Two layers that see one pixel at a time."""
    layers = [nn.Linear(inputs, width), nn.Linear(width, outputs)]
    for layer in layers:
        nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU())


def flat(inputs: int, bias: list[float]) -> nn.Linear:
    """A layer that at the start gives about its bias."""
    layer = nn.Linear(inputs, len(bias))
    layer.weight.data *= 0.1
    layer.bias.data = torch.tensor(bias)
    return layer


class Renderer(nn.Module):
    """G-buffers and, where `r_channels` > 0, an R-buffer in; the lit image out.

    Reflection branch: a U-Net on the opaque buffers, which also yields the scene's latent code. Transmission branch: a
    U-Net on objects, code and R-buffer. A final network joins them; it gives a colour and what share of the direct
    lighting and of the R-buffer's colour is added to it.
    """

    def __init__(self, r_channels: int, size: Size):
        super().__init__()
        self.octaves, self.r_channels = size.octaves, r_channels
        self.reflection = UNet(3 * (1 + 2 * size.octaves) + 3 + 3 + 3 + 1 + 3, size)
        self.objects = ObjectEncoder(size)
        self.transmission = UNet(2 * size.width + r_channels, size)
        self.join = _conv(2 * size.width + r_channels, size.width)
        bias = [0.0] * 3 + [1.0] * 3 + [0.0] * (3 if r_channels else 0)  # at the start the image is the direct lighting
        self.last = _biased(nn.Conv2d(size.width, len(bias), 1), bias)
        nn.init.zeros_(self.last.weight)

    def forward(self, buffers: Buffers, r_buffer: Float[Tensor, "b r h w"]) -> Float[Tensor, "b 3 h w"]:
        """RGB, sRGB-encoded, not clamped. The first three channels of the R-buffer are its colour."""
        place = _image(encode(_pixels(buffers.position), self.octaves))
        geometry = [place, buffers.normal, buffers.depth, buffers.rays]
        code = self.reflection(_join(*geometry, buffers.albedo, buffers.direct))
        objects = _image(self.objects(object_views(buffers, self.octaves)))
        through = self.transmission(_join(code, objects, r_buffer))
        out = precise(self.last, relu(self.join(_join(code, through, r_buffer))))
        image = out[:, :3] + out[:, 3:6] * buffers.direct
        return image + out[:, 6:9] * r_buffer[:, :3] if self.r_channels else image
