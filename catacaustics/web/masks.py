"""The painter's work without a browser: masks with revisions, the volumes they make, and the files both are kept in.

Nothing is held in memory between calls: what is on disk is what counts, so that another tab, another program and a
server that was killed all see the same masks.
"""

import hashlib
import os
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from catacaustics.cameras import Camera
from catacaustics.capture.dataset import Capture, View
from catacaustics.capture.undistort import find_masks
from catacaustics.errors import UserError
from catacaustics.files import read_json, write_json
from catacaustics.images import list_images, read_mask, write_image
from catacaustics.reflectors.volume import (
    MaskError,
    ReflectionVolume,
    mask_hull,
    partly_hidden,
    volume_from_masks,
    volume_views,
    write_volume,
)
from catacaustics.shapes import Bool, Float

COLORS = ("#f5b83d", "#4cc3ff", "#ff7eb6", "#7ee081", "#b69cff", "#ff9466", "#5de0d0", "#e6e05c")
"""Colours of reflectors, in the order in which they are added."""
POOR_FIT = 0.8
"""A mask of which the other masks leave less than this share is pointed out."""
_NAME = re.compile(r"\w([\w -]{0,58}\w)?")
_COLOR = re.compile(r"#[0-9a-f]{6}")
_EMPTY = "empty"


class StaleMask(Exception):
    """A mask changed since it was read: by another tab, or by another program.

    Args:
        mask: what is on disk now.
    """

    def __init__(self, mask: Bool[np.ndarray, "height width"]):
        self.mask = mask
        super().__init__("the mask changed since it was read")


# Masks as numbers ----------------------------------------------------------------------------------------------------


def encode_runs(mask: Bool[np.ndarray, "height width"]) -> list[int]:
    """Lengths of the runs of equal pixels, row by row; the first run is of black ones and may be 0."""
    flat = mask.ravel()
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    edges = np.concatenate([[0], changes, [flat.size]])
    runs = np.diff(edges).tolist()
    return [0, *runs] if flat[0] else runs


def decode_runs(runs: Any, width: int, height: int) -> Bool[np.ndarray, "height width"]:
    """The mask that `encode_runs` took; raises UserError where the runs do not make one of this size."""
    try:
        lengths = np.array(runs, np.int64)
        if lengths.ndim != 1 or not all(type(r) is int for r in runs) or (lengths < 0).any():
            raise ValueError("not a list of lengths")
        total = sum(runs)
    except (OverflowError, TypeError, ValueError) as error:
        raise _bad_runs("something else than lengths of runs", width, height) from error
    if total != width * height:
        raise _bad_runs(f"{total} pixels", width, height)
    return np.repeat(np.arange(len(lengths)) % 2 == 1, lengths).reshape(height, width)


def _bad_runs(found: str, width: int, height: int) -> UserError:
    return UserError(f"The mask has {found}.", f"{width} x {height} pixels", "reload the page")


def revision(mask: Bool[np.ndarray, "height width"]) -> str:
    """A name for the content of a mask; all black is the same as no mask."""
    if not mask.any():
        return _EMPTY
    return hashlib.sha256(np.packbits(mask).tobytes() + repr(mask.shape).encode()).hexdigest()[:16]


# Masks on disk -------------------------------------------------------------------------------------------------------


class MaskStore:
    """Masks and volumes of a capture's reflectors. Views go by their index in `capture.views`.

    Every method raises UserError where a file cannot be read or written, or a path would lead out of the capture.
    """

    def __init__(self, capture: Capture):
        self.capture = capture
        self.views = capture.views
        self._root = capture.root.resolve()
        self._colors_path = capture.root / "masks" / "reflectors.json"
        self._lock = threading.Lock()

    def photograph(self, view: int) -> Path:
        """The file of a view's photograph."""
        return self._inside(self.capture.root / "images" / self.views[view].name)

    def reflectors(self) -> dict[str, str]:
        """Colours by name: reflectors that were added here, then those that only have masks."""
        noted = read_json(self._colors_path) if self._inside(self._colors_path).is_file() else {}
        if not isinstance(noted, dict):
            noted = {}
        folders = sorted(p for p in (self.capture.root / "masks").glob("*") if p.is_dir() and list_images(p))
        names = [*filter(_NAME.fullmatch, noted), *(p.name for p in folders if p.name not in noted)]
        colors = {name: noted.get(name) for name in names}
        return {
            name: color if isinstance(color, str) and _COLOR.fullmatch(color) else COLORS[i % len(COLORS)]
            for i, (name, color) in enumerate(colors.items())
        }

    def note_reflectors(self, colors: Mapping[str, str]) -> None:
        """Keep names, their order and colours."""
        for name, color in colors.items():
            _check_name(name)
            if not _COLOR.fullmatch(color):
                raise UserError(f"{color!r} is not a colour.", "#rrggbb", "choose another colour")
        write_json(self._inside(self._colors_path), dict(colors))

    def mask(self, reflector: str, view: int) -> Bool[np.ndarray, "height width"]:
        """A mask, all black where there is none."""
        camera = self.views[view].camera
        self._mask_path(reflector, view)
        mask = self.capture.mask(self.views[view], reflector)
        return np.zeros((camera.height, camera.width), bool) if mask is None else mask

    def masked_views(self, reflector: str) -> list[int]:
        return [i for i in range(len(self.views)) if self._mask_path(reflector, i).is_file()]

    def save_mask(self, reflector: str, view: int, mask: Bool[np.ndarray, "height width"], known: str) -> str:
        """Write a mask atomically (an empty one removes the file) and return its revision.

        Args:
            known: revision of the mask that was changed.

        Raises:
            StaleMask: the mask on disk is neither that one nor the new one.
        """
        path = self._mask_path(reflector, view)
        with self._lock:
            current = self.mask(reflector, view)
            if revision(current) not in (known, revision(mask)):
                raise StaleMask(current)
            if mask.any():
                write_image(path, mask)
            else:
                with _readable_errors(path):
                    path.unlink(missing_ok=True)
        return revision(mask)

    def rename(self, old: str, new: str) -> None:
        """Give a reflector another name; raises UserError where that one is in use."""
        _check_name(new)
        source, target = self._folder(old), self._folder(new)
        colors = self.reflectors()
        if new in colors or target.exists():
            raise UserError(f"There is a reflector {new} already.", "a new name", "choose another name")
        with self._lock:
            if source.is_dir():
                with _readable_errors(target):
                    source.rename(target)
        self.note_reflectors({new if name == old else name: color for name, color in colors.items()})
        self._remove_volume(old)

    def delete(self, name: str) -> Path | None:
        """Take a reflector out of the capture. Its masks are moved to removed_masks/NAME, not deleted; returns that
        folder, or None where there were none."""
        source = self._folder(name)
        colors = {n: c for n, c in self.reflectors().items() if n != name}
        target = None
        with self._lock:
            if source.is_dir():
                removed = self._inside(self.capture.root / "removed_masks")
                count = 0
                while (target := removed / (f"{name}-{count}" if count else name)).exists():
                    count += 1
                with _readable_errors(target):
                    removed.mkdir(exist_ok=True)
                    source.rename(target)
        self.note_reflectors(colors)
        self._remove_volume(name)
        return target

    def volume(
        self, reflector: str, changed: Mapping[int, Bool[np.ndarray, "height width"]] | None = None
    ) -> tuple[ReflectionVolume, dict[int, np.ndarray], list[int]]:
        """The volume from the masks on disk, some of them replaced, the masks that made it by view, and the views whose
        masks show only part of the object, which were left out; raises MaskError where they make none."""
        changed = changed or {}
        masked = [i for i in self.masked_views(reflector) if i not in changed]
        masked += [i for i, mask in changed.items() if mask.any()]
        index = {view.name: i for i, view in enumerate(self.views)}
        chosen = [index[v.name] for v in volume_views(self.capture, {self.views[i].name for i in masked})]
        masks = {i: changed[i] if i in changed else self.mask(reflector, i) for i in chosen}
        named = [(self.views[i].name, self.views[i].camera, mask) for i, mask in masks.items()]
        hidden = partly_hidden(named)
        volume = volume_from_masks(reflector, [m for m in named if m[0] not in hidden])
        left_out = [index[name] for name in hidden]
        return volume, {i: mask for i, mask in masks.items() if i not in left_out}, left_out

    def save_volume(self, reflector: str) -> dict[str, Any]:
        """Write the volume (and remove an outdated one where the masks make none); returns its `report`. That a file
        cannot be written is one of its problems: the masks are safe already."""
        with self._lock:
            report, volume = self._report(reflector, {})
            try:
                if volume is None:
                    self._remove_volume(reflector)
                else:
                    self._volume_paths(reflector)
                    write_volume(self.capture, volume)
            except UserError as error:
                report["problem"] = _problem(error, [])
        return report

    def report(
        self, reflector: str, changed: Mapping[int, Bool[np.ndarray, "height width"]] | None = None
    ) -> dict[str, Any]:
        """What the masks make, ready for JSON: the volume's mesh, its outline in every view, how well the masks agree,
        and what is wrong, with the views to look at."""
        return self._report(reflector, changed or {})[0]

    def _report(
        self, reflector: str, changed: Mapping[int, Bool[np.ndarray, "height width"]]
    ) -> tuple[dict[str, Any], ReflectionVolume | None]:
        empty: dict[str, Any] = {"mesh": None, "outlines": None, "fits": {}, "problem": None}
        try:
            volume, masks, hidden = self.volume(reflector, changed)
        except MaskError as error:
            blamed = [i for i, view in enumerate(self.views) if view.name in error.views]
            return {**empty, "problem": _problem(error, blamed)}, None
        outlines = [_frame(volume.outline(v.camera), v.camera, margin=1.0) for v in self.views]
        fits = {i: round(_fit(volume, self.views[i].camera, mask), 3) for i, mask in masks.items()}
        mesh = {"vertices": volume.vertices.round(6).tolist(), "faces": volume.faces.tolist(), "radius": volume.radius}
        polygons = [o.round(1).tolist() for o in outlines]
        problem = self._hidden(hidden) or self._poor(fits)
        return {**empty, "mesh": mesh, "outlines": polygons, "fits": fits, "problem": problem}, volume

    def _hidden(self, views: list[int]) -> dict[str, Any] | None:
        if not views:
            return None
        names = ", ".join(self.views[i].name for i in views)
        return {
            "found": f"Only part of the object is painted in {names}: the other masks agree on more there.",
            "expected": "masks of the whole object",
            "remedy": "nothing, where something stands before it (the volume does without); otherwise paint the rest",
            "views": views,
        }

    def _poor(self, fits: Mapping[int, float]) -> dict[str, Any] | None:
        poor = sorted((i for i in fits if fits[i] < POOR_FIT), key=lambda i: fits[i])
        if not poor:
            return None
        worst = self.views[poor[0]].name
        return {
            "found": f"The masks agree badly: the others leave {100 * fits[poor[0]]:.0f} % of the mask in {worst}.",
            "expected": f"{100 * POOR_FIT:.0f} % or more",
            "remedy": f"see whether the mask in {worst} is too wide, or that in another view too tight",
            "views": poor,
        }

    def _inside(self, path: Path) -> Path:
        """The path; raises UserError where it, or what a link on the way points to, is outside the capture."""
        if not path.resolve().is_relative_to(self._root):
            raise UserError(
                f"{path} leads out of the capture {self._root}.", "files inside the capture", "remove the link"
            )
        return path

    def _folder(self, reflector: str) -> Path:
        _check_name(reflector)
        return self._inside(self.capture.root / "masks" / reflector)

    def _mask_path(self, reflector: str, view: int) -> Path:
        _check_name(reflector)
        return self._inside(self.capture.mask_path(self.views[view], reflector))

    def _volume_paths(self, reflector: str) -> list[Path]:
        return [self._inside(self.capture.root / "volumes" / f"{reflector}.{suffix}") for suffix in ("json", "ply")]

    def _remove_volume(self, reflector: str) -> None:
        for path in self._volume_paths(reflector):
            with _readable_errors(path):
                path.unlink(missing_ok=True)


def _problem(error: UserError, views: list[int]) -> dict[str, Any]:
    return {"found": error.found, "expected": error.expected, "remedy": error.remedy, "views": views}


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise UserError(
            f"{name!r} cannot be the name of a reflector.",
            "up to 60 letters, digits, spaces, - and _, beginning and ending with a letter or digit",
            "choose another name",
        )


@contextmanager
def _readable_errors(path: Path) -> Iterator[None]:
    """Errors of the file system as UserErrors."""
    try:
        yield
    except OSError as error:
        raise UserError(
            f"Cannot change {path}: {os.strerror(error.errno or 0)}.",
            "a folder that this user may write to",
            "change its permissions, or copy the capture to another disk",
        ) from error


def _frame(polygon: Float[np.ndarray, "n 2"], camera: Camera, margin: float = 0.0) -> Float[np.ndarray, "m 2"]:
    """The part of a convex polygon inside the image, widened on each side by a share of its size (Sutherland and
    Hodgman, 1974)."""
    width, height = camera.width, camera.height
    sides = [(0, -1, -margin * width), (0, 1, (1 + margin) * width)]
    sides += [(1, -1, -margin * height), (1, 1, (1 + margin) * height)]
    for axis, sign, limit in sides:
        if not len(polygon):
            break
        beyond = sign * polygon[:, axis] - sign * limit  # > 0 outside
        following, beyond_following = np.roll(polygon, -1, 0), np.roll(beyond, -1)
        crosses = (beyond > 0) != (beyond_following > 0)
        t = np.where(crosses, beyond / np.where(crosses, beyond - beyond_following, 1), 0)
        cut = polygon + t[:, None] * (following - polygon)
        both = np.stack([polygon, cut], 1).reshape(-1, 2)
        polygon = both[np.stack([beyond <= 0, crosses], 1).ravel()]
    return polygon


def _area(polygon: Float[np.ndarray, "n 2"]) -> float:
    x, y = polygon.T if len(polygon) else np.zeros((2, 1))
    return float(abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2)


def _fit(volume: ReflectionVolume, camera: Camera, mask: np.ndarray) -> float:
    """Share of a mask's hull that the volume still covers. The volume's picture lies inside the hull, but for the
    simplification of its outline and for masks on the image's border, which are open there."""
    return min(_area(_frame(volume.outline(camera), camera)) / _area(mask_hull(mask)), 1.0)


# Masks from elsewhere ------------------------------------------------------------------------------------------------


def import_masks(store: MaskStore, folder: Path) -> dict[str, int]:
    """Take masks made with any editor: FOLDER/REFLECTOR/STEM.png. All are checked before the first is written, and
    masks that they replace are kept in removed_masks/. Returns the number of masks by reflector.

    Raises:
        UserError: a mask of another size than its photograph, unreadable, or empty; none at all.
    """
    views = {view.name: i for i, view in enumerate(store.views)}
    found = find_masks(Path(folder), list(views))
    for name, files in found.items():
        _check_name(name)
        for view_name, path in files.items():
            _check_import(path, read_mask(path), store.views[views[view_name]])
    colors = store.reflectors()
    for name, files in found.items():
        if store.masked_views(name):
            kept = store.delete(name)
            print(f"masks: those that {name} had before are in {kept}")
        for view_name, path in files.items():
            store.save_mask(name, views[view_name], read_mask(path), _EMPTY)
        colors.setdefault(name, COLORS[len(colors) % len(COLORS)])
    store.note_reflectors(colors)
    return {name: len(files) for name, files in found.items()}


def _check_import(path: Path, mask: np.ndarray, view: View) -> None:
    height, width = mask.shape
    if (width, height) != (view.camera.width, view.camera.height):
        raise UserError(
            f"The mask {path} has {width} x {height} pixels, nothing was imported.",
            f"{view.camera.width} x {view.camera.height}, the size of {view.name} in the capture's images/",
            "paint it on that photograph; masks of the distorted originals go into `catacaustics calibrate --masks`",
        )
    if not mask.any():
        raise UserError(
            f"The mask {path} is all black, nothing was imported.",
            "the reflector in white",
            "paint it white, or delete the file where the reflector is not seen",
        )
