"""Data sets of views through glass: G-buffers, R-buffer truth, path-traced references, in sharded files.

    FOLDER/card.json               how the data were made: scene, seeds, ranges, sizes, SHA-256 of every shard
    FOLDER/textures/0_NAME.png     one for each opaque object, in the order of `landing_object`
    FOLDER/shards/train_0000.npz   some frames of one split

World coordinates lie in [-1, 1]^3. Texture coordinates: (0, 0) is the texture's top left corner, v runs down.
"""

import hashlib
import io
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from catacaustics.errors import UserError
from catacaustics.files import read_json, write_bytes
from catacaustics.images import encode_image, read_image_bytes
from catacaustics.shapes import Bool, Float, Int, UInt8

SPLITS = ("train", "val", "test", "generator")
"""generator: frames without a path-traced reference, for the R-buffer generator, whose truth is cheap."""
CARD = "card.json"
FORMAT = 3
"""Of data sets; 2 has the probe's panorama, 3 how each transparent object stands."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One view of `h` x `w` pixels of a scene with `k` transparent objects. All buffers belong to pixel centres."""

    reference: Float[np.ndarray, "h w 3"]
    """Path traced, box filter, sRGB-encoded and clipped to [0, 1]; zeros where `has_reference` is False."""
    has_reference: bool
    position: Float[np.ndarray, "h w 3"]
    """Of the opaque scene alone, as all up to `direct`: world coordinates."""
    normal: Float[np.ndarray, "h w 3"]
    """Shading normal, towards the camera."""
    albedo: Float[np.ndarray, "h w 3"]
    """Texture colour, sRGB-encoded."""
    depth: Float[np.ndarray, "h w"]
    """Distance along the viewing axis."""
    direct: Float[np.ndarray, "h w 3"]
    """Direct lighting, sRGB-encoded and clipped to [0, 1]."""
    object_mask: Bool[np.ndarray, "k h w"]
    """Where each transparent object is seen when it stands alone in the world; the next three are zero elsewhere."""
    object_position: Float[np.ndarray, "k h w 3"]
    object_normal: Float[np.ndarray, "k h w 3"]
    object_depth: Float[np.ndarray, "k h w"]
    object_ior: Float[np.ndarray, "k"]
    """Index of refraction."""
    object_to_world: Float[np.ndarray, "k 3 4"]
    """How each transparent object stands: x_world = M @ (x_body, 1), a rotation times a size, and a place."""
    refractive: Bool[np.ndarray, "h w"]
    """The first surface on the pixel's ray is transparent."""
    landing: Float[np.ndarray, "h w 3"]
    """Where the specular path of the ray lands on an opaque surface; zeros where it does not (`landing_object` < 0)."""
    landing_uv: Float[np.ndarray, "h w 2"]
    """Texture coordinates there, in [0, 1)."""
    landing_normal: Float[np.ndarray, "h w 3"]
    """Shading normal there, towards where the path comes from."""
    landing_object: Int[np.ndarray, "h w"]
    """Opaque object landed on, an index of `Frames.textures`; -1 where the pixel is not refractive or lands nowhere."""
    events: Int[np.ndarray, "h w"]
    """Refractions and reflections on the path."""
    internal_reflection: Bool[np.ndarray, "h w"]
    """The path holds a total internal reflection."""
    screen: UInt8[np.ndarray, "s s 3"]
    """Texture colour of the opaque scene from the same camera, sRGB-encoded; 0 x 0 pixels in the split generator."""
    screen_depth: Float[np.ndarray, "s s"]
    """Distance along the viewing axis at the pixels of `screen`."""
    probe: UInt8[np.ndarray, "v u 3"]
    """Texture colour of the opaque scene all around `probe_position`, sRGB-encoded, equirectangular, u = 2 v: columns
    run from azimuth -180 to 180 degrees, atan2(y, x), rows from straight up to straight down; 0 x 0 pixels in the split
    generator."""
    probe_position: Float[np.ndarray, "3"]
    """Amid the transparent objects."""
    world_to_clip: Float[np.ndarray, "4 4"]
    """p = M @ (x, y, z, 1); ndc = p[:3] / p[3]: x to the right, y up, -1 and 1 at the edges of the image."""
    camera_position: Float[np.ndarray, "3"]
    parameters: Float[np.ndarray, "p"]
    """What was drawn, each scaled to [0, 1] over its range; the card has names and ranges."""


# How a field is stored. fixed: 16-bit fixed point in [-1, 1] (error 1.5e-5). byte: 8-bit in [0, 1] (error 2e-3).
_STORED = {
    "position": "fixed",
    "normal": "fixed",
    "object_position": "fixed",
    "object_normal": "fixed",
    "landing_normal": "fixed",
    "albedo": "byte",
    "direct": "byte",
    "reference": np.float16,
    "depth": np.float16,
    "object_mask": bool,
    "object_depth": np.float16,
    "object_ior": np.float32,
    "object_to_world": np.float32,
    "refractive": bool,
    "landing": np.float32,
    "landing_uv": np.float32,
    "landing_object": np.int8,
    "events": np.int8,
    "internal_reflection": bool,
    "screen": "png",
    "screen_depth": "inverse",
    "probe": "png",
    "probe_position": np.float32,
    "world_to_clip": np.float32,
    "camera_position": np.float32,
    "parameters": np.float32,
    "has_reference": bool,
}


def _encode(name: str, value: Any) -> np.ndarray:
    kind, value = _STORED[name], np.asarray(value)
    if kind == "fixed":
        return np.round(np.clip(value, -1, 1) * 32767).astype(np.int16)
    if kind == "byte":
        return np.round(np.clip(value, 0, 1) * 255).astype(np.uint8)
    if kind == "png":
        return np.frombuffer(encode_image(value, ".png") if value.size else b"", np.uint8)
    if kind == "inverse":
        return _encode_depth(value)
    return value.astype(kind)


def _decode(name: str, stored: np.ndarray) -> Any:
    kind = _STORED[name]
    if kind == "fixed":
        return stored.astype(np.float32) / 32767
    if kind == "byte":
        return stored.astype(np.float32) / 255
    if kind == "png":
        return np.ascontiguousarray(_picture(stored)[..., ::-1]) if stored.size else _NO_SCREEN
    if kind == "inverse":
        return _decode_depth(stored)
    if name == "has_reference":
        return bool(stored)
    return stored.astype(np.float32) if stored.dtype == np.float16 else stored


def _picture(png: np.ndarray) -> np.ndarray:
    import cv2

    picture = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise ValueError("a picture in it cannot be decoded")
    return picture


_NO_SCREEN = np.zeros((0, 0, 3), np.uint8)


def _encode_depth(depth: np.ndarray) -> np.ndarray:
    """Nearest depth (float32) and a 16-bit PNG of nearest / depth: that is linear on planes and packs well. Relative
    error at n times the nearest depth: n * 8e-6."""
    import cv2

    if not depth.size:
        return np.zeros(0, np.uint8)
    nearest = np.float32(depth.min())
    steps = np.round(nearest / depth * 65535).astype(np.uint16)
    data = nearest.tobytes() + cv2.imencode(".png", steps)[1].tobytes()
    return np.frombuffer(data, np.uint8)


def _decode_depth(stored: np.ndarray) -> np.ndarray:
    if not stored.size:
        return np.zeros((0, 0), np.float32)
    nearest = np.frombuffer(stored[:4].tobytes(), np.float32)[0]
    steps = _picture(stored[4:])
    return nearest * 65535 / np.maximum(steps, 1).astype(np.float32)


def write_shard(path: Path, frames: Sequence[Frame]) -> str:
    """Write frames into one file, atomically. Returns its SHA-256.

    Raises:
        UserError: the disk is full or the folder cannot be written.
    """
    names = [f.name for f in fields(Frame)]
    entries = {f"{i}.{name}": _encode(name, getattr(frame, name)) for i, frame in enumerate(frames) for name in names}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **entries)  # pyright: ignore[reportArgumentType]
    data = buffer.getvalue()
    write_bytes(path, data)
    return hashlib.sha256(data).hexdigest()


def shard_problem(path: Path, sha256: str | None) -> str | None:
    """What is wrong with a shard's file, None where nothing is. Without a checksum the file's own ones are tested."""
    if not path.is_file():
        return "is missing"
    if sha256 is not None:
        return None if sha256_of(path) == sha256 else "is corrupt: its checksum differs from the one in card.json"
    try:
        with zipfile.ZipFile(path) as file:
            return None if file.testzip() is None else "is corrupt"
    except zipfile.BadZipFile:
        return "is corrupt"


def sha256_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_frame(path: Path, index: int) -> Frame:
    """One frame of a shard; only its own part of the file is read.

    Raises:
        UserError: the file is missing or corrupt.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return Frame(**{f.name: _decode(f.name, file[f"{index}.{f.name}"]) for f in fields(Frame)})
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(
            f"{path} cannot be read: {error}.",
            "a shard as `catacaustics refract data` wrote it",
            "run that command again with the same settings: it makes what is missing and keeps the rest",
        ) from error


@dataclass(frozen=True)
class _Place:
    """Where a frame is kept."""

    path: Path
    index: int
    split: str


class Frames:
    """An opened data set, or one split of it. Frames are read from disk when they are asked for.

    Args:
        card: what card.json holds.
        textures: sRGB bytes; the index is `Frame.landing_object`. An object of one colour has 1 x 1 texels.
        damaged: shards that are missing or corrupt; their frames are left out.
    """

    def __init__(
        self,
        card: dict[str, Any],
        textures: Sequence[UInt8[np.ndarray, "_ _ 3"]],
        damaged: Sequence[str],
        places: Sequence[_Place],
    ):
        self.card, self.textures, self.damaged = card, list(textures), list(damaged)
        self._places = list(places)

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> Frame:
        place = self._places[index]
        return read_frame(place.path, place.index)

    def split(self, name: str) -> "Frames":
        """The frames of one split: train, val, test or generator.

        Raises:
            UserError: unknown name.
        """
        if name not in SPLITS:
            raise UserError(f"There is no split {name}.", f"one of {', '.join(SPLITS)}", "name one of them")
        return Frames(self.card, self.textures, self.damaged, [p for p in self._places if p.split == name])


def read_card(folder: Path) -> dict[str, Any]:
    """The data card.

    Raises:
        UserError: there is none, or it is of another format.
    """
    card = read_json(folder / CARD)
    if card.get("format", 1) != FORMAT:
        raise UserError(
            f"{folder} holds a data set of format {card.get('format', 1)}.",
            f"format {FORMAT}",
            "make it again in an empty folder: catacaustics refract data",
        )
    return card


def open_frames(folder: Path) -> Frames:
    """Open a data set. Shards that are missing or corrupt are named in one warning, and the rest is used.

    Raises:
        UserError: no data set, a texture is missing, or no shard is usable.
    """
    folder = Path(folder)
    card = read_card(folder)
    textures = [read_image_bytes(folder / name, upright=False) for name in card["textures"]]
    places, damaged = [], []
    for shard in card["shards"]:
        path = folder / shard["file"]
        problem = shard_problem(path, shard["sha256"]) if shard["sha256"] else "is not finished"
        if problem:
            damaged.append(shard["file"])
            continue
        places += [_Place(path, i, shard["split"]) for i in range(shard["frames"])]
    again = "run `catacaustics refract data` again with the same settings: it makes what is missing and keeps the rest"
    if not places:
        raise UserError(f"No shard of {folder} is usable.", "one finished shard or more", again)
    if damaged:
        warnings.warn(
            f"{folder}: {len(damaged)} of {len(card['shards'])} shards are missing, unfinished or corrupt and are left "
            f"out: {', '.join(damaged)}. To mend it, {again}.",
            stacklevel=2,
        )
    return Frames(card, textures, damaged, places)
