"""The calibration report: one self-contained HTML file with a plan of the cameras and each camera's checks."""

import base64
import html
from pathlib import Path

import numpy as np

from catacaustics.capture.checks import CameraCheck, Change
from catacaustics.capture.dataset import Capture
from catacaustics.files import write_text
from catacaustics.geometry import normalize
from catacaustics.images import encode_image, resize
from catacaustics.shapes import Float

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem; color: #222 }
table { border-collapse: collapse; width: 100% } th { text-align: left; font-weight: 600 }
td, th { padding: .3rem .6rem; border-bottom: 1px solid #ddd; vertical-align: middle }
td.n, small { white-space: nowrap } td.n { text-align: right; font-variant-numeric: tabular-nums }
img { display: block; border-radius: 3px }
.confirmed { color: #18794e } .weak { color: #946800 } .out { color: #b42318 } small { color: #666 }
svg { width: 100%; max-width: 46rem; background: #fafafa; border: 1px solid #ddd; border-radius: 6px }
"""
_COLORS = {"confirmed": "#18794e", "weak": "#d69e00", "": "#3b6fb6"}


def plan_axes(camera_from_world: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "2 3"]:
    """Two unit axes of the plan view, seen from above: above is the mean of what is up in the photographs."""
    up = normalize(-camera_from_world[:, 1, :3].mean(0))
    toward = camera_from_world[0, 2, :3]
    if np.linalg.norm(np.cross(toward, up)) < 1e-6:
        toward = camera_from_world[0, 0, :3]
    right = normalize(np.cross(toward, up))
    return np.stack([right, normalize(np.cross(up, right))])


def plan_svg(capture: Capture, points: Float[np.ndarray, "n 3"], verdicts: dict[str, str]) -> str:
    """Cameras (arrows along their lines of sight, hover for names) and points, from above, as SVG."""
    poses = np.array([v.camera.camera_from_world for v in capture.views])
    axes = plan_axes(poses)
    centers = np.array([v.camera.center for v in capture.views]) @ axes.T
    sights = poses[:, 2, :3] @ axes.T
    dots = points @ axes.T if len(points) else np.zeros((0, 2))
    # Distant background points would shrink the cameras to a dot: the frame is 1.6 times the cameras' own extent.
    middle = (centers.min(0) + centers.max(0)) / 2
    half = 0.8 * max(float((centers.max(0) - centers.min(0)).max()), 1e-9)
    dots = dots[(np.abs(dots - middle) < half).all(1)]
    dots = dots[np.random.default_rng(0).permutation(len(dots))[:3000]]

    def pixels(xy: np.ndarray) -> np.ndarray:
        return 400 + 390 * (xy - middle) / half * [1, -1]

    parts = [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1" fill="#b9b9b9"/>' for x, y in pixels(dots)]
    for view, c, s in zip(capture.views, pixels(centers), sights * [1, -1], strict=True):
        ahead, side = s / max(np.linalg.norm(s), 1e-9), np.array([-s[1], s[0]]) / max(np.linalg.norm(s), 1e-9)
        corners = np.array([c, c + 16 * ahead + 7 * side, c + 16 * ahead - 7 * side])
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
        verdict = verdicts.get(view.name, "")
        parts.append(
            f'<polygon points="{text}" fill="{_COLORS.get(verdict, _COLORS[""])}" fill-opacity=".75">'
            f"<title>{html.escape(view.name)} {verdict}</title></polygon>"
        )
    return f'<svg viewBox="0 0 800 800" role="img" aria-label="plan of the cameras">{"".join(parts)}</svg>'


def _thumbnail(image: np.ndarray, width: int = 150) -> str:
    small = resize(image, width, max(round(image.shape[0] * width / image.shape[1]), 1))
    data = base64.b64encode(encode_image(small, ".jpg", 75)).decode()
    return f'<img width="{width}" alt="" src="data:image/jpeg;base64,{data}">'


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %" if np.isfinite(value) else "–"


def write_report(
    root: Path,
    capture: Capture,
    photos: list[str],
    checks: list[CameraCheck],
    changes: list[Change],
    points: Float[np.ndarray, "n 3"],
) -> None:
    """Write ROOT/report.html.

    Args:
        photos: names of all photographs, placed or not.
        checks: of each of them, by index.
        changes: drops, moves and additions, in order.
        points: sparse points for the plan.
    """
    views = {str(Path(v.name).with_suffix("")): v for v in capture.views}
    held_out = {v.name for v in capture.held_out}
    by_index = {c.index: c for c in checks}
    rows, verdicts = [], {}
    for index, name in enumerate(photos):
        view, check = views.get(str(Path(name).with_suffix(""))), by_index.get(index)
        history = "; ".join(f"{c.action}: {c.reason}" for c in changes if c.index == index)
        if view is not None and check is not None:
            verdicts[view.name] = check.verdict
        cells = (
            [""] * 4
            if check is None
            else [
                f"{check.votes} / {check.rival}",
                _percent(check.difference),
                _percent(check.halves),
                _percent(check.silhouette),
            ]
        )
        verdict = "left out" if view is None else check.verdict if check is not None else ""
        reason = "; ".join(filter(None, [history, check.reason if check is not None else ""]))
        style = "out" if view is None else verdict
        rows.append(
            f"<tr><td>{_thumbnail(capture.image(view)) if view is not None else ''}</td>"
            f"<td>{html.escape(name)}{' <small>held out</small>' if view and view.name in held_out else ''}</td>"
            f'<td class="{style}">{verdict}</td>'
            + "".join(f'<td class="n">{cell}</td>' for cell in cells)
            + f"<td>{html.escape(reason)}</td></tr>"
        )
    left_out = len(photos) - len(views)
    confirmed = sum(v == "confirmed" for v in verdicts.values())
    document = f"""<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>Calibration report</title>
<style>{_STYLE}</style></head><body>
<h1>Calibration report</h1>
<p>{len(views)} of {len(photos)} photographs placed ({confirmed} confirmed, {len(views) - confirmed} weak), {left_out}
left out; {len(points)} sparse points in three or more views; {len(held_out)} views held out for measuring.</p>
<h2>Plan</h2>
<p>From above; each wedge is a camera that looks towards its broad side.
Green: confirmed; yellow: weak.</p>
{plan_svg(capture, points, verdicts)}
<h2>Checks</h2>
<p>Every camera was localised anew from points that other cameras placed. <b>Votes</b>: matches for the winning pose and
for the best different one. <b>Shift</b>: between the winning pose and the model's, as a share of the distance to what
the camera sees. <b>Halves</b>: between the poses from two disjoint halves of the other views. <b>Mask</b>: overlap of
painted reflector masks with what the other views' masks leave. Weak: kept, but one half of the views cannot confirm it
alone.</p>
<table><tr><th></th><th>photograph</th><th>verdict</th><th>votes</th><th>shift</th><th>halves</th><th>mask</th>
<th>what was done, why</th></tr>
{"".join(rows)}
</table></body></html>
"""
    write_text(root / "report.html", document)
