"""Structure from motion with pycolmap: features, matching, relative poses, mapping.

The database names photographs by their index in the list, 00000.jpg, 00001.jpg ..., so that any file name works.
Which pairs may be believed is decided in `view_graph`, which cameras in `checks`.
"""

import shutil
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from catacaustics.capture.fusion import import_pycolmap
from catacaustics.errors import UserError
from catacaustics.files import write_bytes, write_text
from catacaustics.images import encode_image, list_images, read_image_bytes, read_mask, resize
from catacaustics.shapes import Float, Int

MAX_FEATURES = 6000
PEAK_THRESHOLD = 0.003
"""Half of COLMAP's: shiny scenes are often dark and plain, and weak features still match (measured: 25 % more correct
pairs on a dark indoor capture)."""

DARK = 0.3
"""Photographs whose median gray level, over all photographs, is below this are brightened by `GAMMA` for features."""
GAMMA = 0.5

EXHAUSTIVE_LIMIT = 80
"""Up to so many photographs every pair is matched; beyond it neighbours in name order and look-alikes."""
SEQUENTIAL_NEIGHBORS = 8
RETRIEVED = 24

MIN_INLIERS = 15


@dataclass(frozen=True)
class Photo:
    """A photograph to calibrate.

    Args:
        name: path below the folder of photographs.
        path: the file.
        width, height: size in pixels, upright.
        scale: size of the copy that features are found in, divided by the photograph's.
        focal: focal length from EXIF in pixels of the copy, or None.
    """

    name: str
    path: Path
    width: int
    height: int
    scale: float
    focal: float | None

    @property
    def reduced(self) -> tuple[int, int]:
        """Width and height of the copy that features are found in."""
        return max(round(self.width * self.scale), 1), max(round(self.height * self.scale), 1)


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Verified geometry of a pair of photographs.

    Args:
        first, second: indices of the photographs, first < second.
        rotation: second_from_first.
        direction: unit translation of second_from_first, zero where the cameras only turned.
        matches: rows of feature indices (in first, in second) that agree with it.
    """

    first: int
    second: int
    rotation: Float[np.ndarray, "3 3"]
    direction: Float[np.ndarray, "3"]
    matches: Int[np.ndarray, "n 2"]


def load_pycolmap() -> Any:
    """pycolmap with its own log silent: what goes wrong comes as exceptions."""
    pycolmap = import_pycolmap()
    pycolmap.logging.minloglevel = 3
    pycolmap.logging.stderrthreshold = 3
    pycolmap.logging.alsologtostderr = False
    return pycolmap


def copy_name(index: int) -> str:
    """Name of a photograph's copy, and of its row in the database."""
    return f"{index:05d}.jpg"


def list_photos(folder: Path) -> list[Path]:
    """The photographs in a folder.

    Raises:
        UserError: the folder is missing or holds none.
    """
    folder = Path(folder)
    paths = list_images(folder) if folder.is_dir() else []
    if not paths:
        raise UserError(
            f"{folder} {'holds no photographs' if folder.is_dir() else 'is not a folder'}.",
            "a folder of photographs (.jpg, .jpeg, .png, .tif, .tiff, .bmp, .webp)",
            "check the path",
        )
    if len(paths) < 3:
        raise UserError(
            f"{folder} holds only {len(paths)} photograph{'s' if len(paths) > 1 else ''}.",
            "at least 3 photographs that overlap; 30 to 100 from all around work well",
            "take more photographs, or check the path",
        )
    return paths


def _exif_focal(path: Path, width: int, height: int) -> float | None:
    """Focal length in pixels from EXIF, by COLMAP's reader and table of sensors."""
    try:
        camera = load_pycolmap().infer_camera_from_image(path)
    except (ValueError, RuntimeError):
        return None
    longer = max(camera.width, camera.height)
    return camera.focal_length * max(width, height) / longer if camera.has_prior_focal_length else None


def prepare_photos(
    folder: Path, masks: dict[int, list[Path]], copies: Path, mask_copies: Path, max_size: int
) -> tuple[list[Photo], float]:
    """Write upright, reduced, where dark brightened copies of the photographs, and masks of where features may be.

    Dark means: the median over photographs of their median gray level is below `DARK`. Then every copy is brightened
    with gamma `GAMMA`. The reflectors' masks are grown by 1 % of the longer side, because a feature on a reflector's
    outline moves with the camera too.

    Args:
        masks: reflector mask files by index of photograph; white = reflector.

    Returns:
        The photographs and their median gray level in [0, 1].

    Raises:
        UserError: a photograph cannot be read, or a mask is of another size.
    """
    from tqdm import tqdm

    photos, levels = [], []
    paths = list_photos(folder)
    for index, path in enumerate(tqdm(paths, "read photographs", unit="photo")):
        image = read_image_bytes(path)
        height, width = image.shape[:2]
        scale = min(1.0, max_size / max(width, height))
        focal = _exif_focal(path, width, height)
        photo = Photo(
            path.relative_to(folder).as_posix(), path, width, height, scale, None if focal is None else focal * scale
        )
        small = resize(image, *photo.reduced)
        levels.append(np.median(small[::4, ::4] @ np.array([0.299, 0.587, 0.114])) / 255)
        write_bytes(copies / copy_name(index), encode_image(small, ".jpg", 97))
        if any(masks.values()):
            allowed = _feature_mask(photo, masks.get(index, []))
            write_bytes(mask_copies / f"{copy_name(index)}.png", encode_image(allowed, ".png"))
        photos.append(photo)
    level = float(np.median(levels))
    if level < DARK:
        table = (255 * (np.arange(256) / 255) ** GAMMA + 0.5).astype(np.uint8)
        for index in range(len(photos)):
            path = copies / copy_name(index)
            write_bytes(path, encode_image(table[read_image_bytes(path)], ".jpg", 97))
    return photos, level


def _feature_mask(photo: Photo, masks: list[Path]) -> np.ndarray:
    """True where features may be found."""
    import cv2

    width, height = photo.reduced
    forbidden = np.zeros((height, width), np.uint8)
    for path in masks:
        mask = read_mask(path)
        if mask.shape != (photo.height, photo.width):
            raise UserError(
                f"The mask {path} has {mask.shape[1]} x {mask.shape[0]} pixels.",
                f"{photo.width} x {photo.height}, the size of the photograph {photo.name}",
                "paint masks on the photographs themselves, or resize them",
            )
        forbidden |= (resize(mask.astype(np.uint8) * 255, width, height) > 0).astype(np.uint8)
    grow = 2 * max(round(0.01 * max(width, height)), 1) + 1
    return cv2.dilate(forbidden, np.ones((grow, grow), np.uint8)) == 0


def extract(photos: list[Photo], copies: Path, mask_copies: Path | None, database: Path, camera_model: str) -> None:
    """SIFT features of all photographs into a database; photographs that are in it already are kept.

    Photographs of one size share a camera.
    """
    from tqdm import tqdm

    pycolmap = load_pycolmap()
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=num_threads())
    options.sift.max_num_features = MAX_FEATURES
    options.sift.peak_threshold = PEAK_THRESHOLD
    reader = pycolmap.ImageReaderOptions(camera_model=camera_model)
    if mask_copies is not None:
        reader.mask_path = mask_copies
    sizes: dict[tuple[int, int], list[int]] = {}
    for index, photo in enumerate(photos):
        sizes.setdefault((photo.width, photo.height), []).append(index)
    with tqdm(total=len(photos), desc="features", unit="photo") as progress:
        for members in sizes.values():
            reader.existing_camera_id = -1
            for start in range(0, len(members), 8):
                chunk = [copy_name(i) for i in members[start : start + 8]]
                pycolmap.extract_features(
                    database,
                    copies,
                    image_names=chunk,
                    camera_mode=pycolmap.CameraMode.SINGLE,
                    reader_options=reader,
                    extraction_options=options,
                )
                with pycolmap.Database.open(database) as db:
                    reader.existing_camera_id = db.read_image_with_name(chunk[0]).camera_id
                progress.update(len(chunk))


def num_threads() -> int:
    """Cores that this process may use."""
    import os

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True, eq=False)
class Features:
    """Features of all photographs, by index: pixel coordinates and 128-byte SIFT descriptors; and the identifiers
    of their images and cameras in the database."""

    keypoints: list[Float[np.ndarray, "_ 2"]]
    descriptors: list[np.ndarray]
    image_ids: list[int]
    camera_ids: list[int]


def read_features(database: Path) -> Features:
    """Read the features of a database, in the order of the photographs."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as db:
        images = sorted(db.read_all_images(), key=lambda i: i.name)
        keypoints = [np.asarray(db.read_keypoints(i.image_id))[:, :2].astype(float) for i in images]
        descriptors = [np.asarray(db.read_descriptors(i.image_id).data) for i in images]
        return Features(keypoints, descriptors, [i.image_id for i in images], [i.camera_id for i in images])


def global_descriptors(descriptors: list[np.ndarray], words: int = 32, seed: int = 0) -> Float[np.ndarray, "n d"]:
    """VLAD (Jegou et al., CVPR 2010) of RootSIFT: one unit vector a photograph; similar ones show the same place."""
    from scipy.cluster.vq import kmeans2, vq

    rng = np.random.default_rng(seed)
    samples = []
    for d in descriptors:
        chosen = d[rng.permutation(len(d))[:500]].astype(np.float32)
        samples.append(np.sqrt(chosen / np.maximum(chosen.sum(1, keepdims=True), 1)))
    pool = np.concatenate(samples)
    words = min(words, max(len(pool) // 10, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a word that no feature speaks does no harm
        pool = pool[rng.permutation(len(pool))[:20000]]
        centers, _ = kmeans2(pool, pool[:words].copy(), 10, minit="matrix")
    result = np.zeros((len(samples), words, pool.shape[1]), np.float32)
    for row, sample in zip(result, samples, strict=True):
        if len(sample):
            word = vq(sample, centers)[0]
            np.add.at(row, word, sample - centers[word])
    # Residuals are normalised by word, so that a repeated pattern (bursts) does not drown the rest.
    result /= np.maximum(np.linalg.norm(result, axis=2, keepdims=True), 1e-12)
    result = result.reshape(len(samples), -1)
    return result / np.maximum(np.linalg.norm(result, axis=1, keepdims=True), 1e-12)


def choose_pairs(features: Features) -> list[tuple[int, int]]:
    """Pairs of photographs to match: all, or beyond `EXHAUSTIVE_LIMIT` photographs each one's neighbours in name order
    and the `RETRIEVED` that look most alike."""
    n = len(features.keypoints)
    if n <= EXHAUSTIVE_LIMIT:
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    pairs = {(i, j) for i in range(n) for j in range(i + 1, min(i + SEQUENTIAL_NEIGHBORS + 1, n))}
    vectors = global_descriptors(features.descriptors)
    likeness = vectors @ vectors.T
    np.fill_diagonal(likeness, -np.inf)
    for i, order in enumerate(np.argsort(-likeness, axis=1)[:, :RETRIEVED]):
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in order}
    return sorted(pairs)


def match(database: Path, pairs: list[tuple[int, int]], list_file: Path) -> None:
    """Match features of the given pairs (mutual nearest neighbours, ratio test); matches in the database are kept."""
    from tqdm import tqdm

    pycolmap = load_pycolmap()
    options = pycolmap.FeatureMatchingOptions(
        use_gpu=False, num_threads=num_threads(), skip_geometric_verification=True
    )
    chunk = 60
    with tqdm(total=len(pairs), desc="matching", unit="pair") as progress:
        for start in range(0, len(pairs), chunk):
            part = pairs[start : start + chunk]
            write_text(list_file, "".join(f"{copy_name(i)} {copy_name(j)}\n" for i, j in part))
            pycolmap.match_image_pairs(
                database,
                matching_options=options,
                pairing_options=pycolmap.ImportedPairingOptions(match_list_path=list_file),
            )
            progress.update(len(part))


def read_matches(database: Path, features: Features) -> dict[tuple[int, int], np.ndarray]:
    """All matches by pair of photographs, at least `MIN_INLIERS` each."""
    pycolmap = load_pycolmap()
    index = {image_id: i for i, image_id in enumerate(features.image_ids)}
    result = {}
    with pycolmap.Database.open(database) as db:
        for pair_id, matches in zip(*db.read_all_matches(), strict=True):
            i, j = (index[k] for k in pycolmap.pair_id_to_image_pair(pair_id))
            matches = np.asarray(matches).astype(np.int64)
            if len(matches) >= MIN_INLIERS:
                result[min(i, j), max(i, j)] = matches if i < j else matches[:, ::-1]
    return result


def initial_camera(photo: Photo, camera_model: str, factor: float) -> Any:
    """A pycolmap camera of the copy's size, with the focal length from EXIF or else `factor` times the longer side."""
    width, height = photo.reduced
    return load_pycolmap().Camera.create_from_model_name(
        1, camera_model, photo.focal or factor * max(width, height), width, height
    )


def relative_poses(
    features: Features,
    matches: dict[tuple[int, int], np.ndarray],
    cameras: list[Any],
    max_error: float = 2.0,
    trials: int = 3000,
    hypotheses: int = 1,
    progress: Callable[[int], object] = lambda _: None,
) -> list[RelativePose]:
    """Calibrated geometry of pairs by RANSAC (essential matrix or homography), at least `MIN_INLIERS` inliers.

    Args:
        cameras: one pycolmap camera a photograph.
        max_error: inlier threshold in pixels.
        trials: most RANSAC trials a pair.
        hypotheses: how many relative poses to look for in a pair: each next one among the matches that do not agree
            with those before. Where repeated objects outvote the rest of a scene, the right one comes second.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True, min_num_inliers=MIN_INLIERS)
    options.ransac.max_error = max_error
    options.ransac.max_num_trials = trials
    options.ransac.random_seed = 0

    def estimate(pair: tuple[int, int]) -> list[RelativePose]:
        i, j = pair
        found: list[RelativePose] = []
        left = np.ascontiguousarray(matches[pair], np.uint32)
        for _ in range(hypotheses):
            geometry = pycolmap.estimate_calibrated_two_view_geometry(
                cameras[i], features.keypoints[i], cameras[j], features.keypoints[j], left, options
            )
            inliers = np.asarray(geometry.inlier_matches)
            if geometry.cam2_from_cam1 is None or len(inliers) < MIN_INLIERS:
                break
            translation = geometry.cam2_from_cam1.translation
            length = np.linalg.norm(translation)
            direction = translation / length if length > 1e-9 else np.zeros(3)
            found.append(
                RelativePose(i, j, geometry.cam2_from_cam1.rotation.matrix(), direction, inliers.astype(np.int64))
            )
            left = np.ascontiguousarray(left[~np.isin(left[:, 0], inliers[:, 0])])
            if len(left) < MIN_INLIERS:
                break
        progress(1)
        return found

    with ThreadPoolExecutor(num_threads()) as pool:
        return [pose for found in pool.map(estimate, matches) for pose in found]


def write_pairs_database(source: Path, target: Path, features: Features, cameras: list[Any], pairs: list) -> None:
    """A copy of a database whose verified pairs are `pairs` (RelativePose) and whose cameras are `cameras`."""
    pycolmap = load_pycolmap()
    target.unlink(missing_ok=True)
    shutil.copyfile(source, target)
    with pycolmap.Database.open(target) as db:
        db.clear_two_view_geometries()
        for camera_id, camera in dict(zip(features.camera_ids, cameras, strict=True)).items():
            stored = db.read_camera(camera_id)
            stored.params = camera.params
            stored.has_prior_focal_length = True
            db.update_camera(stored)
        for pose in pairs:
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = pose.matches.astype(np.uint32)
            geometry.cam2_from_cam1 = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation), pose.direction)
            db.write_two_view_geometry(features.image_ids[pose.first], features.image_ids[pose.second], geometry)


def map_incrementally(database: Path, copies: Path, folder: Path, seed: int = 0) -> Any | None:
    """Incremental mapping of the verified pairs; the model with most photographs, or None.

    Returns:
        A pycolmap Reconstruction; `folder` holds every model found.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=num_threads(), random_seed=seed, min_model_size=3, extract_colors=True, init_num_trials=200
    )
    options.mapper.num_threads = num_threads()
    options.mapper.abs_pose_min_num_inliers = MIN_INLIERS
    options.mapper.init_min_num_inliers = 50
    # Cameras 30 degrees apart share most points by twos only; without those points the chain breaks.
    options.triangulation.ignore_two_view_tracks = False
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    models = pycolmap.incremental_mapping(database, copies, folder, options)
    return _largest(models)


def _largest(models: dict[int, Any]) -> Any | None:
    return max(models.values(), key=lambda m: (m.num_reg_images(), m.num_points3D())) if models else None


def map_globally(database: Path, copies: Path, folder: Path, seed: int = 0) -> Any | None:
    """Global mapping (GLOMAP, Pan et al., ECCV 2024) of the verified pairs; the largest model, or None.

    It places all cameras at once, so a chain of cameras does not break where three of them share few points.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.GlobalPipelineOptions(num_threads=num_threads(), random_seed=seed, decompose_relative_pose=False)
    mapper = options.mapper
    mapper.num_threads, mapper.random_seed = num_threads(), seed
    mapper.global_positioning.random_seed = mapper.rotation_averaging.random_seed = seed
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    models = pycolmap.global_mapping(database, copies, folder, options)
    return _largest(models)


def registered(model: Any, features: Features) -> dict[int, Float[np.ndarray, "4 4"]]:
    """camera_from_world of the registered photographs, by index."""
    index = {image_id: i for i, image_id in enumerate(features.image_ids)}
    poses = {}
    for image_id, image in model.images.items():
        if image.has_pose:
            pose = np.eye(4)
            pose[:3] = image.cam_from_world().matrix()
            poses[index[image_id]] = pose
    return dict(sorted(poses.items()))


def epipolar_matches(
    poses: dict[int, np.ndarray],
    rays: list[Float[np.ndarray, "_ 2"]],
    matches: dict[tuple[int, int], np.ndarray],
    focal: float,
    tolerance: float,
) -> list[RelativePose]:
    """The matches of every pair that agree with known poses: Sampson error below `tolerance` pixels, at least 8 a pair.

    Args:
        rays: undistorted feature coordinates (x / z, y / z) by photograph.
    """
    result = []
    for (i, j), pair in matches.items():
        if i not in poses or j not in poses:
            continue
        relative = poses[j] @ np.linalg.inv(poses[i])
        rotation, t = relative[:3, :3], relative[:3, 3]
        t = t / max(np.linalg.norm(t), 1e-12)
        essential = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ rotation
        a = np.column_stack([rays[i][pair[:, 0]], np.ones(len(pair))])
        b = np.column_stack([rays[j][pair[:, 1]], np.ones(len(pair))])
        ea, eb = a @ essential.T, b @ essential
        gradient = (ea[:, :2] ** 2).sum(1) + (eb[:, :2] ** 2).sum(1)
        sampson = np.abs((b * ea).sum(1)) / np.sqrt(np.maximum(gradient, 1e-24))
        good = sampson * focal < tolerance
        if good.sum() >= 8:
            result.append(RelativePose(i, j, rotation, t, pair[good]))
    return result


def feature_rays(model: Any, features: Features) -> list[Float[np.ndarray, "_ 2"]]:
    """Undistorted coordinates (x / z, y / z) of all features."""
    return [
        np.asarray(model.cameras[c].cam_from_img(k)) if len(k) else np.zeros((0, 2))
        for k, c in zip(features.keypoints, features.camera_ids, strict=True)
    ]


def make_model(database: Path, features: Features, cameras: dict[int, Any], poses: dict[int, np.ndarray]) -> Any:
    """A Reconstruction without points from cameras by identifier and camera_from_world poses by photograph."""
    pycolmap = load_pycolmap()
    model = pycolmap.Reconstruction()
    chosen = {features.image_ids[i]: pose for i, pose in poses.items()}
    with pycolmap.Database.open(database) as db:
        for camera in cameras.values():
            model.add_camera(camera)
        for rig in db.read_all_rigs():
            if rig.ref_sensor_id.id in cameras:
                model.add_rig(rig)
        images = {image.image_id: image for image in db.read_all_images()}
        of_frame = {image.frame_id: image.image_id for image in images.values()}
        for frame in db.read_all_frames():
            image_id = of_frame[frame.frame_id]
            if image_id not in chosen:
                continue
            frame.rig_from_world = pycolmap.Rigid3d(chosen[image_id][:3])
            model.add_frame(frame)
            image = images[image_id]
            photo = features.image_ids.index(image_id)
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in features.keypoints[photo]])
            model.add_image(image)
            model.register_frame(frame.frame_id)
    return model


def _adjust(model: Any) -> None:
    """Bundle adjustment of everything with a robust loss (pycolmap.bundle_adjustment resets the log to chatty)."""
    pycolmap = load_pycolmap()
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    solver = options.ceres.solver_options
    solver.max_num_iterations, solver.function_tolerance, solver.num_threads = 50, 1e-6, num_threads()
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def rebuild(
    cameras: dict[int, Any],
    poses: dict[int, np.ndarray],
    features: Features,
    matches: dict[tuple[int, int], np.ndarray],
    database: Path,
    copies: Path,
) -> Any:
    """Triangulate all matches that agree with the given poses anew and adjust everything (robust loss), twice: within
    8, then within 4 pixels.

    Matches that a wrong geometry had voted out of their pair come back this way.

    Args:
        cameras: pycolmap cameras by identifier. poses: camera_from_world by photograph.

    Returns:
        A Reconstruction of these photographs.
    """
    pycolmap = load_pycolmap()
    work, folder = database.with_name("rebuild.db"), database.with_name("rebuild")
    folder.mkdir(exist_ok=True)
    model = make_model(database, features, cameras, poses)
    for tolerance in (8.0, 4.0):
        poses, rays = registered(model, features), feature_rays(model, features)
        focal = float(np.mean([c.mean_focal_length() for c in model.cameras.values()]))
        pairs = epipolar_matches(poses, rays, matches, focal, tolerance)
        write_pairs_database(database, work, features, [model.cameras[c] for c in features.camera_ids], pairs)
        options = pycolmap.IncrementalPipelineOptions(num_threads=num_threads(), random_seed=0)
        options.triangulation.ignore_two_view_tracks = False
        options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = tolerance
        options.mapper.filter_max_reproj_error = tolerance
        model = pycolmap.triangulate_points(model, work, copies, folder, True, options, False)
        _adjust(model)
        pycolmap.ObservationManager(model).filter_all_points3D(4.0, 1.5)
    _adjust(model)
    work.unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    return model
