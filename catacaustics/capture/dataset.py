"""A capture on disk: undistorted photographs with PINHOLE cameras, a fused point cloud, reflector masks and a split.

    images/                   undistorted photographs, any names, subfolders allowed
    sparse/0/                 their COLMAP model: PINHOLE cameras, poses
    points.ply                fused multi-view-stereo points with normals
    guesses.ply               for its holes: what one or two views say, and the colours of others do not contradict
    masks/REFLECTOR/STEM.png  white = reflector; a reflector is masked in some views or in all
    split.json                {"train": [names], "held_out": [names]}, held-out views in path order

Images are read when asked for and not kept, so memory does not grow with their number.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catacaustics.cameras import Camera
from catacaustics.capture.colmap import has_model, pinhole_params, read_model, write_model
from catacaustics.errors import UserError
from catacaustics.files import read_json, write_json
from catacaustics.images import list_images, read_image_bytes, read_mask
from catacaustics.points import PointCloud, read_ply
from catacaustics.shapes import Bool, UInt8


@dataclass(frozen=True, eq=False)
class View:
    """One photograph: its name (path below images/) and its camera."""

    name: str
    camera: Camera


@dataclass(frozen=True, eq=False)
class Capture:
    """A calibrated capture. Open one with `open_capture`.

    Args:
        root: the capture's folder.
        train: views to learn from.
        held_out: views to measure on, in path order.
        reflectors: names of the reflectors that have masks, sorted.
    """

    root: Path
    train: list[View]
    held_out: list[View]
    reflectors: list[str]

    @property
    def views(self) -> list[View]:
        return [*self.train, *self.held_out]

    def image(self, view: View) -> UInt8[np.ndarray, "height width 3"]:
        """Read a view's photograph.

        Raises:
            UserError: it is missing, unreadable or of another size than its camera.
        """
        image = read_image_bytes(self.root / "images" / view.name)
        self._check_size(image, view, self.root / "images" / view.name)
        return image

    def mask(self, view: View, reflector: str) -> Bool[np.ndarray, "height width"] | None:
        """A reflector's mask in a view, or None where it was not masked; raises as `image`."""
        path = self.mask_path(view, reflector)
        if not path.is_file():
            return None
        mask = read_mask(path)
        self._check_size(mask, view, path)
        return mask

    def mask_path(self, view: View, reflector: str) -> Path:
        return self.root / "masks" / reflector / Path(view.name).with_suffix(".png")

    def points(self) -> PointCloud:
        """The fused cloud; raises UserError where there is none yet."""
        return read_ply(self.root / "points.ply")

    def guesses(self) -> PointCloud | None:
        """Points for the holes of the fused cloud, many of them wrong; None where the capture has none."""
        return read_ply(self.root / "guesses.ply") if self.has_guesses else None

    @property
    def has_guesses(self) -> bool:
        return (self.root / "guesses.ply").is_file()

    def _check_size(self, image: np.ndarray, view: View, path: Path) -> None:
        height, width = image.shape[:2]
        if (width, height) != (view.camera.width, view.camera.height):
            raise UserError(
                f"{path} has {width} x {height} pixels.",
                f"{view.camera.width} x {view.camera.height}, the size of the view's camera",
                "make it again at the size of the undistorted photographs in images/",
            )


def default_split(names: list[str], every: int = 8) -> dict[str, list[str]]:
    """Every n-th view in name order is held out, the first one included; fewer than n views hold out the last."""
    names = sorted(names)
    held_out = names[::every] if len(names) >= every else names[-1:]
    return {"train": [n for n in names if n not in set(held_out)], "held_out": held_out}


def write_capture(
    root: Path,
    views: list[View],
    split: dict[str, list[str]],
    points: np.ndarray | None = None,
    colors: np.ndarray | None = None,
) -> None:
    """Write the cameras and the split of a capture whose photographs are in images/ already, and the sparse points
    (n, 3) and their colours (n, 3) from structure from motion, where there are any."""
    write_model(Path(root) / "sparse" / "0", [(v.name, v.camera) for v in views], points, colors)
    write_json(Path(root) / "split.json", split)


def open_capture(root: Path) -> Capture:
    """Open a capture folder.

    Raises:
        UserError: the folder is missing or was cut off half way: what is missing is named.
    """
    root = Path(root)
    if not has_model(root / "sparse" / "0"):
        raise UserError(
            f"{root} is not a calibrated capture: it has no COLMAP model in sparse/0.",
            "a folder made by `catacaustics calibrate`",
            f"run `catacaustics calibrate PHOTOS {root}`; finished stages are kept",
        )
    model = read_model(root / "sparse" / "0")
    views = {}
    for image in model.images:
        camera = model.cameras[image.camera_id]
        parameters = pinhole_params(camera)
        views[image.name] = View(image.name, Camera(camera.width, camera.height, *parameters, image.camera_from_world))
    missing = [name for name in views if not (root / "images" / name).is_file()]
    if missing:
        raise UserError(
            f"{len(missing)} of {len(views)} photographs are missing from {root / 'images'}, first {missing[0]}.",
            "every photograph that the model in sparse/0 names",
            "restore them, or run `catacaustics calibrate` again",
        )
    split_path = root / "split.json"
    split = read_json(split_path) if split_path.is_file() else default_split(list(views))
    if not isinstance(split, dict) or not {"train", "held_out"} <= split.keys():
        raise UserError(f"{split_path} has other keys.", "train and held_out", "delete it for the default split")
    unknown = [name for part in ("train", "held_out") for name in split[part] if name not in views]
    if unknown:
        raise UserError(
            f"{split_path} names {len(unknown)} views without a camera, first {unknown[0]}.",
            f"names among the {len(views)} calibrated views",
            "delete the file for the default split (every 8th view held out), or correct the names",
        )
    if not split["train"]:
        raise UserError(f"{split_path} leaves no view for training.", "at least one training view", "correct the split")
    folders = sorted(p for p in (root / "masks").glob("*") if p.is_dir())
    return Capture(
        root,
        [views[n] for n in split["train"]],
        [views[n] for n in split["held_out"]],
        [p.name for p in folders if list_images(p)],
    )
