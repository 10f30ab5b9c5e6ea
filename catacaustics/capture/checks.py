"""Is each camera where it says it is? Independent checks of a mapped model, and repair.

A misplaced camera hides well: its reprojection error is as small as any other's, because every point that speaks
against it was thrown out. So each camera is localised anew from points that other cameras placed, with all matches,
also those that the pair geometry had rejected, and the hypotheses are counted: a right camera wins clearly and wins
again from a disjoint half of the views.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from catacaustics.capture.sfm import Features, load_pycolmap, num_threads, registered
from catacaustics.geometry import normalize, rigid_inverse, rotation_angle
from catacaustics.images import read_mask, resize
from catacaustics.shapes import Bool, Float

AGREE = 0.05
"""Two poses of one camera agree within this share of its distance to what it sees ..."""
AGREE_ANGLE = np.radians(4)
"""... and this angle."""
RIVAL = 0.6
"""A camera is ambiguous when a different pose has more than this share of the winner's inliers."""
MIN_VOTES = 20
"""Fewest inliers of a pose that may repair or add a camera; half of it may confirm one."""
PNP_ERROR = 6.0
SILHOUETTE = 0.12
"""A mask that overlaps with what the others leave by so much less than the median view's disagrees."""
_NEAR = np.radians(5)
"""A ray that misses a point by less passes it."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose of one camera found from points of others: camera_from_world and its inliers."""

    pose: Float[np.ndarray, "4 4"]
    inliers: int
    depth: float


@dataclass(frozen=True)
class CameraCheck:
    """The result of one camera's check.

    Args:
        index: of the photograph.
        verdict: "confirmed", "weak" (kept, but one half of the views cannot localise it alone), "misplaced",
            "ambiguous", "unconfirmed".
        votes: inliers of the winning pose.
        rival: inliers of the best different pose.
        difference: distance between the winning pose and the model's, as a share of the camera's distance to what it
            sees; NaN without one.
        halves: the same between the poses from two disjoint halves of the views; NaN where a half is not enough.
        silhouette: overlap (IoU) of its masks with what the other views' masks leave; NaN without masks.
        reason: in words.
    """

    index: int
    verdict: str
    votes: int
    rival: int
    difference: float
    halves: float
    silhouette: float
    reason: str

    @property
    def good(self) -> bool:
        return self.verdict in ("confirmed", "weak")


class Landmarks:
    """The points of a model as arrays: which feature of which photograph sees which point.

    Args:
        model: a pycolmap Reconstruction.
    """

    def __init__(self, model: Any, features: Features):
        index = {image_id: i for i, image_id in enumerate(features.image_ids)}
        self.points = np.array([p.xyz for p in model.points3D.values()]).reshape(-1, 3)
        self.point_of = [np.full(len(k), -1) for k in features.keypoints]
        self.seen = np.zeros((len(self.points), len(features.keypoints)), bool)
        for row, point in enumerate(model.points3D.values()):
            for element in point.track.elements:
                photo = index[element.image_id]
                self.point_of[photo][element.point2D_idx] = row
                self.seen[row, photo] = True
        self.poses = registered(model, features)
        self.cameras = [model.cameras[c] for c in features.camera_ids]


def difference(a: np.ndarray, b: np.ndarray, depth: float) -> tuple[float, float]:
    """Distance of two camera poses' centres as a share of `depth`, and their angle in radians."""
    apart = np.linalg.norm(rigid_inverse(a)[:3, 3] - rigid_inverse(b)[:3, 3]) / max(depth, 1e-12)
    return float(apart), float(rotation_angle(a[None, :3, :3] @ b[:3, :3].T)[0])


def agree(a: np.ndarray, b: np.ndarray, depth: float) -> bool:
    apart, angle = difference(a, b, depth)
    return bool(apart < AGREE and angle < AGREE_ANGLE)


def correspondences(
    view: int, marks: Landmarks, matches: dict[tuple[int, int], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features of a view and points that they might show, by matches to other registered views.

    Only points that at least two other views placed count: a point that hangs on the view itself would agree with it
    wherever it were.

    Returns:
        Feature indices (n,), point rows (n,), and the view (n,) each came through; pairs are unique.
    """
    rows = []
    for other in marks.poses:
        pair = matches.get((min(view, other), max(view, other)))
        if other == view or pair is None:
            continue
        mine, theirs = (pair[:, 0], pair[:, 1]) if view < other else (pair[:, 1], pair[:, 0])
        point = marks.point_of[other][theirs]
        rows.append(np.column_stack([mine, point, np.full(len(pair), other)])[point >= 0])
    if not rows:
        return np.zeros(0, int), np.zeros(0, int), np.zeros(0, int)
    table = np.concatenate(rows).astype(int)
    table = table[marks.seen[table[:, 1]].sum(1) - marks.seen[table[:, 1], view] >= 2]
    # Of the views that offer the same pair any one is taken, so that the halves of the views stay even.
    table = np.random.default_rng(0).permutation(table)
    _, unique = np.unique(table[:, :2], axis=0, return_index=True)
    table = table[unique]
    return table[:, 0], table[:, 1], table[:, 2]


def localise(
    camera: Any, pixels: Float[np.ndarray, "n 2"], points: Float[np.ndarray, "n 3"], hypotheses: int = 1
) -> list[Hypothesis]:
    """Poses of a camera by P3P RANSAC and refinement; each next one from what the ones before leave.

    Hypotheses that agree with an earlier one are added to it.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = PNP_ERROR, 0
    options.ransac.min_inlier_ratio, options.ransac.max_num_trials = 0.03, 5000
    found: list[Hypothesis] = []
    for _ in range(hypotheses):
        if len(pixels) < 6:
            break
        result = pycolmap.estimate_and_refine_absolute_pose(pixels, points, camera, options)
        if result is None or result["num_inliers"] < 6:
            break
        inlier = np.asarray(result["inlier_mask"], bool)
        pose = np.eye(4)
        pose[:3] = result["cam_from_world"].matrix()
        depth = float(np.median(np.abs(points[inlier] @ pose[2, :3] + pose[2, 3])))
        same = next((k for k, h in enumerate(found) if agree(h.pose, pose, h.depth)), None)
        if same is None:
            found.append(Hypothesis(pose, int(inlier.sum()), depth))
        else:
            found[same] = replace(found[same], inliers=found[same].inliers + int(inlier.sum()))
        pixels, points = pixels[~inlier], points[~inlier]
    return sorted(found, key=lambda h: -h.inliers)


def check_camera(
    view: int, marks: Landmarks, features: Features, matches: dict[tuple[int, int], np.ndarray]
) -> tuple[CameraCheck, Hypothesis | None]:
    """Localise one photograph, registered or not, from the points of the others.

    Returns:
        The check, and the winning pose where it is clear enough to repair or add the camera with.
    """
    mine, point, through = correspondences(view, marks, matches)
    pixels, points, camera = features.keypoints[view][mine], marks.points[point], marks.cameras[view]
    found = localise(camera, pixels, points, hypotheses=3)
    nan, pose = float("nan"), marks.poses.get(view)
    if not found:
        reason = f"only {len(mine)} matches to points of the other views"
        return CameraCheck(view, "unconfirmed", 0, 0, nan, nan, nan, reason), None
    best, rival = found[0], found[1].inliers if len(found) > 1 else 0
    # Two halves of the views, alternating in order of how much they share, and with disjoint points.
    order = np.argsort(-np.bincount(through, minlength=len(features.keypoints)), kind="stable")
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order))
    half = np.zeros(len(marks.points), int)
    half[point[::-1]] = rank[through[::-1]] % 2
    halves = [localise(camera, pixels[half[point] == k], points[half[point] == k]) for k in (0, 1)]
    strong = all(h and h[0].inliers >= MIN_VOTES // 2 for h in halves)
    apart = difference(halves[0][0].pose, halves[1][0].pose, best.depth)[0] if strong else nan
    shift, angle = difference(pose, best.pose, best.depth) if pose is not None else (nan, nan)
    check = CameraCheck(view, "confirmed", best.inliers, rival, shift, apart, nan, "")
    clear = best.inliers >= MIN_VOTES and rival <= RIVAL * best.inliers
    if rival > RIVAL * best.inliers:
        reason = f"another pose has {rival} inliers against {best.inliers}"
        check = replace(check, verdict="ambiguous", reason=reason)
    elif best.inliers < MIN_VOTES // 2:
        check = replace(check, verdict="unconfirmed", reason=f"only {best.inliers} inliers from the other views")
    elif pose is not None and not agree(pose, best.pose, best.depth):
        reason = f"the other views see it {100 * shift:.0f} % and {np.degrees(angle):.1f} degrees elsewhere"
        check = replace(check, verdict="misplaced" if clear else "unconfirmed", reason=reason)
    elif not strong:
        check = replace(check, verdict="weak", reason="half of the views is not enough to localise it")
    elif not agree(halves[0][0].pose, halves[1][0].pose, best.depth):
        reason = f"two halves of the views place it {100 * apart:.0f} % apart"
        check = replace(check, verdict="weak", reason=reason)
    return check, best if clear else None


def check_all(
    views: list[int], marks: Landmarks, features: Features, matches: dict[tuple[int, int], np.ndarray]
) -> list[tuple[CameraCheck, Hypothesis | None]]:
    """`check_camera` for several photographs, with progress."""
    from tqdm import tqdm

    with ThreadPoolExecutor(num_threads()) as pool:
        jobs = pool.map(lambda v: check_camera(v, marks, features, matches), views)
        return list(tqdm(jobs, "check cameras", len(views), unit="camera"))


@dataclass(frozen=True)
class Change:
    """What repair did to a photograph: "dropped", "moved" or "added", and why."""

    index: int
    action: str
    reason: str


def repair(
    model: Any,
    rebuild: Callable[[dict[int, Any], dict[int, np.ndarray]], Any],
    features: Features,
    matches: dict[tuple[int, int], np.ndarray],
    rounds: int = 6,
) -> tuple[Any | None, list[CameraCheck], list[Change]]:
    """Check every camera, move or drop what disagrees, add what can be localised clearly, rebuild, and again until
    nothing changes.

    A photograph dropped twice stays out.

    Args:
        rebuild: from cameras by identifier and poses by photograph to a model (`sfm.rebuild`).

    Returns:
        The model, or None where fewer than 3 cameras stand; the last check of every photograph; the changes in order.
    """
    changes: list[Change] = []
    results: list[tuple[CameraCheck, Hypothesis | None]] = []
    model = rebuild(dict(model.cameras), registered(model, features))
    for number in range(rounds + 1):
        marks = Landmarks(model, features)
        results = check_all(list(range(len(features.keypoints))), marks, features, matches)
        poses, fresh = registered(model, features), []
        dropped = [c.index for c in changes if c.action == "dropped"]
        for check, winner in results:
            view, known = check.index, check.index in poses
            if known and not check.good:
                # In the last round nothing moves any more: a new pose would go unchecked.
                if check.verdict == "misplaced" and winner is not None and number < rounds - 1:
                    poses[view] = winner.pose
                    fresh.append(Change(view, "moved", check.reason))
                else:
                    del poses[view]
                    fresh.append(Change(view, "dropped", check.reason))
            elif not known and check.good and winner is not None and number < rounds - 1 and dropped.count(view) < 2:
                poses[view] = winner.pose
                fresh.append(Change(view, "added", f"localised by {check.votes} matches to the others' points"))
        if not fresh or number == rounds:
            break
        changes += fresh
        if len(poses) < 3:
            return None, [check for check, _ in results], changes
        model = rebuild(dict(model.cameras), poses)
    return model, [check for check, _ in results], changes


def reflector_overlaps(
    model: Any, features: Features, masks: dict[str, dict[int, Path]], checks: list[CameraCheck]
) -> tuple[list[CameraCheck], list[Change]]:
    """Compare painted masks between views (`silhouette_overlap`).

    Args:
        masks: mask files by reflector and photograph.

    Returns:
        The checks with each view's worst overlap, and a change for each view whose mask of some reflector overlaps by
        `SILHOUETTE` less than the median view's.
    """
    poses, worst, drop = registered(model, features), {}, []
    for name, files in masks.items():
        small = {v: _shrink(read_mask(path)) for v, path in files.items() if v in poses}
        small = {v: m for v, m in small.items() if m.any()}
        rays, project = {}, {}
        for v, mask in small.items():
            camera = model.cameras[features.camera_ids[v]]
            scale = np.array([mask.shape[1] / camera.width, mask.shape[0] / camera.height])
            middle = (np.argwhere(mask)[:, ::-1].mean(0) + 0.5) / scale
            ray = np.append(camera.cam_from_img(middle), 1.0) @ poses[v][:3, :3]
            rays[v] = ray / np.linalg.norm(ray)
            project[v] = partial(_project, camera, poses[v], scale)
        centers = {v: rigid_inverse(poses[v])[:3, 3] for v in small}
        overlap = silhouette_overlap(small, project, centers, rays)
        median = np.median(list(overlap.values())) if overlap else 0.0
        for v, value in overlap.items():
            worst[v] = min(value, worst.get(v, 1.0))
            if value <= median - SILHOUETTE and all(c.index != v for c in drop):
                reason = (
                    f"its mask of {name} overlaps {100 * value:.0f} % with the other masks, "
                    f"the median view's {100 * median:.0f} %"
                )
                drop.append(Change(v, "dropped", reason))
    reasons = {c.index: c.reason for c in drop}
    checks = [
        replace(
            c,
            silhouette=worst.get(c.index, c.silhouette),
            verdict="misplaced" if c.index in reasons else c.verdict,
            reason=reasons.get(c.index, c.reason),
        )
        for c in checks
    ]
    return checks, drop


def _shrink(mask: np.ndarray, longer: int = 400) -> np.ndarray:
    height, width = mask.shape
    scale = min(1.0, longer / max(height, width))
    return resize(mask.astype(np.uint8) * 255, max(round(width * scale), 1), max(round(height * scale), 1)) > 127


def _project(camera: Any, pose: np.ndarray, scale: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    local = points @ pose[:3, :3].T + pose[:3, 3]
    ahead = local[:, 2] > 1e-9
    pixels = np.full((len(points), 2), -1e6)
    pixels[ahead] = np.asarray(camera.img_from_cam(local[ahead])).reshape(-1, 2) * scale
    return pixels, local[:, 2]


def silhouette_overlap(
    masks: dict[int, Bool[np.ndarray, "height width"]],
    project: dict[int, Any],
    centers: dict[int, Float[np.ndarray, "3"]],
    rays: dict[int, Float[np.ndarray, "3"]],
    resolution: int = 40,
) -> dict[int, float]:
    """How well each view's mask of one reflector fits what the other views' masks leave of space.

    The reflector's place is where most rays through the masks' centres meet. A grid of points around it is carved: a
    point stays where at least 90 % of the other views that look there see it inside their mask. The convex hulls of its
    projection and of the mask are compared.

    Args:
        masks: by view.
        project: by view, a function from points (n, 3) to pixels (n, 2) in the mask and depths (n,).
        centers: camera centres. rays: unit directions through the masks' centres of mass.

    Returns:
        Intersection over union by view; empty with fewer than 4 views.
    """
    views = sorted(masks)
    if len(views) < 4:
        return {}
    place = _meeting_point(np.array([centers[v] for v in views]), np.array([rays[v] for v in views]))
    radii = []
    for v in views:
        pixels, depth = project[v](place[None] + np.eye(3) * 1e-3)
        scale = np.linalg.norm(pixels - project[v](place[None])[0], axis=1).max() / 1e-3
        radii.append(np.sqrt(masks[v].sum() / np.pi) / max(scale, 1e-12))
    radius = float(np.median(radii))
    axis = np.linspace(-2, 2, resolution) * radius
    grid = place + np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    inside, pixels_of = {}, {}
    for v in views:
        pixels, depth = project[v](grid)
        pixels_of[v] = pixels
        inside[v] = (depth > 0) & _look_up(masks[v], pixels)
    # Views that look past the place have no vote on its shape.
    voters = {v for v in views if rays[v] @ normalize(place - centers[v]) > np.cos(_NEAR)}
    votes = sum((inside[v].astype(int) for v in voters), np.zeros(len(grid), int))
    overlap = {}
    for v in views:
        others = len(voters - {v})
        kept = votes - (inside[v] if v in voters else 0) >= max(0.9 * others, 3)
        overlap[v] = _hull_overlap(pixels_of[v][kept], masks[v]) if kept.sum() >= 10 else 0.0
    return overlap


def _meeting_point(centers: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """The point that most rays pass, by trying every pair and refitting to the rays within `_NEAR`."""
    away = np.eye(3) - rays[:, :, None] * rays[:, None, :]

    def meet(rows: np.ndarray) -> np.ndarray:
        system = away[rows].sum(0)
        return np.linalg.lstsq(system, (away[rows] @ centers[rows][..., None]).sum(0)[:, 0], rcond=None)[0]

    def near(point: np.ndarray) -> np.ndarray:
        to = point - centers
        return (normalize(to) * rays).sum(1) > np.cos(_NEAR)

    pairs = [np.array([i, j]) for i in range(len(rays)) for j in range(i) if abs(rays[i] @ rays[j]) < 0.98]
    if not pairs:
        return meet(np.arange(len(rays)))
    best = max((meet(p) for p in pairs), key=lambda x: near(x).sum())
    return meet(np.flatnonzero(near(best))) if near(best).sum() >= 2 else best


def _look_up(mask: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    x, y = np.floor(np.clip(pixels, -1e6, 1e6)).astype(int).T
    ok = (x >= 0) & (y >= 0) & (x < mask.shape[1]) & (y < mask.shape[0])
    return ok & mask[np.clip(y, 0, mask.shape[0] - 1), np.clip(x, 0, mask.shape[1] - 1)]


def _hull_overlap(pixels: np.ndarray, mask: np.ndarray) -> float:
    import cv2

    filled = []
    corners = np.argwhere(mask)[:, ::-1]
    for points in (np.floor(np.clip(pixels, -1e4, 1e4)), corners):
        image = np.zeros(mask.shape, np.uint8)
        hull = cv2.convexHull(points.astype(np.int32))
        cv2.fillConvexPoly(image, hull, 1)
        filled.append(image > 0)
    return float((filled[0] & filled[1]).sum() / max((filled[0] | filled[1]).sum(), 1))
