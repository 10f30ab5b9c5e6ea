"""Calibrated photographs that people already have: COLMAP workspaces and transforms.json (nerfstudio, instant-ngp)."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from catacaustics.capture.colmap import ColmapCamera, ColmapImage, ColmapModel, has_model, read_model
from catacaustics.capture.dataset import Capture, default_split, open_capture, write_capture
from catacaustics.capture.undistort import undistort_views
from catacaustics.errors import UserError
from catacaustics.files import read_json
from catacaustics.geometry import rigid, rigid_inverse
from catacaustics.images import IMAGE_SUFFIXES, read_image_bytes

_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", ".")


def _colmap_model(source: Path) -> Path | None:
    return next((source / name for name in _MODEL_FOLDERS if has_model(source / name)), None)


def _transforms_file(source: Path) -> Path | None:
    path = source if source.suffix == ".json" else source / "transforms.json"
    return path if path.is_file() else None


def importable(source: Path) -> bool:
    """Whether a folder (or a transforms .json file) already holds calibrated cameras that `import_capture` reads."""
    source = Path(source)
    return _transforms_file(source) is not None or _colmap_model(source) is not None


def read_source(source: Path) -> tuple[ColmapModel, dict[str, Path]]:
    """Cameras and photographs of a source, without reading the photographs.

    Args:
        source: a COLMAP workspace (images/ beside sparse/0, sparse/ or the model itself; binary or text; any lens
            model), a folder with transforms.json, or such a file.

    Returns:
        The model, and the file of each of its images by name (for `undistort_views`).

    Raises:
        UserError: neither is there, a file is malformed, or photographs are missing (named).
    """
    source = Path(source)
    folder, transforms = _colmap_model(source), _transforms_file(source)
    if folder is not None:
        model = read_model(folder)
        images = next((source / n for n in ("images", "input") if (source / n).is_dir()), source)
        photos = {image.name: images / image.name for image in model.images}
        _refuse_missing(photos, folder)
    elif transforms is not None:
        model, photos = read_transforms(transforms)
    else:
        raise UserError(
            f"There are no cameras in {source}.",
            "a COLMAP model in sparse/0, or transforms.json",
            "give the folder of plain photographs instead: they are then calibrated",
        )
    if not model.images:
        raise UserError(f"The model in {folder} names no photographs.", "calibrated photographs", "calibrate again")
    return model, photos


def _refuse_missing(photos: dict[str, Path], origin: Path) -> None:
    missing = [name for name, path in photos.items() if not path.is_file()]
    if missing:
        raise UserError(
            f"{len(missing)} of {len(photos)} photographs that {origin} names are missing: "
            f"{', '.join(missing[:10])}{' ...' if len(missing) > 10 else ''}.",
            f"image files such as {photos[missing[0]]}",
            "restore them, or take them out of the model",
        )


def import_capture(
    source: Path, capture: Path, masks: Path | None = None, max_size: int | None = None, held_out_every: int = 8
) -> Capture:
    """Make a capture of calibrated photographs: undistorted photographs and masks, cameras, sparse points, a split.

    A second call skips finished photographs; a split.json that names the same views, in the capture or beside the
    source's cameras, is kept. There is no dense cloud yet (points.ply).

    Args:
        source: see `read_source`.
        capture: folder to write.
        masks: MASKS/REFLECTOR/STEM.png at the size of the photographs; by default the source's folder masks/, if any.
        max_size: longer side of the undistorted photographs.
        held_out_every: every n-th view in name order is held out.

    Raises:
        UserError: see `read_source` and `undistort_views`.
    """
    model, photos = read_source(source)
    folder = Path(source) if Path(source).is_dir() else Path(source).parent
    if masks is None and (folder / "masks").is_dir():
        masks = folder / "masks"
    views = undistort_views(model, photos, masks, capture, max_size)
    split = default_split([view.name for view in views], held_out_every)
    for path in (Path(capture) / "split.json", folder / "split.json"):
        old = read_json(path) if path.is_file() else None
        if old is not None and _split_names(old) == _split_names(split):
            split = old
            break
    write_capture(capture, views, split, model.points, model.colors)
    return open_capture(capture)


def _split_names(split: Any) -> list[str] | None:
    try:
        return sorted([*split["train"], *split["held_out"]])
    except (KeyError, TypeError):
        return None


def _bad(path: Path, found: str, expected: str) -> UserError:
    return UserError(f"{path}: {found}.", expected, "export it again with the program that made it, or correct it")


def _locate(path: Path, file_path: str) -> Path:
    """A frame's image; the path may lack its suffix, as in Blender's data sets."""
    image = path.parent / file_path.replace("\\", "/")
    if image.is_file():
        return image
    candidates = (image.with_name(image.name + suffix) for suffix in (".png", ".jpg", *sorted(IMAGE_SUFFIXES)))
    return next((c for c in candidates if c.is_file()), image)


def _pose(matrix: Any, path: Path, name: str) -> np.ndarray:
    """camera_from_world of a frame. transform_matrix is world_from_camera, with OpenGL's axes: y up, z backward."""
    try:
        world_from_camera = np.array(matrix, float)[:3] @ np.diag([1.0, -1, -1, 1])
    except (TypeError, ValueError, IndexError):
        raise _bad(path, f"the frame {name} has no 4 x 4 transform_matrix", "a 4 x 4 matrix of numbers") from None
    linear = world_from_camera[:, :3]
    scale = np.cbrt(np.linalg.det(linear))
    if not (scale > 0 and np.allclose(linear @ linear.T / scale**2, np.eye(3), atol=1e-3)):
        raise _bad(path, f"the transform_matrix of {name} is not a rotation and a position", "right-handed camera axes")
    u, _, vt = np.linalg.svd(linear)  # files hold rounded numbers: take the nearest rotation
    return rigid_inverse(rigid(u @ vt, world_from_camera[:, 3]))


def _focal(values: dict[str, Any], axis: str, size: int) -> float | None:
    if f"fl_{axis}" in values:
        return float(values[f"fl_{axis}"])
    if f"camera_angle_{axis}" in values:
        return size / 2 / float(np.tan(float(values[f"camera_angle_{axis}"]) / 2))
    return None


def _intrinsics(values: dict[str, Any], size: tuple[int, int], path: Path) -> tuple[str, int, int, tuple[float, ...]]:
    """COLMAP's model, size and parameters from a frame's keys over the file's."""
    width, height = size
    fx = _focal(values, "x", width)
    fy = _focal(values, "y", height) or fx
    if fx is None or fy is None:
        raise _bad(path, "there is no focal length", "fl_x in pixels or camera_angle_x in radians")
    center = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    k1, k2, k3, k4, p1, p2 = (float(values.get(key, 0)) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = "OPENCV_FISHEYE" if values.get("is_fisheye") else values.get("camera_model", "OPENCV")
    if model == "OPENCV_FISHEYE":
        return model, width, height, (fx, fy, *center, k1, k2, k3, k4)
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") or k4:
        found = f"the camera_model {model}{' with k4' if k4 else ''} is not known here"
        raise _bad(path, found, "OPENCV (k1 k2 k3 p1 p2), OPENCV_FISHEYE (k1 k2 k3 k4) or PINHOLE")
    if k3:
        return "FULL_OPENCV", width, height, (fx, fy, *center, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    if k1 or k2 or p1 or p2:
        return "OPENCV", width, height, (fx, fy, *center, k1, k2, p1, p2)
    return "PINHOLE", width, height, (fx, fy, *center)


def read_transforms(path: Path) -> tuple[ColmapModel, dict[str, Path]]:
    """Read transforms.json of nerfstudio or instant-ngp.

    Intrinsics may stand in the file or in each frame: fl_x, fl_y, cx, cy, w, h, or camera_angle_x and camera_angle_y;
    k1 k2 k3 p1 p2 (OPENCV), k1 k2 k3 k4 with camera_model OPENCV_FISHEYE or is_fisheye. Without w and h the first
    photograph's size is taken. The world stays the file's own; views are named by their paths below the photographs'
    common folder.

    Returns:
        The model (without points) and the file of each image by name.

    Raises:
        UserError: keys are missing or malformed; two frames share a photograph.
    """
    path = Path(path)
    value = read_json(path)
    frames = value.get("frames") if isinstance(value, dict) else None
    if not isinstance(frames, list) or not all(isinstance(f, dict) and "file_path" in f for f in frames) or not frames:
        raise _bad(path, "there is no list of frames with file_path", "frames: [{file_path, transform_matrix}, ...]")
    files = [_locate(path, str(frame["file_path"])) for frame in frames]
    files = [Path(os.path.normpath(file.absolute())) for file in files]  # links stay: they carry the names
    common = os.path.commonpath([file.parent for file in files])
    names = [file.relative_to(common).as_posix() for file in files]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise _bad(path, f"{len(repeated)} photographs stand in several frames, first {repeated[0]}", "one frame each")

    photos = dict(zip(names, files, strict=True))
    _refuse_missing(photos, path)

    keys: dict[tuple, int] = {}
    images = []
    first_size: tuple[int, int] | None = None
    for frame, (name, file) in zip(frames, photos.items(), strict=True):
        values = value | frame
        try:
            if "w" in values and "h" in values:
                size = int(values["w"]), int(values["h"])
            else:
                if first_size is None:
                    height, width = read_image_bytes(file, upright=False).shape[:2]
                    first_size = width, height
                size = first_size
            key = _intrinsics(values, size, path)
        except (TypeError, ValueError) as error:
            raise _bad(path, f"the intrinsics of {name} are malformed: {error}", "numbers") from error
        camera_id = keys.setdefault(key, len(keys) + 1)
        images.append(ColmapImage(name, camera_id, _pose(frame.get("transform_matrix"), path, name)))
    cameras = {i: ColmapCamera(model, w, h, np.array(params)) for (model, w, h, params), i in keys.items()}
    empty = np.zeros((0, 3))
    return ColmapModel(cameras, images, empty, empty), photos
