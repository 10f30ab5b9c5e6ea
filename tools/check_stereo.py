"""Hold the fused cloud of a path-traced capture against its true depth.

    python tools/check_stereo.py CAPTURE [--cloud FILE.ply] [--json FILE]

Only training views that have a truth file count. For each: how many points it sees (not hidden by a true surface), how
many of those lie within 1 % of the true depth, the median angle to the true normals, and which share of its diffuse
surface has a right point within 2 pixels: of all of it, and of what has texture. A point of the cloud is right
when at least half of the views that see it find it within 1 %; a point that no view sees is wrong.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np

from catacaustics.cameras import Camera
from catacaustics.capture.dataset import Capture, View, open_capture
from catacaustics.capture.truth import Truth, read_truth, truth_path
from catacaustics.errors import UserError
from catacaustics.files import write_json
from catacaustics.points import PointCloud, read_ply

TOLERANCE = 0.01
REACH = 2
MIN_CONTRAST = 3 / 255
"""Standard deviation over 7 x 7 pixels from which a surface counts as textured."""


class ViewCheck(NamedTuple):
    """One view: points that it sees and that agree (boolean, per point), angles to true normals, covered shares."""

    sees: np.ndarray
    agrees: np.ndarray
    angles: np.ndarray
    coverage: float
    textured_coverage: float
    textured_share: float


def true_inverse_depth(truth: Truth, pixels: np.ndarray) -> np.ndarray:
    """Inverse depth between pixel centres: bilinear (exact on planes), the nearest pixel's across depth edges; nan
    where there is no surface."""
    height, width = truth.depth.shape
    inverse = 1 / truth.depth
    corner = np.clip(np.floor(pixels - 0.5).astype(int), 0, [width - 2, height - 2])
    fx, fy = np.clip(pixels - 0.5 - corner, 0, 1).T
    x, y = corner.T
    around = np.stack([inverse[y, x], inverse[y, x + 1], inverse[y + 1, x], inverse[y + 1, x + 1]])
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    smooth = around.max(0) < 1.05 * around.min(0)
    nearest = np.take_along_axis(around, weights.argmax(0)[None], 0)[0]
    return np.where(smooth, (around * weights).sum(0), nearest)


def contrast(image: np.ndarray) -> np.ndarray:
    """Standard deviation of the gray image over 7 x 7 pixels."""
    import cv2

    gray = image.astype(np.float32).mean(-1) / 255
    mean = cv2.blur(gray, (7, 7))
    return np.sqrt(np.maximum(cv2.blur(gray * gray, (7, 7)) - mean * mean, 0))


def check_view(cloud: PointCloud, camera: Camera, truth: Truth, textured: np.ndarray) -> ViewCheck:
    import cv2

    pixels, depth = camera.project(cloud.positions.astype(float))
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < [camera.width, camera.height]).all(1)
    error = np.full(len(cloud), -np.inf)
    # Positive: in front of the true surface; negative: hidden behind it. Nothing hides a point before the sky.
    true_depth = 1 / true_inverse_depth(truth, pixels[inside])
    error[inside] = 1 - depth[inside] / np.where(np.isfinite(true_depth), true_depth, np.inf)
    sees = error > -TOLERANCE
    agrees = np.abs(error) < TOLERANCE
    columns, rows = pixels[agrees].astype(int).T
    normals = truth.normals[rows, columns]
    angles = np.degrees(np.arccos(np.clip((cloud.normals[agrees] * normals).sum(1), -1, 1)))
    hit = np.zeros(truth.depth.shape, np.uint8)
    hit[rows, columns] = 1
    covered = cv2.dilate(hit, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * REACH + 1,) * 2)) > 0
    diffuse = np.isfinite(truth.depth) & ~truth.mirror_mask
    textured = textured & diffuse
    return ViewCheck(
        sees,
        agrees,
        angles[np.isfinite(angles)],
        float(covered[diffuse].mean()),
        float(covered[textured].mean()) if textured.any() else float("nan"),
        float(textured.sum() / diffuse.sum()),
    )


def views_with_truth(capture: Capture) -> list[View]:
    views = [view for view in capture.train if truth_path(capture.root, view.name).is_file()]
    if not views:
        raise UserError(
            f"No training view of {capture.root} has a file in truth/.",
            "a path-traced capture with its true depth",
            "choose such a capture; for real photographs look at the cloud instead",
        )
    return views


def check_cloud(capture: Capture, cloud: PointCloud) -> dict:
    """The figures of every view and of the whole cloud."""
    rows = []
    sees, agrees, angles = np.zeros(len(cloud), int), np.zeros(len(cloud), int), []
    for view in views_with_truth(capture):
        truth = read_truth(capture.root, view.name)
        check = check_view(cloud, view.camera, truth, contrast(capture.image(view)) > MIN_CONTRAST)
        sees += check.sees
        agrees += check.agrees
        angles.append(check.angles)
        rows.append(
            {
                "view": view.name,
                "points_seen": int(check.sees.sum()),
                "within_1_percent": float(check.agrees.sum() / max(check.sees.sum(), 1)),
                "normal_error_degrees": float(np.median(check.angles)) if len(check.angles) else float("nan"),
                "coverage": check.coverage,
                "textured_coverage": check.textured_coverage,
                "textured_share": check.textured_share,
            }
        )
    right = (agrees > 0) & (2 * agrees >= sees)
    every_angle = np.concatenate(angles)
    summary = {
        "points": len(cloud),
        "within_1_percent": float(right.mean()) if len(cloud) else 0.0,
        "seen_by_no_view": float((sees == 0).mean()) if len(cloud) else 0.0,
        "normal_error_degrees": float(np.median(every_angle)) if len(every_angle) else float("nan"),
        "normals_within_10_degrees": float((every_angle < 10).mean()) if len(every_angle) else 0.0,
        "coverage": float(np.mean([row["coverage"] for row in rows])),
        "textured_coverage": float(np.nanmean([row["textured_coverage"] for row in rows])),
    }
    return {"summary": summary, "views": rows}


def print_table(result: dict) -> None:
    print(f"{'view':24} {'points':>8} {'within 1 %':>10} {'normals':>8} {'coverage':>9} {'textured':>9}")
    for row in result["views"]:
        print(
            f"{row['view'][-24:]:24} {row['points_seen']:8d} {row['within_1_percent']:10.1%} "
            f"{row['normal_error_degrees']:7.1f}° {row['coverage']:9.1%} {row['textured_coverage']:9.1%}"
        )
    total = result["summary"]
    print(
        f"{'whole cloud':24} {total['points']:8d} {total['within_1_percent']:10.1%} "
        f"{total['normal_error_degrees']:7.1f}° {total['coverage']:9.1%} {total['textured_coverage']:9.1%}"
    )
    print(f"points seen by no view: {total['seen_by_no_view']:.1%}", end="; ")
    print(f"normals within 10 degrees: {total['normals_within_10_degrees']:.1%}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--cloud", type=Path, help="PLY file to check instead of the capture's points.ply")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    capture = open_capture(arguments.capture)
    result = check_cloud(capture, read_ply(arguments.cloud) if arguments.cloud else capture.points())
    print_table(result)
    if arguments.json:
        write_json(arguments.json, result)


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        raise SystemExit(f"error: {error}") from None
