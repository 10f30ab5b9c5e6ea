"""Exact geometry of path-traced captures: truth/STEM.npz, one file a view, and truth/reflectors.json.

Images are delta-coded integers: inverse depth in 65535 steps, normals in 1/127, sources in whole steps of a length
that the file names. Smooth surfaces then take about two bits a value.
"""

import io
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from catacaustics.errors import UserError
from catacaustics.files import read_json, write_bytes
from catacaustics.shapes import Bool, Float


@dataclass(frozen=True, eq=False)
class Truth:
    """What is really seen in a view, at pixel centres. World units are metres.

    Args:
        depth: z in the camera; nan where there is no surface (sky).
        normals: unit normals in world coordinates, facing the camera; nan where there is no surface.
        source: world position of the first surface that is no reflector, met along the mirrored path (several bounces
            are followed); nan where the pixel shows no reflector or the path leaves the scene.
        mirror_mask: True where a reflector is seen.
    """

    depth: Float[np.ndarray, "height width"]
    normals: Float[np.ndarray, "height width 3"]
    source: Float[np.ndarray, "height width 3"]
    mirror_mask: Bool[np.ndarray, "height width"]


def truth_path(root: Path, view_name: str) -> Path:
    return Path(root) / "truth" / Path(view_name).with_suffix(".npz")


def _encoded(levels: np.ndarray, dtype: type) -> np.ndarray:
    """Differences along rows, then along columns, wrapping around: near zero on smooth surfaces. One plane a byte."""
    delta = levels.astype(dtype)
    for axis in (1, 0):
        delta = np.diff(delta, axis=axis, prepend=np.zeros_like(np.take(delta, [0], axis)))
    low_to_high = delta.astype(delta.dtype.newbyteorder("<"))[..., None].view(np.uint8)
    return np.ascontiguousarray(np.moveaxis(low_to_high, -1, 0))


def _decoded(planes: np.ndarray) -> np.ndarray:
    dtype = np.dtype({1: "<u1", 2: "<u2"}[len(planes)])
    delta = np.ascontiguousarray(np.moveaxis(planes, 0, -1)).view(dtype)[..., 0]
    return np.cumsum(np.cumsum(delta, axis=0, dtype=dtype), axis=1, dtype=dtype)


def write_truth(root: Path, view_name: str, truth: Truth, source_step: float = 1e-3) -> None:
    """Write a view's truth.

    Args:
        source_step: resolution of the sources in metres; coarser where they span more than 65 535 steps.
    """
    found = np.isfinite(truth.depth)
    inverse = np.where(found, 1 / np.where(found, truth.depth, 1), 0)
    depth_scale = float(inverse.max()) or 1.0
    # 0 means no surface, hence the steps 1 to 65535.
    depth = np.where(found, np.maximum(np.rint(inverse / depth_scale * 65535), 1), 0)
    reached: np.ndarray = np.asarray(np.isfinite(truth.source).all(-1))
    sources = truth.source[reached] if reached.any() else np.zeros((1, 3))
    low = sources.min(0)
    step = max(source_step, float((sources.max(0) - low).max()) / 65535)
    source = np.where(reached[..., None], np.rint((np.where(reached[..., None], truth.source, low) - low) / step), 0)
    arrays = {
        "depth": _encoded(depth, np.uint16),
        "depth_scale": np.float64(depth_scale),
        "normals": _encoded(np.rint(np.nan_to_num(truth.normals) * 127) + 127, np.uint8),
        "source": _encoded(source, np.uint16),
        "source_low": low,
        "source_step": np.float64(step),
        "reached": np.packbits(reached, axis=-1),
        "mirror_mask": np.packbits(truth.mirror_mask, axis=-1),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_bytes(truth_path(root, view_name), buffer.getvalue())


def read_truth(capture_root: Path, view_name: str) -> Truth:
    """Read a view's truth.

    Depth is good to half a step of inverse depth (0.3 mm at 3 m where the nearest surface is at 0.5 m), normals to half
    a degree, sources to half of 1 mm (more in scenes over 65 m).

    Raises:
        UserError: the view has none (real photographs never do), or the file is damaged.
    """
    path = truth_path(capture_root, view_name)
    try:
        with np.load(path, allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
        depth, width = _decoded(stored["depth"]).astype(float), stored["depth"].shape[2]
        reached = np.unpackbits(stored["reached"], axis=-1, count=width).astype(bool)
        mirror = np.unpackbits(stored["mirror_mask"], axis=-1, count=width).astype(bool)
        source = _decoded(stored["source"]) * stored["source_step"] + stored["source_low"]
        normals = _decoded(stored["normals"]).astype(float) - 127
        scale = float(stored["depth_scale"])
    except FileNotFoundError as error:
        raise UserError(
            f"The view {view_name} has no ground truth: there is no {path}.",
            "a view of a path-traced capture with a file in truth/",
            f"choose among {sorted(p.stem for p in path.parent.glob('*.npz')) or 'path-traced captures'}",
        ) from error
    except (ValueError, KeyError, OSError, zipfile.BadZipFile) as error:
        raise UserError(
            f"{path} is damaged: {error}.", "a complete truth file", "restore it, or make the scene again"
        ) from error
    found = depth > 0
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return Truth(
        np.where(found, 65535 / (np.where(found, depth, 1) * scale), np.nan),
        np.where(found[..., None], normals / np.where(length > 0, length, 1), np.nan),
        np.where(reached[..., None], source, np.nan),
        mirror,
    )


def read_reflectors(capture_root: Path) -> dict[str, dict[str, Any]]:
    """Analytic geometry of the reflectors by name, as truth/reflectors.json states it: metres, world coordinates.

    {"type": "sphere", "center", "radius"}, {"type": "plane", "corners"}, {"type": "ellipsoid", "center", "radii",
    "rotation"} and others; "mesh" names a PLY beside the file that holds the whole surface.
    """
    return read_json(Path(capture_root) / "truth" / "reflectors.json")
