"""COLMAP models, binary and text, read and written without pycolmap (training must run where it is not installed).

Format: the COLMAP documentation, "Output format". Poses are camera_from_world; quaternions are (w, x, y, z).
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catacaustics.cameras import Camera
from catacaustics.errors import UserError
from catacaustics.files import write_bytes
from catacaustics.geometry import rigid

# (identifier, name, number of parameters); fx fy or f first, then cx cy, then distortion.
_MODELS = [
    (0, "SIMPLE_PINHOLE", 3),
    (1, "PINHOLE", 4),
    (2, "SIMPLE_RADIAL", 4),
    (3, "RADIAL", 5),
    (4, "OPENCV", 8),
    (5, "OPENCV_FISHEYE", 8),
    (6, "FULL_OPENCV", 12),
    (7, "FOV", 5),
    (8, "SIMPLE_RADIAL_FISHEYE", 4),
    (9, "RADIAL_FISHEYE", 5),
    (10, "THIN_PRISM_FISHEYE", 12),
]
_BY_ID = {i: (name, n) for i, name, n in _MODELS}


@dataclass(frozen=True, eq=False)
class ColmapCamera:
    """Intrinsics as COLMAP stores them: model name, size and parameters."""

    model: str
    width: int
    height: int
    params: np.ndarray


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image: file name, camera identifier, camera_from_world (4x4)."""

    name: str
    camera_id: int
    camera_from_world: np.ndarray


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """Cameras by identifier, images in file order, sparse points (n, 3) and their colours (n, 3) in [0, 1]."""

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    points: np.ndarray
    colors: np.ndarray


def _pose(values: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return rigid(Rotation.from_quat(values[[1, 2, 3, 0]]).as_matrix(), values[4:7])


class _Reader:
    def __init__(self, data: bytes):
        self.data, self.offset = data, 0

    def take(self, layout: str) -> tuple:
        values = struct.unpack_from("<" + layout, self.data, self.offset)
        self.offset += struct.calcsize("<" + layout)
        return values

    def name(self) -> str:
        end = self.data.index(b"\0", self.offset)
        text = self.data[self.offset : end].decode()
        self.offset = end + 1
        return text

    def skip(self, size: int) -> None:
        if self.offset + size > len(self.data):
            raise struct.error("file ends early")
        self.offset += size


def _read_binary(folder: Path) -> ColmapModel:
    reader = _Reader((folder / "cameras.bin").read_bytes())
    cameras = {}
    for _ in range(reader.take("Q")[0]):
        camera_id, model_id, width, height = reader.take("iiQQ")
        name, count = _BY_ID[model_id]
        cameras[camera_id] = ColmapCamera(name, width, height, np.array(reader.take("d" * count)))
    reader = _Reader((folder / "images.bin").read_bytes())
    images = []
    for _ in range(reader.take("Q")[0]):
        reader.take("i")
        pose = _pose(np.array(reader.take("7d")))
        camera_id = reader.take("i")[0]
        images.append(ColmapImage(reader.name(), camera_id, pose))
        reader.skip(24 * reader.take("Q")[0])
    points, colors = [], []
    if (folder / "points3D.bin").exists():
        reader = _Reader((folder / "points3D.bin").read_bytes())
        for _ in range(reader.take("Q")[0]):
            _, x, y, z, r, g, b, _ = reader.take("Q3d3Bd")
            points.append((x, y, z))
            colors.append((r, g, b))
            reader.skip(8 * reader.take("Q")[0])
    return ColmapModel(cameras, images, np.array(points).reshape(-1, 3), np.array(colors).reshape(-1, 3) / 255)


def _lines(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


def _read_text(folder: Path) -> ColmapModel:
    cameras = {}
    for line in filter(None, _lines(folder / "cameras.txt")):
        camera_id, model, width, height, *params = line.split()
        cameras[int(camera_id)] = ColmapCamera(model, int(width), int(height), np.array(params, float))
    images = []
    # Two lines an image; the second (its observations) may be empty.
    for line in _lines(folder / "images.txt")[::2]:
        if line:
            words = line.split(maxsplit=9)
            images.append(ColmapImage(words[9], int(words[8]), _pose(np.array(words[1:8], float))))
    points = np.zeros((0, 6))
    if (folder / "points3D.txt").exists():
        rows = [line.split()[1:7] for line in filter(None, _lines(folder / "points3D.txt"))]
        points = np.array(rows, float).reshape(-1, 6)
    return ColmapModel(cameras, images, points[:, :3], points[:, 3:] / 255)


def has_model(folder: Path) -> bool:
    """Whether a folder holds a COLMAP model, binary or text."""
    return any((folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file() for s in (".bin", ".txt"))


def read_model(folder: Path) -> ColmapModel:
    """Read cameras, images and points3D, binary if present, else text.

    Raises:
        UserError: no model, an unknown camera model, or a file that ends early.
    """
    folder = Path(folder)
    if not has_model(folder):
        raise UserError(
            f"There is no COLMAP model in {folder}.",
            "cameras and images as .bin or .txt",
            "point to the folder that holds them (often sparse/0)",
        )
    try:
        return _read_binary(folder) if (folder / "cameras.bin").is_file() else _read_text(folder)
    except (struct.error, KeyError, ValueError, IndexError, FileNotFoundError) as error:
        raise UserError(
            f"The COLMAP model in {folder} is incomplete or corrupt: {error!r}.",
            "complete cameras and images files of a known camera model",
            "delete the folder and calibrate again, or export the model from COLMAP again",
        ) from error


def pinhole_params(camera: ColmapCamera) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy) of an undistorted camera.

    Raises:
        UserError: the camera has distortion; captures hold undistorted photographs.
    """
    if camera.model == "PINHOLE":
        fx, fy, cx, cy = camera.params
    elif camera.model == "SIMPLE_PINHOLE":
        fx, cx, cy = camera.params
        fy = fx
    else:
        raise UserError(
            f"A camera has the model {camera.model}, which has lens distortion.",
            "PINHOLE cameras and undistorted photographs",
            "run `catacaustics calibrate` on this workspace: it undistorts",
        )
    return float(fx), float(fy), float(cx), float(cy)


def write_model(
    folder: Path, views: list[tuple[str, Camera]], points: np.ndarray | None = None, colors: np.ndarray | None = None
) -> None:
    """Write PINHOLE cameras (one per distinct intrinsics), images without observations, and points without tracks."""
    from scipy.spatial.transform import Rotation

    keys: dict[tuple, int] = {}
    image_data = [struct.pack("<Q", len(views))]
    for image_id, (name, c) in enumerate(views, 1):
        camera_id = keys.setdefault((c.width, c.height, c.fx, c.fy, c.cx, c.cy), len(keys) + 1)
        x, y, z, w = Rotation.from_matrix(c.camera_from_world[:3, :3]).as_quat()
        pose = struct.pack("<7d", w, x, y, z, *c.camera_from_world[:3, 3])
        image_data.append(struct.pack("<i", image_id) + pose + struct.pack("<i", camera_id))
        image_data.append(name.encode() + b"\0" + struct.pack("<Q", 0))
    camera_data = [struct.pack("<Q", len(keys))]
    camera_data += [struct.pack("<iiQQ4d", i, 1, *key) for key, i in keys.items()]
    points = np.zeros((0, 3)) if points is None else points
    levels = np.full((len(points), 3), 128) if colors is None else np.clip(colors * 255 + 0.5, 0, 255)
    point_data = [struct.pack("<Q", len(points))]
    for i, (p, level) in enumerate(zip(points, levels.astype(np.uint8), strict=True), 1):
        point_data.append(struct.pack("<Q3d3BdQ", i, *p, *level, 0.0, 0))
    write_bytes(Path(folder) / "cameras.bin", b"".join(camera_data))
    write_bytes(Path(folder) / "images.bin", b"".join(image_data))
    write_bytes(Path(folder) / "points3D.bin", b"".join(point_data))
