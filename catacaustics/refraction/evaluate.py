"""`catacaustics refract evaluate`: a trained refraction model on held-out frames: metrics, speed, pictures."""

import time
import weakref
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.weak import WeakIdKeyDictionary
from tqdm import tqdm

from catacaustics.config import RefractEvaluateConfig
from catacaustics.errors import UserError
from catacaustics.files import read_json, write_json, write_text
from catacaustics.layers import ERROR_COLORMAP, error_image
from catacaustics.metrics import lpips_missing
from catacaustics.refraction.buffers import Buffers, frame_buffers, frame_screen
from catacaustics.refraction.frames import Frame, Frames, open_frames
from catacaustics.refraction.lookup import Screen
from catacaustics.refraction.measures import MEASURES, mean_rows, measure_frame, pool_regions
from catacaustics.refraction.models import RefractionModel, load_model
from catacaustics.refraction.train import keep_content
from catacaustics.report import (
    Picture,
    definitions_html,
    details_html,
    encode_picture,
    legend_html,
    picture_html,
    zoom_page,
)
from catacaustics.run import choose_device

_TIMED_FRAMES = 12


class View(NamedTuple):
    """A frame as a model sees and shows it; images (h, w, 3) in [0, 1]."""

    image: np.ndarray
    looked_up: np.ndarray | None
    """Colour at the predicted landing points of the pixels that show glass."""
    true_color: np.ndarray
    """The texture's colour at the true ones."""


def evaluate(config: RefractEvaluateConfig) -> dict[str, Any]:
    """Render and measure the frames of a split; writes RUN/metrics.json and RUN/report.html.

    Prints the means and returns what metrics.json holds.

    Raises:
        UserError: training has not finished, no frames, frames of another layout, or an image that is not finite.
    """
    run = Path(config.run)
    settings = read_json(run / "config.json")
    data = Path(config.data or settings["data"])
    frames = open_frames(data)
    model = load_model(run, frames, choose_device(config.device))
    split = frames.split(config.split)
    if not len(split):
        raise UserError(f"{data} has no {config.split} frames.", "one or more", "take another --split, or make them")
    shown = set(np.linspace(0, len(split) - 1, min(config.shown_frames, len(split))).round().astype(int).tolist())
    rows, regions, articles = [], [], []
    for i in tqdm(range(len(split)), desc="evaluation", unit="frame"):
        frame = split[i]
        view = render_frame(model, frame, settings.get("content", "both"))
        if not np.isfinite(view.image).all():
            raise UserError(
                f"{model.name} gives values that are not finite on frame {i} of {config.split}.",
                "a trained model",
                "train again with a lower learning rate",
            )
        row, region, flip = measure_frame(frame, view.image, view.looked_up, view.true_color)
        rows.append(row)
        regions.append(region)
        if i in shown:
            articles.append(_article(f"{config.split} {i}", row, frame, view, flip))
    result = {
        "model": model.name,
        "mean": mean_rows(rows),
        "regions": pool_regions(regions, model.kind is not None),
        "speed": measure_speed(model, split),
        "training": settings,
        "protocol": _protocol(split, config.split, frames),
        "frames": rows,
    }
    write_json(run / "metrics.json", result)
    write_text(run / "report.html", _page(run, result, articles))
    print(format_result(result))
    print(f"report: {run / 'report.html'}")
    return result


def render_frame(model: RefractionModel, frame: Frame, content: str = "both") -> View:
    """A frame's image, the colours it looked up and the true ones."""
    device = model.device
    buffers, screen = _inputs(frame, device)
    with torch.no_grad():
        baked = model.bake(buffers, screen)
        image = model.renderer(buffers, keep_content(baked, content)).clamp(0, 1)
        looked_up = _picture_of(baked[:, :3]) if model.kind else None
        true_color = model.textures.sample(buffers.landing_object, buffers.landing_uv)
    return View(_picture_of(image), looked_up, _picture_of(true_color))


def _inputs(frame: Frame, device: torch.device) -> tuple[Buffers, Screen]:
    return frame_buffers(frame).to(device), Screen(*(value.to(device) for value in frame_screen(frame)))


def _picture_of(image: Tensor) -> np.ndarray:
    return image[0].movedim(0, -1).float().cpu().numpy()


def measure_speed(model: RefractionModel, frames: Frames) -> dict[str, Any]:
    """Milliseconds a frame (generator, lookups and renderer; median, buffers in memory), parameters, and the most
    memory that one frame takes beside weights and inputs, in MiB."""
    device = model.device
    inputs = [_inputs(frames[i], device) for i in range(min(_TIMED_FRAMES, len(frames)))]
    seconds = []
    with torch.no_grad():
        model(*inputs[0])
        for one in inputs * (1 + (_TIMED_FRAMES - 1) // len(inputs)):
            started = time.perf_counter()
            model(*one)
            if device.type == "cuda":
                torch.cuda.synchronize()
            seconds.append(time.perf_counter() - started)
        memory = _peak_memory(model, inputs[0])
    return {
        "ms": 1000 * float(np.median(seconds)),
        "parameters": sum(p.numel() for p in model.parameters()),
        "memory": memory / 2**20,
        "device": torch.cuda.get_device_name(device)
        if device.type == "cuda"
        else f"CPU, {torch.get_num_threads()} threads",
        "pixels": inputs[0][0].depth.shape[-1],
    }


def _peak_memory(model: RefractionModel, inputs: tuple[Buffers, Screen]) -> int:
    """Most bytes of tensors that are alive at a time while one frame is rendered."""
    device = model.device
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        model(*inputs)
        return torch.cuda.max_memory_allocated(device) - before
    with _LiveBytes() as live:
        model(*inputs)
    return live.peak


class _LiveBytes(TorchDispatchMode):
    """Counts the bytes of the tensors that operations make, while they are alive; scratch memory is not seen."""

    def __init__(self):
        super().__init__()
        self.live = self.peak = 0
        self.known = WeakIdKeyDictionary()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        for value in tree_leaves(result):
            if isinstance(value, Tensor) and (storage := value.untyped_storage()) not in self.known:
                self.known[storage] = storage.nbytes()
                self.live += storage.nbytes()
                self.peak = max(self.peak, self.live)
                weakref.finalize(storage, self._freed, storage.nbytes())
        return result

    def _freed(self, size: int) -> None:
        self.live -= size


def format_result(result: dict[str, Any]) -> str:
    """The means as plain text."""
    mean, speed = result["mean"], result["speed"]
    numbers = "  ".join(f"{key} {value:.4f}" for key, value in mean.items())
    lines = [f"{result['model']}: {numbers}"]
    for name, region in result["regions"].items():
        figures = "  ".join(f"{key} {region[key]:.4f}" for key in ("T.L1", "R.L1") if key in region)
        lines.append(f"  {name:<20}{figures}  ({region['pixels']:,} pixels)")
    lines.append(f"  {speed['ms']:.1f} ms a frame, {speed['parameters']:,} parameters, {speed['memory']:.0f} MiB")
    return "\n".join(lines)


def _protocol(split: Frames, name: str, frames: Frames) -> dict[str, Any]:
    missing = lpips_missing()
    return {
        "scene": frames.card["scene"],
        "split": f"{name}, {len(split)} frames",
        "resolution": frames.card["resolution"],
        "metrics": MEASURES
        | {"LPIPS": f"not measured: {missing}" if missing else "VGG-16, whole image (torchmetrics)"},
    }


def _article(name: str, row: dict[str, Any], frame: Frame, view: View, flip: np.ndarray) -> str:
    """A frame's pictures side by side."""
    strip = legend_html(ERROR_COLORMAP, "0", "1")
    pictures = [
        enlarged("Path traced", frame.reference),
        enlarged("Model", view.image),
        enlarged(f"Error (FLIP, glass outlined) {strip}", error_image(flip, frame.refractive)),
        enlarged("Direct light, no glass", frame.direct),
        enlarged("True colour at the landing points", view.true_color),
    ]
    if view.looked_up is not None:
        pictures.append(enlarged("Colour looked up", view.looked_up))
    numbers = " ".join(
        f"<span>{key} <b>{row[key]:.4f}</b></span>" for key in ("T.L1", "T.SSIM", "R.L1", "L1") if key in row
    )
    grid = "".join(picture_html(p) for p in pictures)
    head = f'<h3>{escape(name)}</h3><p class="measured">{numbers}</p>'
    return f'<article>{head}<div class="grid three">{grid}</div></article>'


def enlarged(caption: str, image: np.ndarray) -> Picture:
    """Small images with their pixels doubled or more, so that the browser does not blur them."""
    times = max(1, 384 // max(image.shape[:2]))
    return encode_picture(caption, np.repeat(np.repeat(image, times, 0), times, 1))


def _page(run: Path, result: dict[str, Any], articles: list[str]) -> str:
    place = run.absolute()
    name = escape(f"{place.parent.name} / {place.name}")
    protocol, speed = result["protocol"], result["speed"]
    facts = [
        escape(f"{result['model']} on {protocol['scene']}"),
        protocol["split"],
        f"{protocol['resolution']} x {protocol['resolution']} pixels",
        f"{speed['ms']:.1f} ms a frame ({speed['device']})",
        f"{speed['parameters']:,} parameters, {speed['memory']:.0f} MiB",
    ]
    heads = "".join(f'<th scope="col">{key}</th>' for key in result["mean"])
    cells = "".join(f"<td>{value:.4f}</td>" for value in result["mean"].values())
    table = f'<table class="views"><thead><tr>{heads}</tr></thead><tbody><tr>{cells}</tr></tbody></table>'
    header = f'<p class="facts">Refraction baking</p><h1>{name}</h1><p class="facts">{" · ".join(facts)}</p>'
    hint = "Click a picture to enlarge it and compare it with the path-traced one."
    rows = "".join(
        f'<tr><th scope="row">{escape(k)}</th><td>{v["pixels"]:,}</td><td>{v["T.L1"]:.4f}</td>'
        f"<td>{optional(v.get('R.L1'))}</td></tr>"
        for k, v in result["regions"].items()
    )
    regions = (
        '<table class="views"><thead><tr><th>landing points</th><th>pixels</th><th>T.L1</th><th>R.L1</th></tr></thead>'
        f"<tbody>{rows}</tbody></table>"
    )
    details = [
        details_html("Measures", definitions_html(protocol["metrics"]), opened=True),
        details_html("Training configuration", definitions_html(result["training"])),
    ]
    body = [
        f'<header>{header}<div class="scroll">{table}</div></header>',
        f"<section><h2>By landing point</h2>{regions}</section>",
        f'<section><h2>Frames</h2><p class="hint">{hint}</p>{"".join(articles)}</section>',
        f"<section><h2>Details</h2>{''.join(details)}</section>",
    ]
    return zoom_page(f"{name}: refraction", "\n".join(body), style="img { image-rendering: pixelated; }")


def optional(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"
