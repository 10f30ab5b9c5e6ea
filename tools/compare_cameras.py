"""Compare the cameras of a capture with a reference COLMAP model of the same photographs.

The two are aligned by a robust similarity of camera centres. Position errors are shares of the distance from the
reference camera to the subject: the point nearest to all optical axes, unless --center gives it (in reference
coordinates).
"""

import argparse
import json
from itertools import combinations
from pathlib import Path

import numpy as np

from catacaustics.capture.colmap import has_model, read_model
from catacaustics.errors import UserError
from catacaustics.files import write_json
from catacaustics.geometry import fit_similarity, rigid_inverse, rotation_angle

TOLERANCE = 0.02


def _poses(folder: Path) -> dict[str, np.ndarray]:
    """world_from_camera by file name without suffix (undistortion may change the suffix)."""
    folder = folder if has_model(folder) else folder / "sparse" / "0"
    return {
        str(Path(i.name).with_suffix("")): rigid_inverse(np.asarray(i.camera_from_world))
        for i in read_model(folder).images
    }


def _subject(poses: np.ndarray) -> np.ndarray:
    """The point with the smallest sum of squared distances to all optical axes."""
    axes, centers = poses[:, :3, 2], poses[:, :3, 3]
    away = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    return np.linalg.solve(away.sum(0), (away @ centers[..., None]).sum(0)[:, 0])


def compare(poses: np.ndarray, reference: np.ndarray, center: np.ndarray | None = None, seed: int = 0) -> dict:
    """Align world_from_camera poses (n, 4, 4) to reference ones and measure each.

    Returns:
        position_errors (shares of the distance to the subject), rotation_errors (degrees), subject, scale.
    """
    a, b = poses[:, :3, 3], reference[:, :3, 3]
    subject = _subject(reference) if center is None else center
    distance = np.linalg.norm(b - subject, axis=1)
    every = list(combinations(range(len(a)), 3))
    rng = np.random.default_rng(seed)
    trials = every if len(every) <= 3000 else [every[i] for i in rng.choice(len(every), 3000, replace=False)]
    best, most = None, (-1, 0.0)
    for trial in trials:
        try:
            similarity = fit_similarity(a[list(trial)], b[list(trial)])
        except ValueError:
            continue
        error = np.linalg.norm(similarity.apply(a) - b, axis=1) / distance
        score = (int((error < TOLERANCE).sum()), -float(np.minimum(error, TOLERANCE).sum()))
        if score > most:
            best, most = error < TOLERANCE, score
    if best is None or best.sum() < 3:
        raise UserError(
            "No similarity brings three cameras into agreement.", "two models of one scene", "check both paths"
        )
    similarity = fit_similarity(a[best], b[best])
    for _ in range(5):  # inliers change a little once all of them share in the fit
        error = np.linalg.norm(similarity.apply(a) - b, axis=1) / distance
        if (error < TOLERANCE).sum() < 3:
            break
        similarity = fit_similarity(a[error < TOLERANCE], b[error < TOLERANCE])
    error = np.linalg.norm(similarity.apply(a) - b, axis=1) / distance
    turned = similarity.rotation @ poses[:, :3, :3]
    rotation = np.degrees(rotation_angle(turned @ np.swapaxes(reference[:, :3, :3], 1, 2)))
    return {"position_errors": error, "rotation_errors": rotation, "subject": subject, "scale": similarity.scale}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture", type=Path, help="capture folder, or a folder with a COLMAP model")
    parser.add_argument("reference", type=Path, help="folder with the reference COLMAP model")
    parser.add_argument("--center", type=float, nargs=3, metavar=("X", "Y", "Z"), help="subject in the reference")
    parser.add_argument("--json", type=Path, help="write the figures here too")
    args = parser.parse_args()
    ours, reference = _poses(args.capture), _poses(args.reference)
    names = sorted(set(ours) & set(reference))
    if len(names) < 3:
        raise SystemExit(f"{len(names)} photographs are in both models; at least 3 are needed.")
    result = compare(
        np.array([ours[n] for n in names]),
        np.array([reference[n] for n in names]),
        None if args.center is None else np.array(args.center),
    )
    position, rotation = result["position_errors"], result["rotation_errors"]
    print(f"{'photograph':40s} {'position %':>10s} {'rotation deg':>12s}")
    for name, p, r in zip(names, position, rotation, strict=True):
        print(f"{name[-40:]:40s} {100 * p:10.2f} {r:12.2f}{'  <-- off' if p >= TOLERANCE else ''}")
    good = int((position < TOLERANCE).sum())
    figures = {
        "reference_views": len(reference),
        "in_both": len(names),
        "only_in_capture": sorted(set(ours) - set(reference)),
        "missing": sorted(set(reference) - set(ours)),
        f"within_{100 * TOLERANCE:.0f}_percent": good,
        "median_position_percent": float(100 * np.median(position)),
        "largest_position_percent": float(100 * position.max()),
        "median_rotation_degrees": float(np.median(rotation)),
    }
    print(json.dumps(figures, indent=2))
    if args.json:
        views = {
            n: {"position_percent": float(100 * p), "rotation_degrees": float(r)}
            for n, p, r in zip(names, position, rotation, strict=True)
        }
        write_json(args.json, figures | {"subject": result["subject"].tolist(), "views": views})


if __name__ == "__main__":
    main()
