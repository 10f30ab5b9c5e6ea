"""`catacaustics refract report`: the models side by side, trained for equal seconds: table, chart, pictures."""

import itertools
from dataclasses import asdict
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from catacaustics.config import RefractEvaluateConfig, RefractReportConfig, RefractTrainConfig
from catacaustics.errors import UserError
from catacaustics.files import read_json, write_json, write_text
from catacaustics.layers import ERROR_COLORMAP, error_image
from catacaustics.metrics import flip_map
from catacaustics.page import figure_svg
from catacaustics.refraction.evaluate import enlarged, evaluate, optional, render_frame
from catacaustics.refraction.frames import open_frames
from catacaustics.refraction.measures import MEASURES
from catacaustics.refraction.models import kind_of, load_model
from catacaustics.refraction.train import train
from catacaustics.report import definitions_html, details_html, legend_html, picture_html, zoom_page
from catacaustics.run import choose_device

_COLUMNS = ("T.L1", "T.PSNR", "T.SSIM", "T.Amp", "R.L1", "L1", "PSNR", "SSIM")
_REGIONS = ("seen", "off screen", "hidden", "internal reflection", "many")
_LOWER_IS_BETTER = {"T.L1", "T.Amp", "R.L1", "L1"}
Key = tuple[str, str]
"""Model and size."""


def report(config: RefractReportConfig) -> dict[str, Any]:
    """Train and measure every model, size and seed that is not finished; writes OUT/comparison.json, OUT/report.html
    and OUT/table.md, prints the table and returns what the JSON holds.

    Raises:
        UserError: no data, unknown model, a run of another time or data set in OUT, or a training that failed.
    """
    out = Path(config.out)
    for model in config.models:
        kind_of(model)
    runs = []
    for seed, size, model in itertools.product(config.seeds, config.sizes, config.models):
        folder = out / "runs" / f"{model}_{size}_{seed}"
        settings = RefractTrainConfig(
            data=config.data,
            run=folder,
            model=model,
            size=size,
            seed=seed,
            minutes=config.minutes,
            generator_share=config.generator_share,
            coordinates=config.coordinates,
            clock=config.clock,
            steps=10**9,
            device=config.device,
            resume=True,
        )
        runs.append({"model": model, "size": size, "seed": seed} | _finished(settings, config))
        write_json(out / "comparison.json", _result(config, runs))
    result = _result(config, runs)
    table = markdown(result)
    write_text(out / "table.md", table)
    write_text(out / "report.html", _page(config, result))
    print(table)
    print(f"report: {out / 'report.html'}")
    return result


def _result(config: RefractReportConfig, runs: list[dict[str, Any]]) -> dict[str, Any]:
    return {"settings": _plain(asdict(config)), "runs": runs, "means": _means(runs)}


def _plain(settings: dict[str, Any]) -> dict[str, Any]:
    return {k: str(v) if isinstance(v, Path) else v for k, v in settings.items()}


def _finished(settings: RefractTrainConfig, config: RefractReportConfig) -> dict[str, Any]:
    """Metrics and speed of one run, trained and measured now where that is not done yet."""
    folder = settings.run
    path, name = folder / "metrics.json", folder.name
    if (folder / "config.json").is_file():
        found, wanted = read_json(folder / "config.json"), _plain(asdict(settings))
        differing = [
            k for k in ("data", "minutes", "generator_share", "coordinates", "clock") if found.get(k) != wanted[k]
        ]
        if differing:
            key = differing[0]
            raise UserError(
                f"{folder} was trained with {key} = {found.get(key)}.",
                f"{key} = {wanted[key]}",
                "choose another output folder, or delete that run",
            )
    if path.is_file() and read_json(path)["protocol"]["split"].startswith(config.split):
        print(f"comparison: {name} is finished, kept")
    else:
        print(f"comparison: {name}")
        train(settings)
        evaluate(RefractEvaluateConfig(folder, config.data, config.split, config.shown_frames, config.device))
    measured = read_json(path)
    steps = {}
    for part in ("generator", "renderer"):
        log = [line for line in (folder / "metrics.jsonl").read_text().splitlines() if f'"{part}"' in line]
        steps[part] = len(log) * 10
    return {key: measured[key] for key in ("mean", "regions", "speed")} | {"steps": steps}


def _means(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means and standard deviations over the seeds, a row for each model and size."""
    rows = []
    for model, size in dict.fromkeys((r["model"], r["size"]) for r in runs):
        same = [r for r in runs if (r["model"], r["size"]) == (model, size)]
        values = {key: [r["mean"][key] for r in same] for key in same[0]["mean"]}
        regions = {}
        for name in same[0]["regions"]:
            entries = [r["regions"][name] for r in same]
            regions[name] = {key: float(np.mean([e[key] for e in entries])) for key in entries[0]}
        rows.append(
            {
                "model": model,
                "size": size,
                "seeds": [r["seed"] for r in same],
                "mean": {key: float(np.mean(v)) for key, v in values.items()},
                "spread": {key: float(np.std(v)) for key, v in values.items()},
                "regions": regions,
                "steps": {part: round(np.mean([r["steps"][part] for r in same])) for part in same[0]["steps"]},
                "speed": {
                    key: float(np.mean([r["speed"][key] for r in same])) for key in ("ms", "parameters", "memory")
                },
            }
        )
    return rows


def markdown(result: dict[str, Any]) -> str:
    """The comparison as tables for a README: the best number of a column is bold, +- is the deviation over seeds."""
    rows = result["means"]
    names = _labels(rows)
    settings = result["settings"]
    lines = [
        f"{settings['minutes']:g} min of {settings['clock']} time each, {settings['generator_share']:.0%} of it for "
        f"the generator where there is one; {settings['coordinates']} landing points; "
        f"seeds {', '.join(map(str, settings['seeds']))}; {settings['split']} frames",
        "",
    ]
    keys = [key for key in _COLUMNS if any(key in row["mean"] for row in rows)]
    cells = [[_with_spread(row, key) for key in keys] for row in rows]
    for j, key in enumerate(keys):
        best = _best([row["mean"].get(key) for row in rows], key in _LOWER_IS_BETTER)
        cells[best][j] = f"**{cells[best][j]}**"
    lines += _markdown_table(["model", *keys], [[n, *c] for n, c in zip(names, cells, strict=True)])
    regions = [name for name in _REGIONS if any(name in row["regions"] for row in rows)]
    lines += ["", "T.L1 (R.L1) by landing point, pooled over pixels:", ""]
    counts = [f"{name} ({rows[0]['regions'].get(name, {}).get('pixels', 0):,.0f} px)" for name in regions]
    body = [[n, *(_region(row["regions"].get(name)) for name in regions)] for n, row in zip(names, rows, strict=True)]
    lines += _markdown_table(["model", *counts], body)
    lines.append("")
    body = [
        [
            n,
            f"{s['ms']:.1f}",
            f"{s['parameters']:,.0f}",
            f"{s['memory']:.0f}",
            f"{t['generator']:,}",
            f"{t['renderer']:,}",
        ]
        for n, s, t in ((n, row["speed"], row["steps"]) for n, row in zip(names, rows, strict=True))
    ]
    heads = ["model", "ms a frame", "parameters", "MiB", "generator steps", "renderer steps"]
    return "\n".join([*lines, *_markdown_table(heads, body)]) + "\n"


def _markdown_table(heads: list[str], rows: list[list[str]]) -> list[str]:
    rule = ["---"] + ["--:"] * (len(heads) - 1)
    return ["| " + " | ".join(cells) + " |" for cells in [heads, rule, *rows]]


def _with_spread(row: dict[str, Any], key: str) -> str:
    if key not in row["mean"]:
        return "–"
    digits = 2 if "PSNR" in key else 4
    spread = f" ± {row['spread'][key]:.{digits}f}" if len(row["seeds"]) > 1 else ""
    return f"{row['mean'][key]:.{digits}f}{spread}"


def _best(values: list[float | None], lower: bool) -> int:
    worst = np.inf if lower else -np.inf
    numbers = [worst if v is None else v for v in values]
    return int(np.argmin(numbers) if lower else np.argmax(numbers))


def _region(values: dict[str, float] | None) -> str:
    if values is None:
        return "–"
    return f"{values['T.L1']:.4f}" + (f" ({values['R.L1']:.4f})" if "R.L1" in values else "")


# The page --------------------------------------------------------------------------------------------------------


def chart(rows: list[dict[str, Any]]) -> str:
    """T.L1 against milliseconds a frame as SVG: a line a model, a point a size, bars of one deviation over seeds."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator

    figure = Figure(figsize=(9, 5), layout="constrained")
    axes = figure.add_subplot()
    for model in dict.fromkeys(row["model"] for row in rows):
        own = sorted((r for r in rows if r["model"] == model), key=lambda r: r["speed"]["ms"])
        x, y = [r["speed"]["ms"] for r in own], [r["mean"]["T.L1"] for r in own]
        bars = axes.errorbar(x, y, [r["spread"]["T.L1"] for r in own], marker="o", markersize=6, capsize=3)
        color = bars.lines[0].get_color()
        for i, row in enumerate(own):
            last = i == len(own) - 1  # named beside its point, the others below theirs
            name = model if len(own) == 1 else f"{model} {row['size']}"
            text, place = (name, (8, 5)) if last else (row["size"], (0, -14))
            side = "left" if last else "center"
            axes.annotate(text, (x[i], y[i]), place, textcoords="offset points", fontsize=8, color=color, ha=side)
    axes.set_xscale("log")
    axes.xaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    for ticks in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        ticks(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel("milliseconds a frame")
    axes.set_ylabel("T.L1 on glass (lower is better)")
    axes.margins(x=0.2, y=0.12)
    axes.grid(alpha=0.25, which="both")
    axes.spines[["top", "right"]].set_visible(False)
    return figure_svg(figure)


def _page(config: RefractReportConfig, result: dict[str, Any]) -> str:
    frames = open_frames(config.data)
    name = escape(f"{frames.card['scene']}: refraction models compared")
    clock = "processor" if config.clock == "cpu" else "wall-clock"
    facts = (
        f"{config.minutes:g} minute{'s' * (config.minutes != 1)} of {clock} time each; "
        f"{config.generator_share:.0%} of it goes to the generator; glassnet gives it all to its renderer, hybrid what "
        f"its generator does not need. Landing points are {config.coordinates}. {_seeds(config)}."
    )
    header = f'<header><p class="facts">Refraction baking</p><h1>{name}</h1><p class="hint">{facts}</p></header>'
    rows = result["means"]
    speed = f'<figure class="curve">{chart(rows)}</figure>{_speed_table(rows)}'
    sections = [
        header,
        f"<section><h2>Errors</h2>{_metric_table(rows)}</section>",
        f"<section><h2>By landing point: T.L1 (R.L1)</h2>{_region_table(rows)}</section>",
        f"<section><h2>Speed against error</h2>{speed}</section>",
        f"<section><h2>Frames</h2>{''.join(_articles(config, result))}</section>",
        f"<section><h2>Details</h2>{details_html('Measures', definitions_html(MEASURES), opened=True)}</section>",
    ]
    return zoom_page(name, "\n".join(sections), style="img { image-rendering: pixelated; }")


def _seeds(config: RefractReportConfig) -> str:
    if len(config.seeds) == 1:
        return f"One seed, {config.seeds[0]}: differences as small as those between seeds mean nothing"
    return f"Numbers are means over the seeds {', '.join(map(str, config.seeds))}, ± their standard deviation"


def _html_table(heads: list[str], rows: list[list[str]]) -> str:
    head = "".join(f"<th>{h}</th>" for h in heads)
    body = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>' + "".join(f"<td>{cell}</td>" for cell in row[1:]) + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table class="views"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _labels(rows: list[dict[str, Any]]) -> list[str]:
    """Models, with their sizes where there are several."""
    many = len({row["size"] for row in rows}) > 1
    return [f"{row['model']} ({row['size']})" if many else row["model"] for row in rows]


def _metric_table(rows: list[dict[str, Any]]) -> str:
    keys = [key for key in (*_COLUMNS, "T.FLIP", "FLIP", "LPIPS") if any(key in row["mean"] for row in rows)]

    def cell(row: dict[str, Any], key: str) -> str:
        mean, *spread = _with_spread(row, key).split(" ", 1)
        return mean + "".join(f"<small>{part}</small>" for part in spread)

    body = [[name, *(cell(row, key) for key in keys)] for name, row in zip(_labels(rows), rows, strict=True)]
    return _html_table(["model", *keys], body)


def _region_table(rows: list[dict[str, Any]]) -> str:
    names = [name for name in _REGIONS if any(name in row["regions"] for row in rows)]
    heads = [f"{n}<small>{rows[0]['regions'].get(n, {}).get('pixels', 0):,.0f} pixels</small>" for n in names]
    body = [
        [label, *(_region(row["regions"].get(n)) for n in names)]
        for label, row in zip(_labels(rows), rows, strict=True)
    ]
    return _html_table(["model", *heads], body)


def _speed_table(rows: list[dict[str, Any]]) -> str:
    body = [
        [label, f"{s['ms']:.1f}", f"{s['parameters']:,.0f}", f"{s['memory']:.0f}", optional(row["mean"]["T.L1"])]
        for label, row, s in ((label, row, row["speed"]) for label, row in zip(_labels(rows), rows, strict=True))
    ]
    return _html_table(["model", "ms a frame", "parameters", "memory (MiB)", "T.L1"], body)


def _articles(config: RefractReportConfig, result: dict[str, Any]) -> list[str]:
    """Frames with the picture, the colours looked up and the error of every model (first size and seed)."""
    frames = open_frames(config.data)
    split = frames.split(config.split)
    models = {
        name: load_model(
            Path(config.out) / "runs" / f"{name}_{config.sizes[0]}_{config.seeds[0]}",
            frames,
            choose_device(config.device),
        )
        for name in config.models
    }
    articles = []
    for i in dict.fromkeys(np.linspace(0, len(split) - 1, config.shown_frames).round().astype(int).tolist()):
        frame = split[i]
        views = {name: render_frame(model, frame) for name, model in models.items()}
        true_color = next(iter(views.values())).true_color
        images = [enlarged("Path traced", frame.reference)]
        images += [enlarged(name, view.image) for name, view in views.items()]
        lookups = [enlarged("True colour at the landing points", true_color)]
        lookups += [
            None if view.looked_up is None else enlarged(f"{name}: looked up", view.looked_up)
            for name, view in views.items()
        ]
        errors = [enlarged("Direct light, no glass", frame.direct)]
        for name, view in views.items():
            strip = legend_html(ERROR_COLORMAP, "0", "1")
            flip = flip_map(view.image, frame.reference)
            errors.append(enlarged(f"{name}: FLIP {strip}", error_image(flip, frame.refractive)))
        style = f'style="grid-template-columns: repeat({len(images)}, minmax(0, 1fr))"'
        grids = "".join(
            f'<div class="grid" {style}>{"".join(picture_html(p) if p else "<div></div>" for p in row)}</div>'
            for row in (images, lookups, errors)
        )
        articles.append(f"<article><h3>{escape(config.split)} {i}</h3>{grids}</article>")
    return articles
