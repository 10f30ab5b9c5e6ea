"""Photographs in, a calibrated capture out: the stages in order, each kept when it is finished.

CAPTURE/work/ holds what the stages leave: upright copies of the photographs, features.db, matches.db, cameras.json
(cameras at the size of the photographs, checks), cameras.npz (points), stages.json (what is finished, and from which
inputs).
"""

import hashlib
import json
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from catacaustics.capture import sfm
from catacaustics.capture.checks import CameraCheck, Change, reflector_overlaps, repair
from catacaustics.capture.colmap import ColmapCamera, ColmapImage, ColmapModel
from catacaustics.capture.dataset import Capture, default_split, open_capture, write_capture
from catacaustics.capture.importers import import_capture, importable
from catacaustics.capture.report import write_report
from catacaustics.capture.undistort import find_masks, undistort_views
from catacaustics.capture.view_graph import believable_pairs, cycle_score, search_focal, strongest
from catacaustics.config import CalibrateConfig
from catacaustics.errors import UserError
from catacaustics.files import atomic_path, read_json, write_json
from catacaustics.points import write_ply

ERRORS, HYPOTHESES = (3.0, 2.0), 2
"""Relative poses looked for in each pair: two at each inlier threshold in pixels. More than one, because the loops tell
right from wrong later, and a right one that is missing breaks the chain. Where there is none at the wider threshold,
there is none at the narrower one."""

TIED_SHARE = 0.9
"""Share of the photographs that loops should tie together; below it, other focal lengths are tried too."""


class Stages:
    """Which stages are finished, and from which inputs (CAPTURE/work/stages.json)."""

    def __init__(self, work: Path):
        self.work, self.path = work, work / "stages.json"
        self.record: dict[str, Any] = read_json(self.path) if self.path.is_file() else {}

    def run(self, name: str, inputs: Any, outputs: list[Path], job: Callable[[], str]) -> str:
        """Run a stage unless it is finished for these inputs; say which, with its figures and time.

        What an interrupted run of the same inputs left is kept for the job to go on with; what other inputs left is
        removed.

        Args:
            inputs: anything that JSON can hold.
            outputs: files and folders the stage makes.
            job: does the work and returns its figures in words.

        Returns:
            A key of the inputs, for the stages that depend on this one.
        """
        key = hashlib.sha256(json.dumps(inputs).encode()).hexdigest()
        old = self.record.get(name, {})
        if old.get("key") == key and old.get("finished") and all(p.exists() for p in outputs):
            print(f"{name}: finished before, kept ({old['figures']})", flush=True)
            return key
        if old.get("key") != key:
            for path in outputs:
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        self.record[name] = {"key": key, "finished": False}
        write_json(self.path, self.record)
        start = time.monotonic()
        figures = job()
        seconds = round(time.monotonic() - start, 1)
        self.record[name] = {"key": key, "finished": True, "figures": figures, "seconds": seconds}
        write_json(self.path, self.record)
        print(f"{name}: {figures} ({seconds} s)", flush=True)
        return key


@dataclass(frozen=True, eq=False)
class _Solution:
    """What mapping and its checks found."""

    model: ColmapModel
    checks: list[CameraCheck]
    changes: list[Change]


def calibrate(config: CalibrateConfig) -> Capture:
    """Calibrate photographs; a COLMAP workspace or transforms.json is taken over instead. See the module's notes.

    Raises:
        UserError: no or unreadable photographs, masks that do not fit, or too few photographs that overlap. What is
            finished is kept, and another call goes on from there.
    """
    root = Path(config.capture)
    stages = Stages(root / "work")
    if importable(config.photos):
        capture = import_capture(config.photos, root, config.masks, config.max_size, config.held_out_every)
        _fuse(capture, config, stages, ["imported", *_stamps([root / "sparse/0/images.bin", root / "split.json"])])
        return open_capture(root)
    photos, key = _find_features(config, stages)
    work = stages.work

    def match() -> str:
        _copy_once(work / "features.db", work / "matches.db")
        features = sfm.read_features(work / "features.db")
        pairs = sfm.choose_pairs(features)
        sfm.match(work / "matches.db", pairs, work / "pairs.txt")
        found = sfm.read_matches(work / "matches.db", features)
        return f"{len(pairs)} pairs compared, {len(found)} with {sfm.MIN_INLIERS} matches or more"

    key = stages.run("matches", [key], [work / "matches.db"], match)

    def solve() -> str:
        solution = _solve_cameras(photos, config, work)
        _write_solution(work, solution)
        moved = [f"{sum(c.action == a for c in solution.changes)} {a}" for a in ("moved", "added", "dropped")]
        return f"{len(solution.model.images)} of {len(photos)} photographs placed; by checks {', '.join(moved)}"

    key = stages.run("cameras", [key, config.camera_model], [work / "cameras.npz", work / "cameras.json"], solve)
    solution = _read_solution(work)
    views = undistort_views(
        solution.model, {p.name: p.path for p in photos}, config.masks, root, config.max_size, upright=True
    )
    split = default_split([v.name for v in views], config.held_out_every)
    write_capture(root, views, split, solution.model.points, solution.model.colors)
    capture = open_capture(root)
    write_report(root, capture, [p.name for p in photos], solution.checks, solution.changes, solution.model.points)
    # The cameras themselves, not what they were made from: points never outlive cameras that were solved anew.
    cameras = hashlib.sha256((root / "sparse/0/images.bin").read_bytes()).hexdigest()
    _fuse(capture, config, stages, [cameras, config.held_out_every, config.max_size], solution.model.points)
    print(f"capture: {root} with {len(capture.views)} views; see {root / 'report.html'}", flush=True)
    return capture


def _stamps(paths: list[Path]) -> list[list[Any]]:
    """Name, size and time of change of files: what a finished stage depends on."""
    return [[str(p), p.stat().st_size, p.stat().st_mtime_ns] for p in paths]


def _copy_once(source: Path, target: Path) -> None:
    """Copy a file whole, unless it was copied before."""
    if not target.exists():
        temporary = target.with_suffix(".part")
        shutil.copyfile(source, temporary)
        temporary.replace(target)


def _find_features(config: CalibrateConfig, stages: Stages) -> tuple[list[sfm.Photo], str]:
    """The photographs, and the key of the features stage."""
    work = stages.work
    paths = sfm.list_photos(config.photos)
    names = [p.relative_to(config.photos).as_posix() for p in paths]
    masks: dict[int, list[Path]] = {}
    for files in find_masks(config.masks, names).values() if config.masks is not None else []:
        for name, path in files.items():
            masks.setdefault(names.index(name), []).append(path)
    table = work / "photos.json"

    def find() -> str:
        photos, level = sfm.prepare_photos(config.photos, masks, work / "photos", work / "masks", config.max_size)
        sfm.extract(
            photos, work / "photos", work / "masks" if masks else None, work / "features.db", config.camera_model
        )
        counts = [len(k) for k in sfm.read_features(work / "features.db").keypoints]
        write_json(table, [asdict(p) | {"path": str(p.path)} for p in photos])
        dark = f", brightened (median gray level {level:.2f})" if level < sfm.DARK else ""
        masked = f", reflectors masked in {len(masks)}" if masks else ""
        return f"{len(photos)} photographs, {int(np.median(counts))} features each (median){dark}{masked}"

    inputs = [
        _stamps(paths),
        _stamps(sorted(m for files in masks.values() for m in files)),
        config.max_size,
        config.camera_model,
        [sfm.MAX_FEATURES, sfm.PEAK_THRESHOLD, sfm.DARK, sfm.GAMMA],
    ]
    outputs = [table, work / "photos", work / "masks", work / "features.db"]
    key = stages.run("features", inputs, outputs if masks else outputs[:2] + outputs[3:], find)
    return [sfm.Photo(**{**p, "path": Path(p["path"])}) for p in read_json(table)], key


def _solve_cameras(photos: list[sfm.Photo], config: CalibrateConfig, work: Path) -> _Solution:
    """Relative poses, their cycle consistency, mapping, checks and repair."""
    database, copies = work / "matches.db", work / "photos"
    features = sfm.read_features(database)
    matches = sfm.read_matches(database, features)
    if not matches:
        raise _no_overlap(len(photos))

    def cameras(factor: float) -> list[Any]:
        return [sfm.initial_camera(p, config.camera_model, factor) for p in photos]

    factors = [1.2]
    if any(p.focal is None for p in photos):
        best_pairs = strongest(matches)
        factor, clear = search_focal(
            lambda f: cycle_score(sfm.relative_poses(features, best_pairs, cameras(f), trials=1000))
        )
        how = "from closed loops of photographs" if clear else "assumed: loops of photographs do not show it"
        print(f"  focal length: {factor:.2f} times the longer side, {how}", flush=True)
        # The search is rough: where loops do not tie nearly all photographs together, a little to either side may.
        factors = [factor, factor * 1.047, factor * 0.955]
    factor, pairs = factors[0], _pairs_in_loops(features, matches, cameras(factors[0]), len(photos))
    for other in factors[1:]:
        if len(_tied(pairs)) >= TIED_SHARE * len(photos):
            break
        found = _pairs_in_loops(features, matches, cameras(other), len(photos))
        if len(_tied(found)) > len(_tied(pairs)):
            factor, pairs = other, found
    model = _map(database, copies, work, features, cameras(factor), pairs)
    if model is None:
        raise _no_overlap(len(photos))
    print(f"  mapping: {model.num_reg_images()} of {len(photos)} photographs", flush=True)
    model, checks, changes = repair(
        model,
        lambda cams, poses: sfm.rebuild(cams, poses, features, matches, database, copies),
        features,
        matches,
    )
    if model is None:
        raise _too_few(sum(c.good for c in checks), len(photos))
    if config.masks is not None:
        model, checks, changes = _check_silhouettes(model, checks, changes, photos, config, features, matches, work)
    for change in changes:
        print(f"  {photos[change.index].name} {change.action}: {change.reason}", flush=True)
    return _Solution(_full_size(model, photos, features, copies), checks, changes)


def _pairs_in_loops(
    features: sfm.Features, matches: dict[tuple[int, int], np.ndarray], cameras: list[Any], count: int
) -> list[sfm.RelativePose]:
    """Relative poses of all pairs, as far as loops of photographs believe them."""
    from tqdm import tqdm

    edges, left = [], matches
    with tqdm(total=len(matches) * len(ERRORS), desc="relative poses", unit="pair") as progress:
        for error in ERRORS:
            progress.update(len(matches) - len(left))
            found = sfm.relative_poses(features, left, cameras, error, 3000, HYPOTHESES, progress.update)
            edges = found + edges
            left = {(e.first, e.second): matches[e.first, e.second] for e in found}
    pairs = believable_pairs(edges, count)
    print(
        f"  pairs: {len({(e.first, e.second) for e in edges})} with a common geometry, {len(pairs)} of them in loops "
        f"that tie {len(_tied(pairs))} photographs together",
        flush=True,
    )
    return pairs


def _tied(pairs: list[sfm.RelativePose]) -> set[int]:
    """Photographs that the pairs hold together."""
    return {i for e in pairs for i in (e.first, e.second)}


def _no_overlap(count: int) -> UserError:
    return UserError(
        f"None of the {count} photographs could be placed: no two show enough of the same things from two places.",
        "photographs that overlap: each part of the scene in 3 or more, from places 5 to 20 degrees apart",
        "take photographs in between, sharp ones, with textured things in sight; features and matches found are kept",
    )


def _too_few(placed: int, count: int) -> UserError:
    return UserError(
        f"Only {placed} of {count} photographs could be placed and stood up to the checks.",
        "at least 3 photographs of a scene, each overlapping the next",
        "take photographs in between; mask large reflectors with --masks; features and matches found are kept",
    )


def _map(
    database: Path, copies: Path, work: Path, features: sfm.Features, cameras: list[Any], pairs: list[sfm.RelativePose]
) -> Any | None:
    """Incremental mapping; where it leaves photographs of the pair graph out, global mapping if that places more."""
    mapping = work / "mapping.db"
    sfm.write_pairs_database(database, mapping, features, cameras, pairs)
    model = sfm.map_incrementally(mapping, copies, work / "mapping")
    reachable = len({i for e in pairs for i in (e.first, e.second)})
    if len(pairs) >= 3 and (model is None or model.num_reg_images() < reachable):
        other = sfm.map_globally(mapping, copies, work / "mapping")
        if other is not None and (model is None or other.num_reg_images() > model.num_reg_images()):
            model = other
    mapping.unlink(missing_ok=True)
    shutil.rmtree(work / "mapping", ignore_errors=True)
    return model


def _check_silhouettes(
    model: Any,
    checks: list[CameraCheck],
    changes: list[Change],
    photos: list[sfm.Photo],
    config: CalibrateConfig,
    features: sfm.Features,
    matches: dict[tuple[int, int], np.ndarray],
    work: Path,
) -> tuple[Any, list[CameraCheck], list[Change]]:
    """Compare painted masks between views and drop the cameras whose masks disagree."""
    names = [p.name for p in photos]
    found = find_masks(config.masks, names) if config.masks is not None else {}
    masks = {r: {names.index(n): path for n, path in files.items()} for r, files in found.items()}
    checks, disagreeing = reflector_overlaps(model, features, masks, checks)
    if not disagreeing:
        return model, checks, changes
    poses = sfm.registered(model, features)
    for change in disagreeing:
        poses.pop(change.index)
    if len(poses) < 3:
        raise _too_few(len(poses), len(photos))
    model = sfm.rebuild(dict(model.cameras), poses, features, matches, work / "matches.db", work / "photos")
    return model, checks, [*changes, *disagreeing]


def _full_size(model: Any, photos: list[sfm.Photo], features: sfm.Features, copies: Path) -> ColmapModel:
    """The model with cameras at the size of the photographs, in the order of the photographs."""
    model.extract_colors_for_all_images(copies)
    poses = sfm.registered(model, features)
    cameras, images = {}, []
    for index, pose in poses.items():
        photo, camera_id = photos[index], features.camera_ids[index]
        camera = model.cameras[camera_id]
        if camera_id not in cameras:
            camera.rescale(photo.width, photo.height)
            cameras[camera_id] = ColmapCamera(camera.model_name, photo.width, photo.height, np.array(camera.params))
        images.append(ColmapImage(photo.name, camera_id, pose))
    points = [p for p in model.points3D.values() if p.track.length() >= 3]
    return ColmapModel(
        cameras,
        images,
        np.array([p.xyz for p in points]).reshape(-1, 3),
        np.array([p.color for p in points]).reshape(-1, 3) / 255,
    )


def _write_solution(work: Path, solution: _Solution) -> None:
    model = solution.model
    write_json(
        work / "cameras.json",
        {
            "cameras": {i: [c.model, c.width, c.height, c.params.tolist()] for i, c in model.cameras.items()},
            "images": [[i.name, i.camera_id, i.camera_from_world.tolist()] for i in model.images],
            "checks": [asdict(c) for c in solution.checks],
            "changes": [asdict(c) for c in solution.changes],
        },
    )
    with atomic_path(work / "cameras.npz") as path:
        np.savez(path, points=model.points, colors=model.colors)


def _read_solution(work: Path) -> _Solution:
    table, arrays = read_json(work / "cameras.json"), np.load(work / "cameras.npz", allow_pickle=False)
    cameras = {int(i): ColmapCamera(m, w, h, np.array(p)) for i, (m, w, h, p) in table["cameras"].items()}
    images = [ColmapImage(name, camera, np.array(pose)) for name, camera, pose in table["images"]]
    model = ColmapModel(cameras, images, arrays["points"], arrays["colors"])
    checks = [CameraCheck(**c) for c in table["checks"]]
    return _Solution(model, checks, [Change(**c) for c in table["changes"]])


def _fuse(
    capture: Capture, config: CalibrateConfig, stages: Stages, inputs: list[Any], points: np.ndarray | None = None
) -> None:
    """Multi-view stereo into points.ply and guesses.ply."""

    def fuse() -> str:
        from catacaustics.capture.stereo import fuse_capture

        cloud, guesses = fuse_capture(capture, config.stereo_size, points)
        write_ply(files[0], cloud)
        write_ply(files[1], guesses)
        return f"{len(cloud)} points with normals, and {len(guesses)} guesses where there are none"

    files = [capture.root / "points.ply", capture.root / "guesses.ply"]
    stages.run("points", [inputs, config.stereo_size], files, fuse)
