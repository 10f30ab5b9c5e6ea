"""Multi-view stereo: a capture's training photographs to one fused cloud with normals.

Depth and normal maps come from COLMAP's PatchMatch where pycolmap has CUDA, and from `plane_sweep` elsewhere; either
way COLMAP fuses them (`fusion`). The work lies in work/stereo/KEY below the capture, KEY being a digest of everything
that the maps depend on: an interrupted run goes on where it stopped, and stale maps are never used. Photographs are
read when needed and only a few are kept, so memory does not grow with their number.
"""

import hashlib
import json
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from catacaustics.cameras import Camera, pixel_centers
from catacaustics.capture.dataset import Capture, View
from catacaustics.capture.fusion import (
    fill_holes,
    fuse_maps,
    import_pycolmap,
    in_frame,
    look_up,
    map_paths,
    read_map,
    remove_contradicted,
    remove_outliers,
    write_map,
    write_overlap_model,
)
from catacaustics.capture.plane_sweep import DepthEstimate, GrayView, SweepConfig, estimate_depth
from catacaustics.errors import UserError
from catacaustics.geometry import normalize
from catacaustics.images import resize, write_image
from catacaustics.points import PointCloud
from catacaustics.shapes import Bool, Float

_VERSION = 1
"""Raise when the maps change for the same settings: old ones are then made again."""

NEIGHBORS = 6
"""Views that each view is matched with."""

COARSE_SIZE = 160
"""Longer side in pixels at which depth ranges are searched where there are no sparse points."""

MIN_VIEWS = 3
"""Views that must agree on a fused point, in captures that have as many."""

MAX_DEPTH_ERROR = 0.01
"""Relative difference of depth within which views agree."""

MAX_NORMAL_ERROR = 40.0
"""Angle in degrees within which views agree."""

SAME_COLOR = 0.06
"""Mean absolute difference of RGB in [0, 1] up to which a guess has the colour that a view shows."""

MASK_MARGIN = 3
"""Pixels around a reflector that give no points either: their correlation windows reach into it."""


def fuse_capture(
    capture: Capture, max_size: int = 800, sparse_points: Float[np.ndarray, "n 3"] | None = None
) -> tuple[PointCloud, PointCloud]:
    """Dense points with normals and colours from a capture's training views, and guesses where there are none: what
    fewer views say than it takes to be sure. Reflector masks, where there are any, are left out: what is seen there is
    not where it seems.

    Args:
        max_size: longer side in pixels of the images that are matched.
        sparse_points: points from structure from motion. They give each view's neighbours and depth range; without
            them a quick search at low resolution does.

    Raises:
        UserError: fewer than two training views, no depth found, nothing left after fusion, or a library is missing.
    """
    pycolmap = import_pycolmap()
    if len(capture.train) < 2:
        raise UserError(
            f"{capture.root} has {len(capture.train)} training view.",
            "at least 2, and for a good cloud 20 or more, that overlap",
            "add photographs, or change split.json",
        )
    stereo = _Stereo(capture, max_size, sparse_points)
    points = stereo.find_points() if sparse_points is None or len(sparse_points) < 8 else np.asarray(sparse_points)
    if pycolmap.has_cuda:
        stereo.match_with_colmap(points)
        kind = "geometric"
    else:
        stereo.match(points)
        kind = "photometric"
    stereo.write_masks()
    min_views = min(MIN_VIEWS, len(capture.train))

    def fused(views: int) -> PointCloud:
        cloud = fuse_maps(stereo.folder, kind, views, MAX_DEPTH_ERROR, MAX_NORMAL_ERROR)
        return remove_outliers(remove_contradicted(cloud, stereo.folder, kind, stereo.named_cameras))

    cloud = fused(min_views)
    if not len(cloud):
        raise UserError(
            f"Multi-view stereo on {capture.root} left no points: no {min_views} views agree on any surface.",
            "photographs that overlap well (every part in 4 or more, 5 to 20 degrees apart) with textured surfaces",
            "take more photographs, or check the calibration and the masks (white = reflector, left out)",
        )
    filled = cloud
    for views in range(min_views - 1, 0, -1):
        filled = fill_holes(filled, fused(views))
    guesses = filled.select(np.arange(len(cloud), len(filled)))
    return cloud, guesses.select(stereo.colors_agree(guesses, kind))


class _Stereo:
    """The state of one run: views at the size of the maps, their folder, and the workers."""

    def __init__(self, capture: Capture, max_size: int, sparse_points: np.ndarray | None):
        self.capture, self.views = capture, capture.train
        self.cameras = [_reduced(view.camera, max_size) for view in self.views]
        self.named_cameras = [(view.name, camera) for view, camera in zip(self.views, self.cameras, strict=True)]
        self.config = SweepConfig()
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.folder = capture.root / "work" / "stereo" / self._key(sparse_points)
        for old in self.folder.parent.glob("*"):
            if old != self.folder:
                shutil.rmtree(old, ignore_errors=True)
        # Neighbours in the list are often neighbours in space: this many are enough to read most photographs once.
        self.gray = lru_cache(maxsize=24)(self._gray)

    def _key(self, sparse_points: np.ndarray | None) -> str:
        parameters = [_VERSION, asdict(self.config), NEIGHBORS, COARSE_SIZE]
        digest = hashlib.sha256(json.dumps(parameters).encode())
        for view, camera in zip(self.views, self.cameras, strict=True):
            digest.update(view.name.encode())
            digest.update(camera.intrinsics.tobytes() + camera.camera_from_world.tobytes())
            digest.update((self.capture.root / "images" / view.name).read_bytes())
        digest.update(b"" if sparse_points is None else np.ascontiguousarray(sparse_points, np.float64).tobytes())
        return digest.hexdigest()[:16]

    def _gray(self, index: int, size: int) -> GrayView:
        camera = _reduced(self.views[index].camera, size)
        image = resize(self.capture.image(self.views[index]), camera.width, camera.height)
        pixels = image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32) / 255
        return GrayView(torch.from_numpy(pixels).to(self.device), camera)

    def _run(self, title: str, task: Callable[[int], None], todo: list[int]) -> None:
        """Run a task on views in threads of one core each: the arrays are too small to share among cores."""
        threads = torch.get_num_threads()
        workers = 1 if self.device.type == "cuda" else max(1, min(threads, 8))

        def start() -> None:
            torch.set_num_threads(1)
            torch.set_flush_denormal(True)

        def run(index: int) -> None:
            with torch.inference_mode():
                task(index)

        pool = ThreadPoolExecutor(workers, initializer=start)
        try:
            jobs = [pool.submit(run, index) for index in todo]
            done = len(self.views) - len(todo)
            for job in tqdm(as_completed(jobs), title, total=len(self.views), initial=done, unit="view"):
                job.result()
        finally:
            pool.shutdown(cancel_futures=True)
            torch.set_num_threads(threads)

    def _estimate(
        self, index: int, neighbors: list[int], inverse_range: tuple[float, float], size: int, refine: bool
    ) -> DepthEstimate:
        others = [self.gray(other, size) for other in neighbors]
        return estimate_depth(self.gray(index, size), others, inverse_range, self.config, refine)

    def _coarse_path(self, index: int) -> Path:
        return self.folder / "coarse" / f"{self.views[index].name}.bin"

    def find_points(self, per_view: int = 400) -> Float[np.ndarray, "n 3"]:
        """Points for neighbours and ranges: a sweep at low resolution over all depths that the cameras allow."""
        cameras = [_reduced(camera, COARSE_SIZE) for camera in self.cameras]
        guesses = [_guess(cameras, index) for index in range(len(cameras))]
        todo = [i for i in range(len(cameras)) if not self._coarse_path(i).is_file()]

        def task(index: int) -> None:
            neighbors, inverse_range = guesses[index]
            estimate = self._estimate(index, neighbors, inverse_range, COARSE_SIZE, refine=False)
            write_map(self._coarse_path(index), estimate.depth)

        self._run("depth ranges", task, todo)
        coarse = lru_cache(maxsize=24)(lambda index: read_map(self._coarse_path(index)))
        found = []
        random = np.random.default_rng(0)
        for index, camera in enumerate(cameras):
            depth = coarse(index)
            rows, columns = np.nonzero(depth)
            points = camera.unproject(np.stack([columns, rows], -1) + 0.5, depth[rows, columns])
            neighbors = guesses[index][0]
            agree = sum(_agrees(points, cameras[other], coarse(other)) for other in neighbors)
            points = points[agree >= min(2, len(neighbors))]
            found.append(points[random.permutation(len(points))[:per_view]])
        points = np.concatenate(found)
        if len(points) < 8:
            raise self._no_depth()
        return points

    def _no_depth(self) -> UserError:
        return UserError(
            f"No depth was found in any of the {len(self.views)} training views of {self.capture.root}.",
            "sharp photographs that overlap, of textured surfaces, with correct cameras",
            "check the calibration, and that neighbouring photographs show the same things",
        )

    def match(self, points: Float[np.ndarray, "n 3"]) -> None:
        """Depth and normal maps of all views by plane sweep; finished ones are kept."""
        neighbors = choose_neighbors(self.cameras, _sample(points, 3000))
        self._prepare(points)

        def task(index: int) -> None:
            depth_path, normal_path = map_paths(self.folder, self.views[index].name)
            inverse_range = depth_range(self.cameras[index], points)
            if inverse_range is None or not neighbors[index]:
                camera = self.cameras[index]
                estimate = DepthEstimate(*(np.zeros((camera.height, camera.width, *c)) for c in ((), (3,), ())))
            else:
                size = max(self.cameras[index].width, self.cameras[index].height)
                estimate = self._estimate(index, neighbors[index], inverse_range, size, refine=True)
            # The depth map comes last: where it is, the view is finished.
            write_map(normal_path, estimate.normals)
            write_map(depth_path, estimate.depth)

        paths = [map_paths(self.folder, view.name)[0] for view in self.views]
        self._run("depth maps", task, [i for i, path in enumerate(paths) if not path.is_file()])
        if not any(read_map(path).any() for path in paths):
            raise self._no_depth()

    def match_with_colmap(self, points: Float[np.ndarray, "n 3"]) -> None:
        """Depth and normal maps of all views by COLMAP's PatchMatch; COLMAP keeps finished ones."""
        pycolmap = import_pycolmap()
        self._prepare(points)
        for view in self.views:
            for path in map_paths(self.folder, view.name):
                path.parent.mkdir(parents=True, exist_ok=True)
        options = pycolmap.PatchMatchOptions()
        options.geom_consistency = True
        pycolmap.patch_match_stereo(self.folder, options=options)

    def _prepare(self, points: Float[np.ndarray, "n 3"]) -> None:
        """Write the workspace's photographs and model."""
        write_overlap_model(self.folder, self.named_cameras, _sample(points, 3000))
        for view, camera in zip(self.views, self.cameras, strict=True):
            path = self.folder / "images" / view.name
            if not path.is_file():
                write_image(path, resize(self.capture.image(view), camera.width, camera.height))

    def colors_agree(self, cloud: PointCloud, kind: str) -> Bool[np.ndarray, "n"]:
        """Whether the views that could see a point show its colour there: 3 at least, and most of them. A point that
        floats before something else is seen before other colours from elsewhere."""
        positions = cloud.positions.astype(np.float64)
        agree, seen = np.zeros((2, len(cloud)), int)
        for view, camera in zip(self.views, self.cameras, strict=True):
            small = _reduced(camera, COARSE_SIZE)
            image = resize(self.capture.image(view), small.width, small.height).astype(np.float32) / 255
            inside, pixels, depth = in_frame(small, positions)
            known = look_up(read_map(map_paths(self.folder, view.name, kind)[0]), camera, positions)[0]
            free = inside & ((known == 0) | (depth <= 1.03 * known))
            columns, rows = np.where(inside[:, None], pixels, 0).astype(int).T
            mask = self._reflectors(view, small)
            free &= True if mask is None else ~mask[rows, columns]
            seen += free
            agree += free & (np.abs(image[rows, columns] - cloud.colors).mean(1) < SAME_COLOR)
        return (agree >= 3) & (agree >= 0.6 * seen)

    def _reflectors(self, view: View, camera: Camera) -> Bool[np.ndarray, "height width"] | None:
        """Where a view shows reflectors, at a camera's size; None where it was not masked."""
        masks = [self.capture.mask(view, reflector) for reflector in self.capture.reflectors]
        masks = [resize(m.astype(np.float32), camera.width, camera.height) > 0 for m in masks if m is not None]
        return np.any(masks, 0) if masks else None

    def write_masks(self) -> None:
        """Write black where a reflector is, for the fusion; the maps themselves do not depend on the masks."""
        import cv2

        shutil.rmtree(self.folder / "masks", ignore_errors=True)
        kernel = np.ones((2 * MASK_MARGIN + 1,) * 2, np.uint8)
        for view, camera in zip(self.views, self.cameras, strict=True):
            mask = self._reflectors(view, camera)
            if mask is not None:
                covered = cv2.dilate(mask.astype(np.uint8), kernel)
                write_image(self.folder / "masks" / f"{view.name}.png", covered == 0)


def _reduced(camera: Camera, max_size: int) -> Camera:
    factor = min(1.0, max_size / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))


def _sample(points: np.ndarray, count: int) -> np.ndarray:
    return points if len(points) <= count else points[np.random.default_rng(0).permutation(len(points))[:count]]


def _agrees(points: np.ndarray, camera: Camera, depth_map: np.ndarray, tolerance: float = 0.04) -> np.ndarray:
    """Whether a view's depth map has the points on its surface, within a relative tolerance."""
    seen, depth = look_up(depth_map, camera, points)
    return (seen > 0) & (np.abs(seen - depth) < tolerance * depth)


def _angle_weight(angle: np.ndarray) -> np.ndarray:
    """Worth of a pair by the angle between its lines of sight, in degrees: small ones give poor depth, large ones look
    different (after Yao et al., MVSNet, ECCV 2018)."""
    return np.exp(-0.5 * ((angle - 12) / np.where(angle < 12, 5, 12)) ** 2)


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles in degrees between unit vectors."""
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def _pick(worth: np.ndarray, directions: np.ndarray, count: int) -> list[int]:
    """The best views, one after another, so that every point is seen by some.

    Args:
        worth: (views, points), how well a view serves a point. A point that is served already counts for less.
        directions: (views, 3), unit vectors from the scene. A view in about the direction of one already picked, too.
    """
    need = np.ones(worth.shape[1])
    spread = np.ones(len(worth))
    picked: list[int] = []
    while len(picked) < count:
        scores = (worth * need).mean(1) * spread
        best = int(scores.argmax())
        if scores[best] <= 1e-4:
            break
        picked.append(best)
        need *= 1 - 0.6 * worth[best]
        spread *= np.minimum(1, _angles(directions, directions[best]) / 5)
        spread[best] = 0
    return picked


def choose_neighbors(
    cameras: Sequence[Camera], points: Float[np.ndarray, "n 3"], count: int = NEIGHBORS
) -> list[list[int]]:
    """For each view the views to match it with, best first: they see the same points at useful angles.

    Occlusion is not known here; that is why several are chosen and only the best count in each pixel.
    """
    centers = np.stack([camera.center for camera in cameras])
    seen = np.stack([in_frame(camera, points)[0] for camera in cameras])
    chosen = []
    for index in range(len(cameras)):
        visible = points[seen[index]]
        if not len(visible):
            chosen.append([])
            continue
        sight = normalize(visible[None] - centers[:, None])
        distance = np.linalg.norm(visible[None] - centers[:, None], axis=-1)
        ratio = np.minimum(distance, distance[index]) / np.maximum(np.maximum(distance, distance[index]), 1e-12)
        worth = _angle_weight(_angles(sight, sight[index])) * ratio * seen[:, seen[index]]
        worth[index] = 0
        chosen.append(_pick(worth, normalize(np.median(visible, 0) - centers), count))
    return chosen


def depth_range(camera: Camera, points: Float[np.ndarray, "n 3"]) -> tuple[float, float] | None:
    """Smallest and largest inverse depth that a view is searched over, from points that may have outliers and gaps.

    None where hardly any point is in the frame.
    """
    inside, _, depth = in_frame(camera, points)
    if inside.sum() < 8:
        return None
    low, high = np.percentile(1 / depth[inside], [0.5, 99.5])
    return float(low * 0.7), float(high * 1.25)


def _guess(cameras: list[Camera], index: int) -> tuple[list[int], tuple[float, float]]:
    """Neighbours and range of inverse depth of a view from the cameras alone.

    Points are placed along the view's rays at many depths. A depth at which several other views see them at useful
    angles is likely to be in the scene: that is what the photographs were taken of.
    """
    camera = cameras[index]
    centers = np.stack([c.center for c in cameras])
    gaps = np.linalg.norm(centers[:, None] - centers, axis=-1)
    gaps[gaps <= 1e-9 * gaps.max()] = np.inf
    if np.isinf(gaps).all():
        raise UserError(
            "All training views were taken from the same place.",
            "photographs from different places: depth comes from parallax",
            "walk around the scene while taking photographs",
        )
    spacing = np.median(gaps.min(1))
    depths = spacing * np.geomspace(0.3, 100, 48)
    grid = pixel_centers(camera.viewport)[:: max(1, camera.height // 5), :: max(1, camera.width // 5)].reshape(-1, 2)
    points = camera.unproject(np.tile(grid, (len(depths), 1)), np.repeat(depths, len(grid)))
    sight = normalize(points[None] - centers[:, None])
    seen = np.stack([in_frame(other, points)[0] for other in cameras])
    worth = (_angle_weight(_angles(sight, sight[index])) * seen).reshape(len(cameras), len(depths), -1)
    worth[index] = 0
    support = np.sort(worth.mean(-1), 0)[-NEIGHBORS:].sum(0)
    likely = support / max(support.max(), 1e-12)
    middle_depth = np.exp(np.average(np.log(depths), weights=likely + 1e-9))
    middle = camera.unproject(grid.mean(0), np.asarray(middle_depth))
    neighbors = _pick((worth * likely[:, None]).reshape(len(cameras), -1), normalize(middle - centers), NEIGHBORS)
    if not neighbors:
        neighbors = np.argsort(gaps[index])[: min(NEIGHBORS, len(cameras) - 1)].tolist()
    near = depths[np.argmax(likely > 0.15)]
    # In inverse depth the far end costs little: it goes out to where the likely depths cannot be told from infinity.
    return neighbors, (float(0.01 / near), float(1 / near))
