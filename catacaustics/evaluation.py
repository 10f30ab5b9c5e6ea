"""Held-out evaluation of a trained scene: metrics.json for programs, report.html for people."""

import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import catacaustics
from catacaustics.cameras import Camera
from catacaustics.capture.dataset import Capture, View
from catacaustics.config import EvaluateConfig
from catacaustics.errors import UserError
from catacaustics.files import write_json, write_text
from catacaustics.images import RESIZE_FILTER, resize
from catacaustics.metrics import PROTOCOL, Metrics, compare, lpips_missing, mean_metrics
from catacaustics.reflectors.volume import ReflectionVolume, build_volume
from catacaustics.report import ReportView, report_html, report_view
from catacaustics.run import Run, open_run, read_log
from catacaustics.scene import RenderOutput, Scene
from catacaustics.shapes import Bool
from catacaustics.training.corrections import align_view
from catacaustics.training.initialize import scene_extent
from catacaustics.training.photographs import photograph, scaled_camera

_ALIGNED = (
    "the view's own pose correction and three exposure gains, where training learned those of its photographs, fitted "
    "to the held-out photograph with the scene frozen, then measured as the other rows"
)


def evaluate(config: EvaluateConfig) -> dict[str, Any]:
    """Render every held-out view at the training resolution and measure it; writes RUN/metrics.json, RUN/report.html.

    Prints the table of means and returns what metrics.json holds.

    Raises:
        UserError: no finished run, no capture, no held-out views, or a render that is not finite.
    """
    return evaluate_run(open_run(config.run, config.capture, config.device), config.shown_views)


def evaluate_run(run: Run, shown_views: int = 12) -> dict[str, Any]:
    """As `evaluate`, for a run that is open already."""
    views = run.capture.held_out
    if not views:
        raise UserError(
            f"{run.capture.root} holds out no views.",
            "at least one held-out view to measure on",
            "name some under held_out in its split.json (delete the file for every 8th view) and train again",
        )
    shown = set(np.linspace(0, len(views) - 1, min(shown_views, len(views))).round().astype(int).tolist())
    rows, pictures = [], []
    volumes = reflection_volumes(run.scene, run.capture)
    for i, view in enumerate(tqdm(views, desc="evaluation", unit="view")):
        row, picture = _measure(run, volumes, view, i in shown)
        rows.append(row)
        if picture is not None:
            pictures.append(picture)
    result = {"mean": _means(rows), "protocol": _protocol(run, rows), "views": rows}
    write_json(run.folder / "metrics.json", result)
    log, skipped = read_log(run.folder)
    html = report_html(run.folder, run.capture.root, run.config, result, pictures, log, skipped)
    write_text(run.folder / "report.html", html)
    print(format_table(result))
    print(f"report: {run.folder / 'report.html'}")
    return result


def format_table(result: dict[str, Any]) -> str:
    """The means of an evaluation as a plain-text table."""
    names = {"whole": "whole image", "inside": "inside the reflector"}
    names |= {f"{key}_aligned": f"{name}, aligned" for key, name in names.items()}
    width = max(len(name) for key, name in names.items() if result["mean"].get(key)) + 2
    lines = [f"{'held-out views: ' + str(len(result['views'])):<{width}}{'PSNR':>9}{'SSIM':>9}{'FLIP':>9}"]
    for key, name in names.items():
        m = result["mean"].get(key)
        if m is not None:
            lines.append(f"{name:<{width}}{m['psnr']:>6.2f} dB{m['ssim']:>9.4f}{m['flip']:>9.4f}")
    return "\n".join(lines)


def reflection_volumes(scene: Scene, capture: Capture) -> list[ReflectionVolume]:
    """The scene's volumes, and those of painted reflectors that it was trained without (primary cloud alone): every
    run on a capture is measured on the same pixels."""
    known = {volume.name for volume in scene.volumes}
    return [*scene.volumes, *(build_volume(capture, name) for name in capture.reflectors if name not in known)]


def reflector_mask(
    volumes: list[ReflectionVolume], capture: Capture, view: View, camera: Camera
) -> tuple[Bool[np.ndarray, "height width"] | None, str]:
    """Union of the reflectors in a view, and where it came from: "painted", "projected", "both" or "none".

    Each reflector's painted mask is taken where the view has one, its projected volume elsewhere.

    Args:
        camera: the view's camera at the wanted size.
    """
    masks, sources = [], set()
    by_name = {volume.name: volume for volume in volumes}
    for name in sorted({*capture.reflectors, *by_name}):
        painted = capture.mask(view, name)
        if painted is not None:
            masks.append(resize(painted.astype(np.float32), camera.width, camera.height) > 0.5)
            sources.add("painted")
        elif name in by_name:
            masks.append(by_name[name].project_mask(camera))
            sources.add("projected")
    if not masks:
        return None, "none"
    return np.logical_or.reduce(masks), "both" if len(sources) == 2 else sources.pop()


def _measure(
    run: Run, volumes: list[ReflectionVolume], view: View, shown: bool
) -> tuple[dict[str, Any], ReportView | None]:
    """The row of a view in metrics.json and, where it is shown, its pictures."""
    camera = scaled_camera(view.camera, run.config["image_size"], 1.0)
    output, seconds = _timed_render(run.scene, camera)
    render = output.rgb.numpy()
    if not np.isfinite(render).all():
        raise UserError(
            f"The render of {view.name} has {np.count_nonzero(~np.isfinite(render))} values that are not finite.",
            "a trained scene",
            "train again from an earlier checkpoint or with lower learning rates",
        )
    photo = photograph(run.capture, view, camera)
    mask, source = reflector_mask(volumes, run.capture, view, camera)
    comparison = compare(render, photo, mask)
    row = {
        "name": view.name,
        "whole": comparison.whole.as_dict(),
        "inside": comparison.inside.as_dict() if comparison.inside else None,
        "mask": source,
        "mask_share": float(mask.mean()) if mask is not None else 0.0,
        "width": camera.width,
        "height": camera.height,
        "seconds": seconds,
    }
    poses, exposure = (bool(run.config.get(key)) for key in ("refine_poses", "exposure"))
    if poses or exposure:
        target = torch.from_numpy(photo).to(run.scene.device)
        corrections = align_view(run.scene, camera, target, poses, exposure, scene_extent(run.capture))
        aligned = corrections.render(run.scene, camera)
        again = compare(aligned.cpu().numpy(), photo, mask)
        row["whole_aligned"] = again.whole.as_dict()
        row["inside_aligned"] = again.inside.as_dict() if again.inside else None
    return row, report_view(row, photo, output, comparison.flip_map, mask) if shown else None


def _timed_render(scene: Scene, camera: Camera) -> tuple[RenderOutput, float]:
    """A view on the CPU and the seconds that rendering took, transfer not counted."""
    with torch.no_grad():
        start = time.perf_counter()
        output = scene.render(camera)
        if scene.device.type == "cuda":
            torch.cuda.synchronize()
        seconds = time.perf_counter() - start
        return RenderOutput(*(layer.float().cpu() for layer in output)), seconds


def _means(rows: list[dict[str, Any]]) -> dict[str, Any]:
    areas = [key for key in ("whole", "inside", "whole_aligned", "inside_aligned") if key in rows[0]]
    means = {}
    for area in areas:
        values = [Metrics(**row[area]) for row in rows if row[area]]
        means[area] = mean_metrics(values).as_dict() if values else None
    return means


def _protocol(run: Run, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Everything that the numbers depend on."""
    sizes = sorted({(row["width"], row["height"]) for row in rows})
    sources = {source: sum(row["mask"] == source for row in rows) for source in {row["mask"] for row in rows}}
    device, missing = run.scene.device, lpips_missing()
    return {
        "split": {"train": len(run.capture.train), "held_out": len(rows)},
        "resolution": [f"{width} x {height}" for width, height in sizes],
        "resize_filter": RESIZE_FILTER,
        "masks": {key: sources[key] for key in sorted(sources)},
        "views_inside": sum(row["inside"] is not None for row in rows),
        "metrics": PROTOCOL
        | ({"aligned": _ALIGNED} if "whole_aligned" in rows[0] else {})
        | {"lpips": f"not measured: {missing}" if missing else "VGG-16, whole image (torchmetrics)"},
        "seconds_per_frame": float(np.median([row["seconds"] for row in rows])),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else _cpu_name(),
        "versions": {"catacaustics": catacaustics.__version__}
        | {name: _version(name) for name in ("torch", "torchmetrics", "flip-evaluator")},
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def _cpu_name() -> str:
    import platform

    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor() or 'CPU'}, {torch.get_num_threads()} threads"
