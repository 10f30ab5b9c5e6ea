"""Films of a trained scene: a camera path, its frames, one MP4."""

import hashlib
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

import catacaustics
from catacaustics.cameras import Camera, interpolate_path
from catacaustics.capture.dataset import Capture
from catacaustics.config import CameraPath, RenderConfig
from catacaustics.errors import UserError
from catacaustics.images import read_image_bytes, write_image, write_video
from catacaustics.layers import depth_range, layer_image
from catacaustics.run import Run, named_view, open_run, scene_file
from catacaustics.scene import Scene, WarpCamera
from catacaustics.shapes import Float, Int


def render_video(config: RenderConfig) -> Path:
    """Render a scene along a path into an MP4 file and return its path.

    Raises:
        UserError: no finished run, no capture, no such reflector, fewer than two cameras for the path, or settings out
            of range.
    """
    if not config.layers:
        raise UserError("There are no layers to show.", "one or more", "add --layers rgb")
    check_film(config.video, config.width, config.seconds, config.fps, config.quality)
    run = open_run(config.run, config.capture, config.device)
    frames = frame_count(config.seconds, config.fps)
    cameras = camera_path(run.capture, config.path, frames, config.width)
    warps = _warp_cameras(run, cameras, config)
    depths = _path_depths(run.scene, cameras) if "depth" in config.layers else (0.0, 1.0)

    def draw(i: int) -> np.ndarray:
        output = run.scene.render(cameras[i], warp_camera=warps[i])
        return np.concatenate([layer_image(output, layer, depths) for layer in config.layers], 1)

    settings = config.layers, config.warp_offset, config.warp_path, config.warp_reflector
    key = film_key(scene_file(run.folder).read_bytes(), cameras, *settings)
    return write_film(config.video, frames, draw, key, config.fps, config.quality)


def write_film(
    video: Path, count: int, draw: Callable[[int], np.ndarray], key: str, fps: float = 24.0, quality: int = 20
) -> Path:
    """An MP4 file of frames 0 to count - 1 with a progress bar.

    Finished frames are kept as PNG in a folder beside the video until it is complete: drawing goes on where it was
    interrupted.

    Args:
        draw: makes a frame, RGB in [0, 1] or 8-bit; not called for those that are finished.
        key: names everything that a frame's pixels depend on (`film_key`).
        quality: constant rate factor of x264: lower is better.
    """
    video = Path(video)
    folder = video.parent / f"{video.stem}-frames-{key}"
    paths = [folder / f"{i:05d}.png" for i in range(count)]
    finished = sum(path.is_file() for path in paths)
    if finished:
        print(f"video: {finished} of {count} frames are finished already, kept")

    def frames() -> Iterator[np.ndarray]:
        for i, path in enumerate(tqdm(paths, desc="video", unit="frame")):
            if not path.is_file():
                write_image(path, draw(i))
            yield read_image_bytes(path)

    write_video(video, frames(), fps, quality)
    shutil.rmtree(folder, ignore_errors=True)
    print(f"video: {count} frames, {count / fps:.1f} s: {video}")
    return video


def film_key(state: bytes, cameras: Sequence[Camera], *settings: object) -> str:
    """A name for everything that a film's frames depend on: the scene (its file's content), the cameras, and settings
    by their `repr`."""
    digest = hashlib.sha256(state)
    digest.update(repr((catacaustics.__version__, len(cameras), *settings)).encode())
    for c in cameras:
        digest.update(repr((c.width, c.height, c.fx, c.fy, c.cx, c.cy)).encode() + c.camera_from_world.tobytes())
    return digest.hexdigest()[:12]


def frame_count(seconds: float, fps: float) -> int:
    return max(round(seconds * fps), 2)


def camera_path(capture: Capture, path: CameraPath, frames: int, width: int) -> list[Camera]:
    """A film's cameras, one a frame, at its size.

    Raises:
        UserError: the capture has fewer than two cameras for the path.
    """
    if path == "still":
        keys = [named_view(capture, None).camera] * 2
    elif path == "held-out":
        keys = [view.camera for view in capture.held_out]
    else:
        keys = [view.camera for view in capture.train]
        keys = [keys[i] for i in tour_order(np.array([camera.center for camera in keys]))]
    if len(keys) < 2:
        raise UserError(
            f"The path '{path}' of {capture.root} has {len(keys)} cameras.",
            "two or more",
            "choose --path spline, which goes through the training views" if path == "held-out" else "add views",
        )
    width = width & ~1  # H.264 with yuv420p has even sizes
    height = max(round(width * keys[0].height / keys[0].width / 2) * 2, 2)
    return [camera.resized(width, height) for camera in interpolate_path(keys, frames)]


def tour_order(centers: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """An order that visits camera centres without long ways: from the centre farthest from the middle always to the
    nearest one not yet visited, then stretches of the order are reversed while that shortens it (2-opt)."""
    n = len(centers)
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
    order = [int(np.linalg.norm(centers - centers.mean(0), axis=-1).argmax())]
    while len(order) < n:
        reach = distance[order[-1]].copy()
        reach[order] = np.inf
        order.append(int(reach.argmin()))
    tour = np.array(order)
    improved = True
    while improved:
        improved = False
        for i in range(n - 1):
            # Reversing tour[i + 1 : j + 1] replaces the ways (i, i+1), (j, j+1) by (i, j), (i+1, j+1).
            j = np.arange(i + 2, n)
            after = np.minimum(j + 1, n - 1)
            inner = j + 1 < n  # the tour is open: behind its end there is no way to replace
            gain = distance[tour[i], tour[i + 1]] - distance[tour[i], tour[j]]
            gain = gain + inner * (distance[tour[j], tour[after]] - distance[tour[i + 1], tour[after]])
            if len(j) and gain.max() > 1e-9 * distance.max():
                end = int(j[gain.argmax()])
                tour[i + 1 : end + 1] = tour[i + 1 : end + 1][::-1].copy()
                improved = True
    return tour


def check_film(video: Path, width: int, seconds: float, fps: float, quality: int) -> None:
    """Refuse settings that make no film."""
    video = Path(video)
    if video.suffix.lower() != ".mp4":
        raise UserError(
            f"The video {video} does not end in .mp4.", "an MP4 file", f"name it {video.with_suffix('.mp4')}"
        )
    if width < 16 or seconds <= 0 or fps <= 0 or not 0 <= quality <= 51:
        raise UserError(
            f"Width {width}, {seconds} seconds, {fps} frames a second, quality {quality}.",
            "a width of 16 or more, positive seconds and fps, a quality from 0 to 51",
            "correct the value that is out of range",
        )


def _warp_cameras(run: Run, cameras: Sequence[Camera], config: RenderConfig) -> list[WarpCamera]:
    """The cameras that reflections follow, one a frame."""
    offset = np.array(config.warp_offset)
    volumes = run.scene.volumes
    if config.warp_reflector is not None and config.warp_reflector not in [v.name for v in volumes]:
        raise UserError(
            f"The scene has no reflector {config.warp_reflector}.",
            f"one of: {', '.join(v.name for v in volumes) or 'none, it was trained without'}",
            "correct --warp-reflector",
        )
    if config.warp_path is None and not offset.any():
        return [None] * len(cameras)
    followed = cameras
    if config.warp_path is not None:
        followed = camera_path(run.capture, config.warp_path, len(cameras), config.width)
    followed = [camera.displaced(offset) for camera in followed]
    if config.warp_reflector is None:
        return [*followed]
    return [[camera if v.name == config.warp_reflector else None for v in volumes] for camera in followed]


def _path_depths(scene: Scene, cameras: Sequence[Camera]) -> tuple[float, float]:
    """One depth range for the whole film, from a few small renders along the path: colours must not flicker."""
    few = [cameras[i] for i in np.linspace(0, len(cameras) - 1, 5).round().astype(int)]
    ranges = [depth_range(scene.render(c.resized(160, max(round(160 * c.height / c.width), 1)))) for c in few]
    return min(near for near, _ in ranges), max(far for _, far in ranges)
