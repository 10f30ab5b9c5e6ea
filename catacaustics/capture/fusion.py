"""Depth and normal maps in a COLMAP dense workspace, fused by COLMAP into one oriented cloud.

images/ NAME                          photographs at the size of the maps
sparse/                               PINHOLE cameras, and points whose tracks say which views overlap
stereo/patch-match.cfg, fusion.cfg    names of the views
stereo/depth_maps/NAME.KIND.bin       depth z, 0 where there is none;  KIND: photometric or geometric
stereo/normal_maps/NAME.KIND.bin      unit normals in camera coordinates
masks/NAME.png                        black = no points from here
"""

import contextlib
import shutil
from pathlib import Path

import numpy as np

from catacaustics.cameras import Camera
from catacaustics.errors import UserError
from catacaustics.files import atomic_path, write_bytes, write_text
from catacaustics.points import PointCloud, read_ply
from catacaustics.shapes import Float


def import_pycolmap():
    """The pycolmap module.

    Raises:
        UserError: it is not installed or does not load.
    """
    try:
        import pycolmap
    except (ImportError, OSError) as error:
        raise UserError(
            f"pycolmap cannot be loaded: {error}.",
            "pycolmap 3.12 or newer, which fuses the depth maps",
            'pip install "pycolmap>=3.12"',
        ) from error
    return pycolmap


def write_map(path: Path, array: Float[np.ndarray, "height width *channels"]) -> None:
    """Write a depth or normal map in COLMAP's format: "width&height&channels&", then float32, channel by channel."""
    array = array[..., None] if array.ndim == 2 else array
    height, width, channels = array.shape
    data = np.ascontiguousarray(array.transpose(2, 0, 1), "<f4").tobytes()
    write_bytes(path, f"{width}&{height}&{channels}&".encode() + data)


def read_map(path: Path) -> Float[np.ndarray, "height width *channels"]:
    """Read a map written by COLMAP or `write_map`.

    Raises:
        UserError: the file is incomplete.
    """
    data = Path(path).read_bytes()
    try:
        width, height, channels, values = data.split(b"&", 3)
        array = np.frombuffer(values, "<f4").reshape(int(channels), int(height), int(width))
    except ValueError as error:
        raise UserError(
            f"The depth map {path} is incomplete ({len(data)} bytes).",
            "a complete COLMAP array",
            "delete it and run the same command again",
        ) from error
    return array[0] if len(array) == 1 else array.transpose(1, 2, 0)


def map_paths(workspace: Path, name: str, kind: str = "photometric") -> tuple[Path, Path]:
    """Paths of a view's depth map and normal map."""
    stereo = Path(workspace) / "stereo"
    return stereo / "depth_maps" / f"{name}.{kind}.bin", stereo / "normal_maps" / f"{name}.{kind}.bin"


def in_frame(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether points are in a camera's frame, their pixels and depths."""
    pixels, depth = camera.project(points)
    inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels < [camera.width, camera.height]).all(-1)
    return inside, pixels, depth


def look_up(depth_map: np.ndarray, camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A depth map's values where points are seen (0 where they are not, or it has none), and the points' depths."""
    inside, pixels, depth = in_frame(camera.resized(depth_map.shape[1], depth_map.shape[0]), points)
    columns, rows = np.where(inside[..., None], pixels, 0).astype(int).T
    return np.where(inside, depth_map[rows, columns], 0), depth


def write_overlap_model(workspace: Path, views: list[tuple[str, Camera]], points: Float[np.ndarray, "n 3"]) -> None:
    """Write the workspace's model: every point is tracked in every view that has it in its frame.

    COLMAP takes from the tracks which views to compare, hence points without tracks are of no use to it.
    """
    pycolmap = import_pycolmap()
    model = pycolmap.Reconstruction()
    tracks = [pycolmap.Track() for _ in points]
    for number, (name, camera) in enumerate(views, 1):
        parameters = [camera.fx, camera.fy, camera.cx, camera.cy]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model="PINHOLE", width=camera.width, height=camera.height, params=parameters, camera_id=number
            )
        )
        seen, pixels, _ = in_frame(camera, points)
        inside = np.flatnonzero(seen)
        image = pycolmap.Image(name=name, keypoints=pixels[inside], camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera.camera_from_world[:3]))
        for place, index in enumerate(inside):
            tracks[index].add_element(number, place)
    for point, track in zip(points, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(point, track, np.zeros(3, np.uint8))
    folder = Path(workspace) / "sparse"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    model.write_binary(str(folder))
    names = [name for name, _ in views]
    write_text(Path(workspace) / "stereo" / "fusion.cfg", "\n".join(names) + "\n")
    patch_match = "".join(f"{name}\n__auto__, 20\n" for name in names)
    write_text(Path(workspace) / "stereo" / "patch-match.cfg", patch_match)


def fuse_maps(
    workspace: Path, kind: str, min_views: int, max_depth_error: float, max_normal_error: float
) -> PointCloud:
    """Fuse the maps of a workspace (COLMAP's stereo fusion): points that enough views agree on.

    Args:
        kind: "photometric" or "geometric".
        min_views: views that must agree on a point.
        max_depth_error: relative difference of depth, max_normal_error: angle in degrees, at which views agree.
    """
    pycolmap = import_pycolmap()
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = min_views
    options.max_depth_error = max_depth_error
    options.max_normal_error = max_normal_error
    # With several threads the result depends on their order.
    options.num_threads = 1
    masks = Path(workspace) / "masks"
    if masks.is_dir():
        options.mask_path = str(masks)
    fused = Path(workspace) / "fused.ply"
    with atomic_path(fused) as temporary, _quiet(pycolmap):
        pycolmap.stereo_fusion(temporary, workspace, input_type=kind, options=options, output_type="PLY")
        temporary.with_name(temporary.name + ".vis").unlink(missing_ok=True)
    return read_ply(fused)


@contextlib.contextmanager
def _quiet(pycolmap):
    """Silence COLMAP's progress messages; its warnings and errors still show."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = max(level, 1)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def remove_contradicted(
    cloud: PointCloud, workspace: Path, kind: str, views: list[tuple[str, Camera]], tolerance: float = 0.03
) -> PointCloud:
    """Drop points that float in empty space: more views see through them than see them.

    Args:
        views: names and cameras of the maps.
        tolerance: relative difference from a view's depth up to which it sees the point.
    """
    balance = np.zeros(len(cloud), int)
    positions = cloud.positions.astype(np.float64)
    for name, camera in views:
        seen, depth = look_up(read_map(map_paths(workspace, name, kind)[0]), camera, positions)
        ratio = seen[seen > 0] / depth[seen > 0]
        balance[seen > 0] += (np.abs(ratio - 1) < tolerance).astype(int) - (ratio >= 1 + tolerance)
    return cloud.select(balance >= 0)


def fill_holes(cloud: PointCloud, others: PointCloud, reach: float = 2.0) -> PointCloud:
    """A cloud and, after its points, those of another one that lie where it has none: farther from its nearest point
    than `reach` times that point's distance to its 8th neighbour."""
    from scipy.spatial import KDTree

    if len(cloud) <= 8 or not len(others):
        return cloud
    tree = KDTree(cloud.positions)
    distance, nearest = tree.query(others.positions)
    spacing = tree.query(cloud.positions[nearest], 9)[0][:, 8]
    return cloud.joined(others.select(distance > reach * spacing))


def remove_outliers(cloud: PointCloud, neighbors: int = 20, deviations: float = 2.0) -> PointCloud:
    """Drop points that lie farther from their nearest neighbours than is usual: Open3D's statistical outliers.

    Open3D's wheels do not load on systems without libusb and libGL; there SciPy finds the same points.
    """
    if len(cloud) <= neighbors:
        return cloud
    positions = cloud.positions.astype(np.float64)
    try:
        import open3d as o3d
    except (ImportError, OSError):
        return cloud.select(_usual_distance(positions, neighbors, deviations))
    _, kept = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(positions)).remove_statistical_outlier(
        neighbors, deviations
    )
    return cloud.select(np.asarray(kept, dtype=np.int64))


def _usual_distance(positions: Float[np.ndarray, "n 3"], neighbors: int, deviations: float) -> np.ndarray:
    """Whether the mean distance to the nearest points, itself included, is at most so many deviations over the mean."""
    from scipy.spatial import KDTree

    distance = KDTree(positions).query(positions, neighbors)[0].mean(1)
    return distance < distance.mean() + deviations * distance.std(ddof=1)
