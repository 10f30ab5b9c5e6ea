"""`catacaustics ablate`: what each part is worth, at equal time and at equal iterations, in one table and one chart."""

import re
import shutil
from dataclasses import asdict, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import torch

from catacaustics.capture.dataset import Capture, open_capture
from catacaustics.catacaustic import flow_error
from catacaustics.config import AblateConfig, TrainConfig
from catacaustics.errors import UserError
from catacaustics.files import read_json, write_json, write_text
from catacaustics.metrics import psnr
from catacaustics.page import figure_svg, html_page
from catacaustics.reflectors.volume import ReflectionVolume, build_volume
from catacaustics.run import choose_device, clock_of
from catacaustics.scene import Scene
from catacaustics.training.initialize import named_reflectors, usual_points
from catacaustics.training.loop import fit
from catacaustics.training.photographs import photograph, scaled_camera
from catacaustics.training.selection import choose_models

_ROWS: dict[str, dict[str, Any]] = {
    "auto": {"model": ("auto",)},
    "primary only": {"model": ("none",)},
    "no densification": {"model": ("neural",), "densifications": 0},
    "no DSSIM, no TV": {"model": ("neural",), "weight_dssim": 0.0, "weight_tv": 0.0},
    "half warp": {"model": ("neural",)},
    "full (neural)": {"model": ("neural",)},
}
_RUNGS = ("static", "plane", "sphere", "ellipsoid", "revolution", "concave", "quadric+neural")
_LINES = 30
"""Names that find room above each other in the chart."""
_CLOUDS = (0.25, 0.5)
"""Sizes of the reflection clouds in the chart beside the usual one, in its units."""


def ablate(config: AblateConfig) -> dict[str, Any]:
    """Train every row for the same time and for the same iterations and measure it on the held-out views; finished
    rows are kept. Writes OUT/ablation.json, .html and .svg; prints the table and returns what the JSON holds.

    Raises:
        UserError: no capture, no held-out views, no reflector, or a row of that name.
    """
    capture, out = open_capture(config.capture), Path(config.out)
    truth = capture if config.truth is None else open_capture(config.truth)
    volumes = [build_volume(capture, name) for name in capture.reflectors]
    if not capture.held_out or not volumes:
        missing = "held-out views" if volumes else "masks of a reflector"
        raise UserError(f"{config.capture} has no {missing}.", "both, to measure inside the reflector", "add them")
    rows = _rows(config, capture, volumes)
    budgets = {f"{config.minutes:g} min": {"minutes": config.minutes, "iterations": 10**9}} if config.minutes else {}
    if config.iterations:
        budgets[f"{config.iterations} iterations"] = {"minutes": None, "iterations": config.iterations}
    key = {k: str(v) for k, v in asdict(config).items() if k not in ("out", "rows", "json")}
    path = out / "ablation.json"
    kept = read_json(path) if path.is_file() else {}
    results = kept["results"] if kept.get("key") == key else []
    for seed in config.seeds:
        for budget, limits in budgets.items():
            for name, settings in rows.items():
                if any((r["name"], r["budget"], r["seed"]) == (name, budget, seed) for r in results):
                    print(f"ablation: {name}, {budget}, seed {seed} is finished, kept")
                    continue
                print(f"ablation: {name}, {budget}, seed {seed}")
                folder = out / "runs" / re.sub(r"\W+", "_", f"{name}_{budget}_{seed}")
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir(parents=True)
                train = TrainConfig(
                    config.capture,
                    folder,
                    clock=config.clock,
                    image_size=config.image_size,
                    seed=seed,
                    device=config.device,
                )
                result = _train_row(capture, volumes, replace(train, **limits, **settings), truth)
                results.append({"name": name, "budget": budget, "seed": seed} | result)
                write_json(path, {"key": key, "results": results})
    write_text(out / "ablation.html", _page(capture, config, results))
    write_text(out / "ablation.svg", chart(results))
    print(format_rows(results))
    print(f"ablation: {out / 'ablation.html'}")
    if config.json is not None:
        write_json(config.json, {"key": key, "results": results})
    return {"key": key, "results": results}


def _rows(config: AblateConfig, capture: Capture, volumes: list[ReflectionVolume]) -> dict[str, dict[str, Any]]:
    train = TrainConfig(config.capture, config.out, image_size=config.image_size)
    usual = usual_points(capture, volumes, train)["reflection_points"]
    rows: dict[str, dict[str, Any]] = {k: dict(v) for k, v in _ROWS.items()} | {r: {"model": (r,)} for r in _RUNGS}
    rows["half warp"]["warp_width"] = train.warp_width // 2
    for rung in config.cloud_rungs:
        for share in _CLOUDS:
            name = f"{rung}, {share:g} x points"
            rows[name] = {"model": (rung,), "reflection_points": max(200, int(share * usual))}
    unknown = [r for r in config.rows if r not in rows]
    if unknown:
        raise UserError(f"There is no row {unknown[0]!r}.", ", ".join(rows), "change --rows")
    return {k: v for k, v in rows.items() if not config.rows or k in config.rows}


def _train_row(
    capture: Capture, volumes: list[ReflectionVolume], config: TrainConfig, truth: Capture
) -> dict[str, Any]:
    curve: list[dict[str, float]] = []

    def probe(scene: Scene, seconds: float, steps: int) -> None:
        curve.append({"seconds": seconds, "steps": steps} | held_out_scores(scene, capture, volumes, config))

    clock = clock_of(config.clock)
    started = clock()
    chosen = choose_models(capture, volumes, config)
    selection = clock() - started
    scene = fit(capture, named_reflectors(volumes, chosen.model), chosen, probe)
    for point in curve:  # what the trials took is part of the price
        point["seconds"] += selection if chosen is not config else 0.0
    for heavy in ("checkpoint.safetensors", "scene.safetensors"):
        (config.run / heavy).unlink(missing_ok=True)
    flow = flow_error(scene.to("cpu"), truth)
    return {
        "models": list(chosen.model),
        "curve": curve,
        "points": sum(len(c) for c in (scene.primary, *scene.reflections)),
        "flow_degrees": None if flow is None else flow.mean,
    }


def held_out_scores(
    scene: Scene, capture: Capture, volumes: list[ReflectionVolume], config: TrainConfig
) -> dict[str, float]:
    """PSNR inside the reflectors and over the whole image, means over the held-out views; and flicker: the mean
    absolute difference, inside, between the changes from view to view of the renders and of the photographs."""
    inside, whole, flicker = [], [], []
    before: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    for view in capture.held_out:
        camera = scaled_camera(view.camera, config.image_size, 1.0)
        with torch.no_grad():
            render = scene.render(camera).rgb.cpu().numpy()
        photo = photograph(capture, view, camera)
        mask = np.logical_or.reduce([v.project_mask(camera) for v in volumes])
        whole.append(psnr(render, photo))
        if mask.any():
            inside.append(psnr(render[mask], photo[mask]))
        if before is not None and before[0].shape == render.shape and (mask & before[2]).any():
            both = mask & before[2]
            flicker.append(float(np.abs((render - before[0]) - (photo - before[1]))[both].mean()))
        before = (render, photo, mask)
    return {
        "inside": float(np.mean(inside)),
        "whole": float(np.mean(whole)),
        "flicker": float(np.mean(flicker)) if flicker else float("nan"),
    }


def summary(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means and spreads over the seeds, a row for each name and budget, in the order of the results."""
    rows = []
    for name, budget in dict.fromkeys((r["name"], r["budget"]) for r in results):
        same = [r for r in results if (r["name"], r["budget"]) == (name, budget)]
        last = [r["curve"][-1] for r in same]
        flow = [r["flow_degrees"] for r in same if r["flow_degrees"] is not None]
        rows.append(
            {
                "name": name,
                "budget": budget,
                "models": same[0]["models"],
                "seeds": len(same),
                "spread": float(np.std([c["inside"] for c in last])),
                "points": same[0]["points"],
                "flow": float(np.mean(flow)) if flow else None,
                **{k: float(np.mean([c[k] for c in last])) for k in ("inside", "whole", "flicker", "seconds", "steps")},
            }
        )
    return rows


_HEAD = ("row", "inside dB", "seeds", "whole dB", "flicker", "flow deg", "seconds", "steps", "points")


def _cells(row: dict[str, Any]) -> list[str]:
    spread = f" +-{row['spread']:.2f}" if row["seeds"] > 1 else ""
    return [
        row["name"] + (f" ({' '.join(row['models'])})" if row["name"] == "auto" else ""),
        f"{row['inside']:.2f}{spread}",
        str(row["seeds"]),
        f"{row['whole']:.2f}",
        f"{row['flicker']:.4f}",
        "-" if row["flow"] is None else f"{row['flow']:.2f}",
        f"{row['seconds']:.0f}",
        f"{row['steps']:.0f}",
        f"{row['points']:,}",
    ]


def format_rows(results: list[dict[str, Any]]) -> str:
    """The table as plain text, one block a budget."""
    lines = []
    rows = summary(results)
    for budget in dict.fromkeys(r["budget"] for r in rows):
        table = [_cells(r) for r in rows if r["budget"] == budget]
        widths = [max(len(r[i]) for r in [_HEAD, *table]) for i in range(len(_HEAD))]
        lines.append(f"equal {budget}")
        lines += ["  ".join(c.rjust(w) if i else c.ljust(w) for i, (c, w) in enumerate(zip(r, widths, strict=True)))
                  for r in [_HEAD, *table]]  # fmt: skip
    return "\n".join(lines)


def _page(capture: Capture, config: AblateConfig, results: list[dict[str, Any]]) -> str:
    rows = summary(results)
    tables = []
    for budget in dict.fromkeys(r["budget"] for r in rows):
        body = "".join(
            f'<tr><th scope="row">{escape(c[0])}</th>' + "".join(f"<td>{escape(x)}</td>" for x in c[1:]) + "</tr>"
            for c in (_cells(r) for r in rows if r["budget"] == budget)
        )
        head = "".join(f"<th>{escape(h)}</th>" for h in _HEAD)
        tables.append(
            f'<section><h2>Equal {escape(budget)}</h2><div class="scroll"><table class="views"><thead><tr>{head}</tr>'
            f"</thead><tbody>{body}</tbody></table></div></section>"
        )
    name = escape(f"{Path(config.capture).absolute().name}: ablation")
    facts = (
        f"{len(capture.held_out)} held-out views at up to {config.image_size} pixels, projected reflection volumes; "
        f"device {choose_device(config.device)}. Flicker: mean absolute "
        "difference between the changes of renders and photographs from view to view. Flow: mean angle between "
        "displayed and true directions of mirrored things."
    )
    header = f'<header><p class="facts">Ablation</p><h1>{name}</h1><p class="hint">{facts}</p></header>'
    curves = f'<section><h2>Error against seconds</h2><figure class="curve">{chart(results)}</figure></section>'
    return html_page(name, header + curves + "".join(tables))


def chart(results: list[dict[str, Any]]) -> str:
    """PSNR inside the reflector against training seconds as SVG, a line a row (equal-time rows where there are any)."""
    from matplotlib.figure import Figure

    budgets = list(dict.fromkeys(r["budget"] for r in results))
    shown = [r for r in results if r["budget"] == budgets[0]] if budgets else []
    figure = Figure(figsize=(9, 5), layout="constrained")
    axes = figure.add_subplot()
    ends: list[tuple[float, float, str, Any]] = []
    for name in dict.fromkeys(r["name"] for r in shown):
        curves = [r["curve"] for r in shown if r["name"] == name]
        count = min(map(len, curves))
        x, y = (np.mean([[c[k] for c in curve[:count]] for curve in curves], 0) for k in ("seconds", "inside"))
        faint = " x points" in name or name.startswith(("no ", "half"))
        (line,) = axes.plot(
            x, y, marker="o", markersize=3, linewidth=1 if faint else 2, linestyle="--" if faint else "-"
        )
        ends.append((float(y[-1]), float(x[-1]), name, line.get_color()))
    gap, lowest, beside = np.ptp(axes.get_ylim()) / _LINES, -np.inf, 1.01 * max((end[1] for end in ends), default=0.0)
    for y, x, name, color in sorted(ends):  # names of curves that end close together stand above each other
        lowest = max(y, lowest + gap)
        axes.annotate(name, (x, y), (beside, lowest), va="center", fontsize=8, color=color)
    axes.set_xlabel("training seconds")
    axes.set_ylabel("PSNR inside the reflector, held-out views (dB)")
    axes.margins(x=0.22)
    axes.set_xlim(left=0)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    return figure_svg(figure)
