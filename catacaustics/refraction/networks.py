"""The networks: encoder of transparent objects, U-Net, R-buffer generator and renderer. Images are channels first.

Nothing is normalised over pixels or channels: an object that is nowhere seen contributes exactly nothing.
"""

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize, relu, softplus

from catacaustics.refraction.buffers import OBJECT_CHANNELS, Buffers
from catacaustics.shapes import Float


class Size(NamedTuple):
    """Channels of the U-Nets' first level, levels below it, and octaves of the positional encoding."""

    width: int
    levels: int
    octaves: int


SIZES = {"small": Size(16, 3, 4), "base": Size(32, 3, 6), "paper": Size(64, 4, 8)}


def encode(values: Float[Tensor, "b c h w"], octaves: int) -> Float[Tensor, "b d h w"]:
    """Positional encoding x, sin(2^i pi x), cos(2^i pi x), i < octaves; d = c (1 + 2 octaves)."""
    waves = [values * (torch.pi * 2**i) for i in range(octaves)]
    return torch.cat([values, *(f(wave) for wave in waves for f in (torch.sin, torch.cos))], 1)


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


def _precise(layer: nn.Module, x: Tensor) -> Tensor:
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


class Guesses(NamedTuple):
    """Directions of a ray in and behind an object, as far as its first surface tells; unit length."""

    inside: Float[Tensor, "b 3 h w"]
    ball: Float[Tensor, "b 3 h w"]
    """Behind it, were the object a ball."""
    sheet: Float[Tensor, "b 3 h w"]
    """Behind it, were its back the mirror image of its front."""


def refract(
    directions: Float[Tensor, "b 3 h w"], normals: Float[Tensor, "b 3 h w"], ratio: Float[Tensor, "b 1 h w"]
) -> Float[Tensor, "b 3 h w"]:
    """Snell's law in vectors; `ratio` of the indices before and behind, normals against the ray. Beyond the critical
    angle the ray grazes the surface."""
    cosine = -(directions * normals).sum(1, keepdim=True)
    along = (1 - ratio**2 * (1 - cosine**2)).clamp_min(0).sqrt()
    return ratio * directions + (ratio * cosine - along) * normals


def exit_guesses(
    rays: Float[Tensor, "b 3 h w"],
    normal: Float[Tensor, "b 3 h w"],
    ior: Float[Tensor, "b 1 h w"],
    mean_normal: Float[Tensor, "b 3 h w"],
) -> Guesses:
    """Where rays go that meet a surface of this normal.

    Args:
        ior: of the object; 0 where there is none: the ray goes on.
        mean_normal: of the object's seen part, unit length.
    """
    ior = torch.where(ior > 0, ior, 1.0)
    inside = refract(rays, normal, 1 / ior)
    # Outward normals where the ray leaves: a ball's, by symmetry of the chord, and the mirrored front's.
    ball = normal - 2 * (inside * normal).sum(1, keepdim=True) * inside
    sheet = normal - 2 * (normal * mean_normal).sum(1, keepdim=True) * mean_normal
    return Guesses(inside, *(refract(inside, -back, ior) for back in (ball, sheet)))


class ObjectEncoder(nn.Module):
    """Sum over the transparent objects of one shared network's features (GlassNet: k(sum h(x_k))).

    The features are multiplied by the object's mask: order, and objects that are nowhere seen, do not matter.
    """

    def __init__(self, size: Size):
        super().__init__()
        self.octaves = size.octaves
        inputs = OBJECT_CHANNELS + 3 * 2 * size.octaves + 3 + 3 * 3 + 3 * 5 + 3
        self.first, self.second = _conv(inputs, 3 * size.width, 1), _conv(3 * size.width, size.width, 1)

    def forward(self, buffers: Buffers) -> Float[Tensor, "b c h w"]:
        b, k = buffers.objects.shape[:2]
        objects, poses = buffers.objects.flatten(0, 1), buffers.poses.flatten(0, 1)[..., None, None]
        mask, position, normal, ior = objects[:, :1], objects[:, 1:4], objects[:, 4:7], objects[:, 8:]
        rays = buffers.rays.repeat_interleave(k, 0)
        mean_normal = normalize(poses[:, 3:], dim=1).expand_as(normal)
        guesses = exit_guesses(rays, normal, ior, mean_normal)
        own = encode(4 * (position - poses[:, :3]), 2)  # where on the object
        x = _join(mask, encode(position, self.octaves), objects[:, 4:], rays, *guesses, own, mean_normal)
        x = relu(self.second(relu(self.first(x)))) * mask
        # Summed in float64: rounding then depends on the order only far below float32's last digit.
        return x.unflatten(0, (b, k)).sum(1, dtype=torch.float64).to(x.dtype)


def nearest_object(buffers: Buffers) -> tuple[Float[Tensor, "b 9 h w"], Float[Tensor, "b 3 h w"]]:
    """Each pixel's nearest transparent object: its buffers, zero where there is none, and its unit mean normal."""
    objects = buffers.objects
    depth = torch.where(objects[:, :, 0] > 0, objects[:, :, 7], torch.inf)
    index = depth.argmin(1)
    nearest = torch.take_along_dim(objects, index[:, None, None], 1)[:, 0]
    normals = normalize(buffers.poses[:, :, 3:], dim=2)[..., None, None]
    return nearest, torch.take_along_dim(normals, index[:, None, None], 1)[:, 0] * nearest[:, :1]


class Generator(nn.Module):
    """R-buffer generator: objects and opaque geometry in, `outputs` channels of normals, coordinates, logits out.

    World coordinates, channels 3 to 5 with `world`, are found as first surface + distance * direction: how a ray is
    bent is a smooth function that knows nothing of the scene behind, unlike the point where it lands. The direction is
    a mixture of the ray and the guesses of `exit_guesses`, plus what the network adds.

    Args:
        outputs: channels.
        world: whether there are world coordinates.
    """

    def __init__(self, outputs: int, size: Size, world: bool):
        super().__init__()
        self.octaves, self.world = size.octaves, world
        self.objects = ObjectEncoder(size)
        self.trunk = UNet(size.width + 3 * (1 + 2 * size.octaves) + 3 + 1 + 4 * 3, size)
        # How rays bend is a function of the pixel's own surface: most of the capacity is here, which costs little.
        inside = 3 * size.width
        first, second = _conv(2 * size.width + 4 * 3, inside, 1), _conv(inside, inside, 1)
        self.head = nn.Sequential(first, nn.ReLU(), second, nn.ReLU())
        # At the start the ray goes straight on.
        bias = [0.0] * outputs + [0.5, 1.0, 0.0, 0.0, 0.0] * world
        self.last = _biased(nn.Conv2d(inside, len(bias), 1), bias)
        self.last.weight.data *= 0.1

    def forward(self, buffers: Buffers) -> Float[Tensor, "b outputs h w"]:
        objects = self.objects(buffers)
        nearest, mean_normal = nearest_object(buffers)
        guesses = exit_guesses(buffers.rays, nearest[:, 4:7], nearest[:, 8:], mean_normal)
        ways = [buffers.rays, *guesses]
        geometry = [encode(buffers.position, self.octaves), buffers.normal, buffers.depth]
        x = self.trunk(_join(objects, *geometry, *ways))
        x = _precise(self.last, self.head(_join(x, objects, *ways)))
        if not self.world:
            return x
        x, distance, shares = x[:, :-5], softplus(x[:, -5:-4]), x[:, -4:]
        bent = sum(share * way for share, way in zip(shares.split(1, 1), ways, strict=True))
        landing = nearest[:, 1:4] + distance * normalize(bent + x[:, 3:6], dim=1)
        return torch.cat([x[:, :3], landing], 1)


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
        geometry = [encode(buffers.position, self.octaves), buffers.normal, buffers.depth, buffers.rays]
        code = self.reflection(_join(*geometry, buffers.albedo, buffers.direct))
        through = self.transmission(_join(code, self.objects(buffers), r_buffer))
        out = _precise(self.last, relu(self.join(_join(code, through, r_buffer))))
        image = out[:, :3] + out[:, 3:6] * buffers.direct
        return image + out[:, 6:9] * r_buffer[:, :3] if self.r_channels else image
