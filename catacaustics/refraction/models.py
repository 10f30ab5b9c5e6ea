"""The models: which R-buffer each renderer gets, what its generator learns, and trained models on disk."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, cross_entropy, interpolate, normalize, one_hot

from catacaustics.errors import UserError
from catacaustics.files import read_tensors, write_tensors
from catacaustics.losses import total_variation
from catacaustics.refraction.buffers import Buffers
from catacaustics.refraction.follow import Tracer, tracer_like
from catacaustics.refraction.frames import Frames
from catacaustics.refraction.lookup import (
    Screen,
    Textures,
    inside_screen,
    project,
    sample_probe,
    sample_screen,
    visibility,
)
from catacaustics.refraction.networks import SIZES, Generator, Renderer
from catacaustics.shapes import Bool, Float, Int, UInt8

FORMAT = 3
Kind = Literal["uv", "world", "screen", "hybrid"]
"""What a generator predicts and where its colours are looked up: texture coordinates of every opaque object and which
object it is (CrystalNet); world coordinates, on the screen (SSNRB); screen coordinates (SSNRB's ablation); world
coordinates by tracing paths through baked bodies, on the screen and by a probe (ours)."""

MODELS: dict[str, Kind | None] = {
    "glassnet": None,
    "crystalnet": "uv",
    "ssnrb": "world",
    "direct": "screen",
    "hybrid": "hybrid",
}
"""Renderers, and the kind of their R-buffer."""

_FAR_NDC = 2.0
"""Screen coordinates are learned up to here; what lands farther outside the image counts as landing there."""
EDGE, TOLERANCE = 0.02, 0.1
"""hybrid: softness at the image's border (ndc) and of the occlusion test (scene units)."""


class Traced(NamedTuple):
    """What a tracer knows beside the place where a path lands: the share of light on the path, whether the screen shows
    that place, where the reflection off the first surface lands, and the share of light on that."""

    light: Float[Tensor, "b 1 h w"]
    seen: Float[Tensor, "b 1 h w"]
    mirrored: Float[Tensor, "b 3 h w"]
    mirrored_light: Float[Tensor, "b 1 h w"]


class Prediction(NamedTuple):
    """A generator's output by meaning; what its kind does not predict is None. t opaque objects."""

    normal: Float[Tensor, "b 3 h w"]
    world: Float[Tensor, "b 3 h w"]
    ndc: Float[Tensor, "b 2 h w"] | None
    uv: Float[Tensor, "b t 2 h w"] | None
    logits: Float[Tensor, "b t h w"] | None
    traced: Traced | None = None


class LossWeights(NamedTuple):
    """Of the generator: coordinates (L1), total variation (sum), object index (cross entropy), normals (L1), unit
    directions from the first surface to landing points in the world (L1)."""

    coordinates: float = 1.0
    tv: float = 1.5e-8
    entropy: float = 1.0
    normal: float = 2.0
    direction: float = 0.0


PAPER_WEIGHTS = LossWeights()


def kind_of(model: str) -> Kind | None:
    """The R-buffer of a model, None for glassnet.

    Raises:
        UserError: unknown model.
    """
    if model not in MODELS:
        raise UserError(f"There is no refraction model {model!r}.", f"one of {', '.join(MODELS)}", "name one of them")
    return MODELS[model]


def output_channels(kind: Kind, textures: int) -> int:
    """Channels of a generator for a scene with so many textures."""
    return 6 + {"uv": 3 * textures, "screen": 2}.get(kind, 0)


def r_channels(kind: Kind | None) -> int:
    """Of an R-buffer: colour and normal at the landing point; hybrid's goes on (`_further_channels`)."""
    return {None: 0, "hybrid": 19}.get(kind, 6)


def split_output(kind: Kind, output: Float[Tensor, "b c h w"]) -> Prediction:
    """Name the channels of a generator's output."""
    normal, world, rest = output[:, :3], output[:, 3:6], output[:, 6:]
    if kind == "uv":
        t = rest.shape[1] // 3
        return Prediction(normal, world, None, rest[:, : 2 * t].unflatten(1, (t, 2)), rest[:, 2 * t :])
    if kind == "screen":
        return Prediction(normal, world, rest, None, None)
    if kind == "hybrid" and rest.shape[1]:
        return Prediction(normal, world, None, None, None, Traced(*rest.split([1, 1, 3, 1], 1)))
    return Prediction(normal, world, None, None, None)


def truth(kind: Kind, buffers: Buffers, textures: int) -> Prediction:
    """The prediction that a perfect generator would make; texture coordinates are right for the object landed on."""
    ndc = project(buffers.landing, buffers.world_to_clip)[0] if kind == "screen" else None
    uv = logits = None
    if kind == "uv":
        uv = buffers.landing_uv[:, None].expand(-1, textures, -1, -1, -1)
        logits = one_hot(buffers.landing_object.clamp_min(0), textures).movedim(-1, 1).float()
    return Prediction(buffers.landing_normal, buffers.landing, ndc, uv, logits)


def generator_losses(
    kind: Kind, prediction: Prediction, buffers: Buffers, weights: LossWeights = PAPER_WEIGHTS
) -> dict[str, Tensor]:
    """Means over the pixels that land somewhere; total variation over the whole image, of coordinates."""
    lands = buffers.landing_object[:, None] >= 0
    first = first_surface(buffers)
    ways = [normalize(point - first, dim=1) for point in (prediction.world, buffers.landing)]
    losses = {
        "normal": weights.normal * _masked_l1(prediction.normal, buffers.landing_normal, lands),
        "world": weights.coordinates * _masked_l1(prediction.world, buffers.landing, lands),
        "direction": weights.direction * _masked_l1(ways[0], ways[1], lands),
    }
    coordinates = [prediction.world]
    if prediction.ndc is not None:
        ndc, depth = project(buffers.landing, buffers.world_to_clip)
        target = ndc.clamp(-_FAR_NDC, _FAR_NDC)
        losses["screen"] = weights.coordinates * _masked_l1(prediction.ndc, target, lands & (depth > 0))
        coordinates.append(prediction.ndc)
    if prediction.uv is not None and prediction.logits is not None:
        index = buffers.landing_object
        own = select(prediction.uv, index.clamp_min(0))
        losses["uv"] = weights.coordinates * _masked_l1(own, buffers.landing_uv, lands)
        entropy = cross_entropy(prediction.logits, index.clamp_min(0), reduction="none")[:, None]
        losses["index"] = weights.entropy * _masked_mean(entropy, lands)
        coordinates.append(prediction.uv.flatten(1, 2))
    if weights.tv:
        planes = torch.cat(coordinates, 1)
        # The papers' weight belongs to the sum over an image; the shared function gives means.
        summed = total_variation(planes.permute(2, 3, 0, 1)) * planes[0].numel()
        losses["tv"] = weights.tv * summed
    return losses


def select(values: Float[Tensor, "b t c h w"], index: Int[Tensor, "b h w"]) -> Float[Tensor, "b c h w"]:
    """Each pixel's own of t maps."""
    return torch.take_along_dim(values, index[:, None, None], 1)[:, 0]


def first_surface(buffers: Buffers) -> Float[Tensor, "b 3 h w"]:
    """Where rays first meet glass; zero where they do not."""
    depth = torch.where(buffers.objects[:, :, 0] > 0, buffers.objects[:, :, 7], torch.inf)
    return select(buffers.objects[:, :, 1:4], depth.argmin(1))


def _masked_mean(values: Float[Tensor, "b c h w"], mask: Bool[Tensor, "b 1 h w"]) -> Float[Tensor, ""]:
    """Mean over the mask's pixels and the channels; 0 where the mask is empty."""
    return (values * mask).sum() / (mask.sum().clamp_min(1) * values.shape[1])


def _masked_l1(
    prediction: Float[Tensor, "b c h w"], target: Float[Tensor, "b c h w"], mask: Bool[Tensor, "b 1 h w"]
) -> Float[Tensor, ""]:
    return _masked_mean((prediction - target).abs(), mask)


def landing_color(
    kind: Kind,
    prediction: Prediction,
    buffers: Buffers,
    screen: Screen | None,
    textures: Textures,
) -> Float[Tensor, "b 3 h w"]:
    """Colour (albedo, sRGB-encoded) at the predicted landing points.

    uv: bilinear in the texture of the most probable object. world: p_ndc = (P V p)_xyz / (P V p)_w, bilinear in the
    screen-space colour buffer, clamped to its border. hybrid: as world where the screen shows the point, in
    the probe's panorama elsewhere.
    """
    if prediction.uv is not None and prediction.logits is not None:
        index = prediction.logits.argmax(1)
        return textures.sample(index, select(prediction.uv, index))
    assert screen is not None, "this kind looks colours up on the screen"
    if prediction.ndc is not None:
        return sample_screen(screen.color, prediction.ndc)
    if kind == "hybrid":
        seen = prediction.traced.seen if prediction.traced else None
        return _color_at(prediction.world, seen, buffers.world_to_clip, screen)
    ndc, _ = project(prediction.world, buffers.world_to_clip)
    return sample_screen(screen.color, ndc)


def shown_share(screen: Screen, ndc: Tensor, depth: Tensor) -> Float[Tensor, "b 1 h w"]:
    """1 where the screen shows points, 0 where they are hidden or beside it, with a soft step between."""
    return inside_screen(ndc, EDGE) * visibility(screen.depth, ndc, depth, TOLERANCE)


def _color_at(
    world: Float[Tensor, "b 3 h w"], seen: Tensor | None, world_to_clip: Tensor, screen: Screen
) -> Float[Tensor, "b 3 h w"]:
    """hybrid's lookup: on the screen as far as it shows points (`seen`; None: by its depth), else by the probe."""
    ndc, depth = project(world, world_to_clip)
    share = shown_share(screen, ndc, depth) if seen is None else seen
    by_probe = sample_probe(screen.probe, screen.probe_position, world)
    return share * sample_screen(screen.color, ndc) + (1 - share) * by_probe


def _further_channels(prediction: Prediction, buffers: Buffers, screen: Screen) -> Float[Tensor, "b 13 h w"]:
    """What hybrid's renderer gets beside colour and normal.

    The mean colour of four points in each pixel, between whose centres landing points are interpolated; direct lighting
    of the landing point where the screen shows it; the point; and where a tracer was at work, the share of light on the
    path, and the colour that the first surface mirrors times its share.
    """
    clip, traced = buffers.world_to_clip, prediction.traced
    ndc, depth = project(prediction.world, clip)
    seen = traced.seen if traced else shown_share(screen, ndc, depth)
    finer = interpolate(torch.cat([prediction.world, seen], 1), scale_factor=2, mode="bilinear", align_corners=False)
    mean = avg_pool2d(_color_at(finer[:, :3], finer[:, 3:], clip, screen), 2)
    light, mirrored = torch.zeros_like(seen), torch.zeros_like(mean)
    if traced:
        light, mirrored = traced.light, traced.mirrored_light * _color_at(traced.mirrored, None, clip, screen)
    return torch.cat([mean, seen * sample_screen(buffers.direct, ndc), prediction.world, light, mirrored], 1)


def r_buffer(
    kind: Kind, prediction: Prediction, buffers: Buffers, screen: Screen | None, textures: Textures
) -> Float[Tensor, "b r h w"]:
    """Colour and normal at the landing points, then hybrid's further channels; zero where there is no glass."""
    parts = [landing_color(kind, prediction, buffers, screen, textures), prediction.normal]
    if kind == "hybrid" and screen is not None:
        parts.append(_further_channels(prediction, buffers, screen))
    return torch.cat(parts, 1) * buffers.covered


def needs_screen(kind: Kind | None) -> bool:
    return kind in ("world", "screen", "hybrid")


class Layout(NamedTuple):
    """What a trained network depends on; frames of another layout are refused."""

    scene: str
    textures: tuple[str, ...]
    """Name-independent fingerprints of the textures, in order."""

    @staticmethod
    def of(frames: Frames) -> "Layout":
        return Layout(str(frames.card["scene"]), tuple(_fingerprint(texture) for texture in frames.textures))


def _fingerprint(texture: UInt8[np.ndarray, "_ _ 3"]) -> str:
    return hashlib.sha256(repr(texture.shape).encode() + texture.tobytes()).hexdigest()[:16]


def check_layout(layout: Layout, size: str, frames: Frames, side: int) -> None:
    """Whether a network of this layout can take these frames.

    Args:
        size: name of the network's size.
        side: of the images, in pixels.

    Raises:
        UserError: another scene, other textures, or a side that the network's levels do not divide.
    """
    found = Layout.of(frames)
    again = "take a data set of the scene that the model was trained on, or train on this one"
    if found.scene != layout.scene:
        raise UserError(f"The data set shows the scene {found.scene!r}.", f"{layout.scene!r}, as in training", again)
    if found.textures != layout.textures:
        differing = sum(a != b for a, b in zip(found.textures, layout.textures, strict=False))
        raise UserError(
            f"The data set has {len(found.textures)} textures, {differing} of which differ from those of the training.",
            f"the {len(layout.textures)} textures of the training, in their order",
            again,
        )
    step = 2 ** SIZES[size].levels
    if side % step:
        raise UserError(
            f"The images have {side} x {side} pixels.",
            f"a side that is a multiple of {step}, for networks of size {size!r}",
            "make the data with another --resolution, or take another size or crop",
        )


class RefractionModel(nn.Module):
    """A trained model: generator (None for glassnet), lookup and renderer.

    Args:
        name: of the model, a key of MODELS.
        size: a key of SIZES.
        layout: of the scene it belongs to.
        textures: of the scene's opaque objects.
        coordinates: "predicted" by the generator, or "true".
    """

    def __init__(
        self,
        name: str,
        size: str,
        layout: Layout,
        textures: Sequence[np.ndarray],
        device: torch.device | str,
        coordinates: str = "predicted",
    ):
        super().__init__()
        self.name, self.size, self.layout, self.coordinates = name, size, layout, coordinates
        self.kind: Kind | None = kind_of(name)
        self.textures = Textures(textures, device)
        learned = self.kind is not None and coordinates == "predicted"
        self.generator: Generator | Tracer | None = None
        if self.kind and learned:
            self.generator = new_generator(self.kind, size, len(textures)).to(device)
        self.renderer = new_renderer(self.kind, size).to(device)

    @property
    def device(self) -> torch.device:
        return self.textures.texels.device

    def take_generator(self, path: Path) -> None:
        """Load a trained generator and freeze it; hybrid's may be a tracer or a network.

        Raises:
            UserError: it is missing, damaged, of another kind or of another layout.
        """
        weights, _, header = load_part(path)
        if header["layout"] != self.layout or header["model"] != self.name:
            raise UserError(
                f"{path} is the generator of {header['model']} for the scene {header['layout'].scene!r}.",
                f"that of {self.name} for the scene {self.layout.scene!r} with the same textures",
                "take another generator, or train one: leave --generator out",
            )
        if self.kind == "hybrid":
            self.generator = tracer_like(weights, SIZES[header["size"]]) or self.generator
        assert self.generator is not None
        fill(self.generator.to(self.device), weights, path)
        self.generator.requires_grad_(False).eval()

    def predict(self, buffers: Buffers) -> Prediction | None:
        """The generator's output, or the truth; None for glassnet."""
        if self.kind and self.coordinates == "true":
            return truth(self.kind, buffers, len(self.textures))
        return split_output(self.kind, self.generator(buffers)) if self.generator and self.kind else None

    def bake(self, buffers: Buffers, screen: Screen | None) -> Float[Tensor, "b r h w"]:
        """The R-buffer; no channels for glassnet."""
        prediction = self.predict(buffers)
        if self.kind is None or prediction is None:
            return buffers.reference[:, :0]
        return r_buffer(self.kind, prediction, buffers, screen, self.textures)

    def forward(self, buffers: Buffers, screen: Screen | None) -> Float[Tensor, "b 3 h w"]:
        """The image, sRGB-encoded, clamped to [0, 1]."""
        return self.renderer(buffers, self.bake(buffers, screen)).clamp(0, 1)


def new_generator(kind: Kind, size: str, textures: int) -> Generator:
    return Generator(output_channels(kind, textures), SIZES[size]).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def new_renderer(kind: Kind | None, size: str) -> Renderer:
    return Renderer(r_channels(kind), SIZES[size]).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]


def save_part(path: Path, network: nn.Module, header: dict[str, Any], extra: dict[str, Tensor] | None = None) -> None:
    """Write a generator or renderer with what it depends on; `extra` tensors travel along."""
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    write_tensors(path, tensors | (extra or {}), {"format": FORMAT} | header)


def load_part(path: Path) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]:
    """Weights, extra tensors and header of `save_part`.

    Raises:
        UserError: missing, damaged, or of another format.
    """
    tensors, header = read_tensors(path, "trained network", "catacaustics refract train")
    if header.get("format") != FORMAT or "layout" not in header or header.get("size") not in SIZES:
        raise UserError(
            f"{path} has format {header.get('format')} of refraction networks.", f"format {FORMAT}", "train again"
        )
    header["layout"] = Layout(header["layout"]["scene"], tuple(header["layout"]["textures"]))
    weights = {k.removeprefix("network."): v for k, v in tensors.items() if k.startswith("network.")}
    return weights, {k: v for k, v in tensors.items() if not k.startswith("network.")}, header


def fill(network: nn.Module, weights: dict[str, Tensor], path: Path) -> None:
    """Load weights.

    Raises:
        UserError: they belong to another network.
    """
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        raise UserError(
            f"The weights in {path} do not fit: {str(error).splitlines()[-1].strip()}",
            "weights of a network of this kind and size",
            "check the path, or train again",
        ) from error


def load_model(run: Path, frames: Frames, device: torch.device | str = "cpu") -> RefractionModel:
    """The trained model of a run, for frames of a data set.

    Raises:
        UserError: training has not finished, a file is damaged, or the frames have another layout.
    """
    run = Path(run)
    weights, _, header = load_part(run / "renderer.safetensors")
    kind_of(header["model"])
    check_layout(header["layout"], header["size"], frames, int(frames.card["resolution"]))
    model = RefractionModel(
        header["model"],
        header["size"],
        header["layout"],
        frames.textures,
        device,
        header.get("coordinates", "predicted"),
    )
    fill(model.renderer, weights, run / "renderer.safetensors")
    if model.generator is not None:
        model.take_generator(run / "generator.safetensors")
    return model.eval()


assert set(get_args(Kind)) == {kind for kind in MODELS.values() if kind}
