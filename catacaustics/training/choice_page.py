"""model_choice.html: what the trials of model selection showed, as one self-contained page."""

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from catacaustics.page import html_page

_TITLES = {
    "model": ("What are the reflectors?", "PSNR inside"),
    "environment": ("Does the scene need an environment map?", "PSNR, whole"),
    "stereo": ("Do stereo's guesses help where no three views agree?", "PSNR, whole"),
    "reflection points": ("How many reflection points?", "PSNR inside"),
    "primary points": ("How many primary points?", "PSNR, whole"),
    "photographs": ("Do poses or exposures need corrections?", "PSNR, aligned"),
}


def choice_html(folder: Path, result: dict[str, Any], least_gain: float) -> str:
    """The page.

    Args:
        folder: the run's folder; names the page.
        result: what model_choice.json holds.
        least_gain: dB, of the rule.
    """
    place = folder.absolute()
    name = escape(f"{place.parent.name} / {place.name}")
    chosen, reflectors, trials = result["chosen"], result["reflectors"], result["trials"]
    models = ", ".join(f"<b>{escape(r)}</b>: {escape(m)}" for r, m in zip(reflectors, chosen["model"], strict=True))
    rest = ", ".join(
        f"{k.replace('_', ' ')}: {'yes' if v else 'no'}"
        if isinstance(v, bool)
        else (f"{v:,} {k.replace('_', ' ')}" if v else "no environment map")
        for k, v in chosen.items()
        if k != "model"
    )
    rule = (
        "Candidates of a question stand in order of complexity. A more complex one is taken only if its mean gain over "
        f"the best so far exceeds both {least_gain:g} dB and twice the standard error of the gain per view. Scores are "
        "means over training views that the trials did not see, inside the reflectors or over the whole image; every "
        "trial had the same number of steps. Where the choice among models was close, the finalists were trained "
        "further and the rule was asked again among them."
    )
    for name, rungs in zip(reflectors, result["untried"], strict=True):
        if rungs:
            of = f" for {escape(name)}" if len(reflectors) > 1 else ""
            rule += f" Not tried{of}: {'; '.join(f'{rung} ({why})' for rung, why in rungs.items())}."
    sections = []
    for question, (title, measure) in _TITLES.items():
        rows = [t for t in trials if t["question"] == question]
        for i, taken in enumerate(result["taken"].get(question, [])):
            heading = f"{title} {escape(reflectors[i])}" if question == "model" and len(reflectors) > 1 else title
            sections.append(f"<section><h2>{heading}</h2>{_table(rows, question, i, measure, taken)}</section>")
    bars = (
        ".bars td, .bars th { padding: .35rem 1rem; text-align: right; } .bars th:first-child { text-align: left; }"
        ".bars .track { width: 22rem; text-align: left; } .bars tbody tr { border-top: 1px solid var(--line); }"
        ".track i { display: block; height: .8rem; border-radius: 3px; background: var(--accent); opacity: .55; }"
        ".taken { font-weight: 600; } .taken .track i { opacity: 1; }"
        ".bars td, .bars th[scope=row] { white-space: nowrap; }"
        "@media (max-width: 800px) { .bars td, .bars th { padding-inline: .4rem; } .bars .track { display: none; } }"
    )
    header = (
        f'<header><p class="facts">Model choice</p><h1>{name}</h1><p>{models}{"; " + rest if rest else ""}</p>'
        f'<p class="hint">{rule}</p></header>'
    )
    return html_page(f"{name}: model choice", header + "\n".join(sections), bars)


def _table(rows: Sequence[dict[str, Any]], question: str, reflector: int, measure: str, taken: str) -> str:
    scores = [_score(t, question, reflector) for t in rows]
    low, high = min(scores), max(scores)
    body = []
    for trial, score in zip(rows, scores, strict=True):
        width = 100 * (score - low) / max(high - low, 1.0)
        cells = (
            f'<td>{score:.2f} dB</td><td class="track"><i style="width:{width:.1f}%"></i></td>'
            f"<td>{trial['seconds']:.1f}</td><td>{trial['steps']}</td><td>{trial['points']:,}</td>"
            f"<td>{trial['parameters']:,}</td>"
        )
        longest = max(t["rounds"] for t in rows if t["name"] == trial["name"])
        is_taken = (trial["name"], trial["rounds"]) == (taken, longest)
        mark = ' class="taken"' if is_taken else ""
        note = (", finalist" if trial["rounds"] > 1 else "") + (" (taken)" if is_taken else "")
        body.append(f'<tr{mark}><th scope="row">{escape(trial["name"])}{note}</th>{cells}</tr>')
    head = (
        f'<tr><th>candidate</th><th>{measure}</th><th class="track">above the lowest</th><th>seconds</th>'
        "<th>steps</th><th>points</th><th>network parameters</th></tr>"
    )
    return f'<div class="scroll"><table class="bars"><thead>{head}</thead><tbody>{"".join(body)}</tbody></table></div>'


def scores_of(trial: dict[str, Any], question: str, reflector: int = 0) -> list[float | None]:
    """The scores per view that a question is decided by."""
    if question == "model":
        return trial["inside"][reflector]
    if question == "reflection points":
        return [score for scores in trial["inside"] for score in scores]
    return trial["whole"]


def _score(trial: dict[str, Any], question: str, reflector: int) -> float:
    values = [v for v in scores_of(trial, question, reflector) if v is not None]
    return float(np.mean(values)) if values else 0.0
