"""report.html: an evaluation as one self-contained page that works offline."""

import base64
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from catacaustics.images import encode_image, resize
from catacaustics.layers import DEPTH_COLORMAP, ERROR_COLORMAP, colorize, depth_range, error_image, layer_image
from catacaustics.page import html_page
from catacaustics.scene import RenderOutput
from catacaustics.shapes import Bool, Float

_LONGER_SIDE = 1280
"""Pictures are reduced to this many pixels for the page; they are measured at full size."""

_METRICS = {
    "psnr": ("PSNR", "dB", "higher is better", 2),
    "ssim": ("SSIM", "", "higher is better", 4),
    "flip": ("FLIP", "", "lower is better", 4),
    "lpips": ("LPIPS", "", "lower is better", 4),
}
_AREAS = {
    "whole": "whole image",
    "inside": "inside the reflector",
    "whole_aligned": "whole image, view aligned",
    "inside_aligned": "inside the reflector, view aligned",
}


@dataclass(frozen=True)
class Picture:
    """One picture of a view: its caption (HTML) and its JPEG."""

    caption: str
    jpeg: bytes


@dataclass(frozen=True)
class ReportView:
    """The pictures of one held-out view: first photograph, render and error, then the layers."""

    row: dict[str, Any]
    comparison: list[Picture]
    layers: list[Picture]


def report_view(
    row: dict[str, Any],
    photo: Float[np.ndarray, "height width 3"],
    output: RenderOutput,
    flip: Float[np.ndarray, "height width"],
    mask: Bool[np.ndarray, "height width"] | None,
) -> ReportView:
    """Encode the pictures of a view.

    Args:
        row: the view's entry in metrics.json.
        flip: FLIP error of every pixel.
        mask: the reflector's pixels, outlined in the error map.
    """
    near, far = depths = depth_range(output)
    outline = "" if mask is None else ", reflector outlined"
    return ReportView(
        row,
        [
            encode_picture("Photograph", photo),
            encode_picture("Render", layer_image(output, "rgb", depths)),
            encode_picture(f"Error (FLIP{outline}) {legend_html(ERROR_COLORMAP, '0', '1')}", error_image(flip, mask)),
        ],
        [
            encode_picture("Primary", layer_image(output, "primary", depths)),
            encode_picture("Reflection", layer_image(output, "reflection", depths)),
            encode_picture(f"Reflection weight {legend_html('gray', '0', '1')}", layer_image(output, "weight", depths)),
            encode_picture(
                f"Depth {legend_html(DEPTH_COLORMAP, f'{near:.3g}', f'{far:.3g}')}",
                layer_image(output, "depth", depths),
            ),
        ],
    )


def report_html(
    folder: Path,
    capture: Path,
    config: dict[str, Any],
    result: dict[str, Any],
    views: Sequence[ReportView],
    log: list[dict[str, Any]],
    skipped: int,
) -> str:
    """The whole page.

    Args:
        folder: the run's folder, where the page will lie: links are relative to it.
        capture: the capture's folder; its report.html is linked where there is one.
        config: training's configuration.
        result: what metrics.json holds.
        views: the views with pictures.
        log: rows of metrics.jsonl; `skipped` lines of it were unreadable.
    """
    place = folder.absolute()
    name = escape(f"{place.parent.name} / {place.name}")
    protocol = result["protocol"]
    facts = [
        f"{protocol['split']['held_out']} held-out views, {protocol['split']['train']} for training",
        ", ".join(protocol["resolution"]) + " pixels",
        f"{protocol['seconds_per_frame']:.3g} s a frame",
        escape(protocol["device"]),
    ]
    shown = (
        f"{len(views)} of {len(result['views'])} held-out views"
        if len(views) < len(result["views"])
        else "Held-out views"
    )
    header = f'<p class="facts">Held-out evaluation</p><h1>{name}</h1><p class="facts">{" · ".join(facts)}</p>'
    hint = (
        "Click a picture to enlarge it; there, arrow keys change the picture and the slider compares it with the "
        "photograph."
    )
    details = [
        details_html("Protocol", _protocol(protocol), opened=True),
        details_html("Every held-out view", _view_table(result["views"])),
        details_html("Training configuration", definitions_html(config)),
    ]
    sections = [
        f"<header>{header}{_summary(result['mean'])}{_links(folder, capture)}</header>",
        f'<section><h2>{shown}</h2><p class="hint">{hint}</p>{"".join(map(_view, views))}</section>',
        f"<section><h2>Training</h2>{_curves(log, skipped)}</section>",
        f"<section><h2>Details</h2>{''.join(details)}</section>",
    ]
    return zoom_page(f"{name}: held-out evaluation", "\n".join(sections))


def zoom_page(title: str, body: str, style: str = "") -> str:
    """A page whose pictures (`picture_html`, in articles) can be enlarged and compared with the first of their
    article."""
    script = Path(__file__).with_name("report.js").read_text()
    return html_page(title, body, style, after=f"\n{_DIALOG}\n<script>\n{script}</script>")


def encode_picture(caption: str, image: np.ndarray) -> Picture:
    """Encode an RGB or gray image for the page, reduced where it is large; the caption is HTML."""
    height, width = image.shape[:2]
    scale = min(1.0, _LONGER_SIDE / max(height, width))
    return Picture(caption, encode_image(resize(image, round(width * scale), round(height * scale)), ".jpg", 88))


def legend_html(colormap: str, low: str, high: str) -> str:
    """A strip of a matplotlib colormap with the numbers at its ends."""
    colors = (colorize(np.linspace(0, 1, 9), colormap) * 255).round().astype(int)
    stops = ", ".join("#" + "".join(f"{c:02x}" for c in color) for color in colors.tolist())
    return (
        f'<span class="legend">{low}<i title="{colormap}" style="background:linear-gradient(90deg, {stops})"></i>{high}'
        "</span>"
    )


def _number(metrics: dict[str, float] | None, key: str) -> str:
    return "–" if metrics is None or key not in metrics else f"{metrics[key]:.{_METRICS[key][3]}f}"


def _measured(mean: dict[str, Any]) -> list[str]:
    return [key for key in _METRICS if key in mean["whole"]]


def _summary(mean: dict[str, Any]) -> str:
    keys = _measured(mean)
    heads = "".join(
        f'<th scope="col">{_METRICS[k][0]}{" (dB)" if _METRICS[k][1] else ""}<small>{_METRICS[k][2]}</small></th>'
        for k in keys
    )
    rows = "".join(
        f'<tr><th scope="row">{label}</th>' + "".join(f"<td>{_number(mean[area], k)}</td>" for k in keys) + "</tr>"
        for area, label in _AREAS.items()
        if area in mean
    )
    return f'<table class="summary"><thead><tr><td></td>{heads}</tr></thead><tbody>{rows}</tbody></table>'


def _links(folder: Path, capture: Path) -> str:
    targets = {
        "Why this model": folder / "model_choice.html",
        "Capture report": capture / "report.html",
        "Metrics as JSON": folder / "metrics.json",
    }
    targets |= {path.name: path for path in sorted(folder.glob("*.md"))}
    links = []
    for label, path in targets.items():
        if path.is_file():
            relative = Path(os.path.relpath(path.absolute(), folder.absolute())).as_posix()
            links.append(f'<a href="{escape(relative)}">{escape(label)}</a>')
    return f'<p class="links">{" · ".join(links)}</p>' if links else ""


def _view(view: ReportView) -> str:
    row = view.row
    measured = " ".join(
        f"<span>{label} <b>{_number(row[area], 'psnr')}</b> dB, SSIM <b>{_number(row[area], 'ssim')}</b>, "
        f"FLIP <b>{_number(row[area], 'flip')}</b></span>"
        for area, label in _AREAS.items()
        if row.get(area) is not None
    )
    return (
        f'<article><h3>{escape(row["name"])}</h3><p class="measured">{measured}</p>'
        f'<div class="grid three">{"".join(map(picture_html, view.comparison))}</div>'
        f'<div class="grid four">{"".join(map(picture_html, view.layers))}</div></article>'
    )


def picture_html(picture: Picture) -> str:
    """A picture that can be enlarged, with its caption."""
    label = escape(re.sub(r"<.*", "", picture.caption).strip())
    data = base64.b64encode(picture.jpeg).decode()
    image = f'<img alt="{label}" src="data:image/jpeg;base64,{data}">'
    button = f'<button type="button" class="zoom" aria-label="enlarge: {label}">{image}</button>'
    return f"<figure>{button}<figcaption>{picture.caption}</figcaption></figure>"


def _curves(log: list[dict[str, Any]], skipped: int) -> str:
    if len(log) < 2:
        return "<p>The run's metrics.jsonl holds no training log.</p>"
    unit, seconds = next(
        (u, s) for u, s in (("h", 3600), ("min", 60), ("s", 1)) if log[-1]["seconds"] > 3 * s or s == 1
    )
    figures = [
        _curve(log, unit, seconds, "Loss", "loss", {"loss": "loss"}, True),
        _curve(log, unit, seconds, "PSNR of the training patches", "PSNR (dB)", {"psnr": "psnr"}),
        _curve(
            log, unit, seconds, "Points", "points", {"primary_points": "primary", "reflection_points": "reflection"}
        ),
    ]
    stages = "Dotted lines: a new training stage. " if len({row.get("stage") for row in log}) > 1 else ""
    note = f"{skipped} unreadable lines of metrics.jsonl were left out. " if skipped else ""
    return (
        f'<div class="grid three">{"".join(figures)}</div><p class="hint">{len(log)} records; a curve is the mean '
        f"of neighbouring records. {stages}{note}</p>"
    )


def _curve(
    log: list[dict[str, Any]],
    unit: str,
    seconds: int,
    title: str,
    label: str,
    series: dict[str, str],
    logarithmic: bool = False,
) -> str:
    """One plot against training time as inline SVG that takes the page's text colour."""
    import io

    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    ink = "#012345"  # replaced by the page's text colour below
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": title, "font.family": "sans-serif", "font.size": 11}):
        figure = Figure(figsize=(5, 3.4), layout="constrained")
        axes = figure.add_subplot()
        for (key, name), color in zip(series.items(), ("#2f7fc4", "#d9822b"), strict=False):
            points = [(row["seconds"] / seconds, float(row[key])) for row in log if _is_number(row.get(key))]
            time, values = _thin(points)
            if len(time):
                axes.plot(time, values, color=color, linewidth=1.8, label=name)
                logarithmic = logarithmic and bool((values > 0).all())
        changes = [b["seconds"] / seconds for a, b in pairwise(log) if a.get("stage") != b.get("stage")]
        for time in changes:
            axes.axvline(time, color=ink, alpha=0.7, linewidth=1.1, linestyle=":")
        if logarithmic:
            axes.set_yscale("log")
        elif label == "points":
            axes.set_ylim(bottom=0)
            axes.yaxis.set_major_formatter(EngFormatter(sep=""))
        if len(axes.get_legend_handles_labels()[0]) > 1:
            axes.legend(frameon=False, labelcolor=ink)
        axes.set_xlabel(f"training time ({unit})", color=ink)
        axes.set_ylabel(label, color=ink)
        axes.grid(True, which="major", color=ink, alpha=0.15, linewidth=0.6)
        axes.tick_params(which="both", colors=ink)
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(ink)
        buffer = io.StringIO()
        figure.savefig(
            buffer, format="svg", transparent=True, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
    svg = buffer.getvalue()
    svg = re.sub(r'<g id="[^"]*">', "<g>", svg[svg.index("<svg") :].replace(ink, "currentColor"))
    # The page's own fonts and a width that follows the grid.
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r'\1 role="img"', svg, count=1)
    svg = re.sub(r"font: ([\d.]+px)[^;\"]*", r"font: \1 system-ui, sans-serif", svg)
    return f'<figure class="curve"><figcaption>{title}</figcaption>{svg}</figure>'


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _thin(points: list[tuple[float, float]], most: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Means of neighbouring points, at most `most` of them."""
    if not points:
        return np.zeros(0), np.zeros(0)
    parts = np.array_split(np.array(points, float), min(most, len(points)))
    time, values = np.array([part.mean(0) for part in parts]).T
    return time, values


def _view_table(rows: list[dict[str, Any]]) -> str:
    keys = [key for key in _METRICS if key in rows[0]["whole"]]
    areas = [area for area in _AREAS if area in rows[0]]
    columns = [(area, key) for area in areas for key in keys if not (area.startswith("inside") and key == "lpips")]
    heads = "".join(f'<th scope="col">{_METRICS[k][0]}<small>{_AREAS[a]}</small></th>' for a, k in columns)
    body = "".join(
        f'<tr><th scope="row">{escape(row["name"])}</th>'
        + "".join(f"<td>{_number(row[a], k)}</td>" for a, k in columns)
        + f"<td>{100 * row['mask_share']:.1f} %</td><td>{row['mask']}</td><td>{row['seconds']:.3f}</td></tr>"
        for row in rows
    )
    heads = f'<th scope="col">view</th>{heads}' + "".join(
        f'<th scope="col">{text}</th>' for text in ("reflector", "mask", "seconds")
    )
    table = f'<table class="views"><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>'
    return f'<div class="scroll">{table}</div>'


def _protocol(protocol: dict[str, Any]) -> str:
    masks = ", ".join(f"{count} {source}" for source, count in protocol["masks"].items())
    return definitions_html(
        {
            "Split": f"{protocol['split']['train']} training views, {protocol['split']['held_out']} held out",
            "Resolution": ", ".join(protocol["resolution"]) + " pixels, the size of the training",
            "Photographs resized by": protocol["resize_filter"],
            "Reflector masks": f"{masks}; {protocol['views_inside']} views see the reflector",
            **{key.upper() if key in _METRICS else key.capitalize(): text for key, text in protocol["metrics"].items()},
            "Time a frame": f"{protocol['seconds_per_frame']:.3g} s (median), {protocol['device']}",
            "Versions": ", ".join(f"{name} {number}" for name, number in protocol["versions"].items()),
        }
    )


def definitions_html(values: dict[str, Any]) -> str:
    """Names and values as a list."""
    rows = "".join(f"<dt>{escape(str(k))}</dt><dd>{escape(_plain(v))}</dd>" for k, v in values.items())
    return f"<dl>{rows}</dl>"


def _plain(value: Any) -> str:
    """A setting as people write it."""
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return ", ".join(map(_plain, value)) if isinstance(value, list) else str(value)


def details_html(title: str, body: str, opened: bool = False) -> str:
    """A part of the page that can be folded."""
    return f"<details{' open' if opened else ''}><summary>{title}</summary>{body}</details>"


_DIALOG = """<dialog aria-label="enlarged picture"><div class="stage"><img class="below" alt="">
<img class="above" alt=""></div><div class="bar"><button type="button" data-step="-1">← previous</button><b></b>
<button type="button" data-step="1">next →</button>
<label>photograph <input type="range" min="0" max="100" step="0.2" value="0"> picture</label>
<button type="button" data-close>close</button></div></dialog>"""
