"""Films of a trained scene: a camera path, its frames, one MP4."""

import hashlib
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

import catacaustics
from catacaustics.cameras import Camera, interpolate_path
from catacaustics.config import RenderConfig
from catacaustics.errors import UserError
from catacaustics.images import read_image_bytes, write_image, write_video
from catacaustics.layers import Layer, depth_range, layer_image
from catacaustics.run import Run, open_run
from catacaustics.scene import RenderOutput, Scene
from catacaustics.shapes import Float, Int


def render_video(config: RenderConfig) -> Path:
    """Render a scene along a path into an MP4 file and return its path.

    Finished frames are kept as PNG in a folder beside the video until it is complete, named after everything that
    decides their pixels (cameras, layers, scene file): the same command goes on where an interrupted one stopped.

    Raises:
        UserError: no finished run, no capture, fewer than two cameras for the path, or settings out of range.
    """
    _check(config)
    run = open_run(config.run, config.capture, config.device)
    cameras = camera_path(run, config)
    video = Path(config.video)
    offset = np.array(config.warp_offset)
    frames = video.parent / f"{video.stem}-frames-{_key(run.folder, cameras, config.layers, offset)}"
    depths = _path_depths(run.scene, cameras) if "depth" in config.layers else (0.0, 1.0)
    count = write_video(
        video, _frames(run.scene, cameras, offset, config.layers, depths, frames), config.fps, config.quality
    )
    shutil.rmtree(frames, ignore_errors=True)
    print(f"video: {count} frames, {count / config.fps:.1f} s: {video}")
    return video


def camera_path(run: Run, config: RenderConfig) -> list[Camera]:
    """The video's cameras, one a frame, at its size."""
    if config.path == "held-out":
        keys = [view.camera for view in run.capture.held_out]
    else:
        keys = [view.camera for view in run.capture.train]
        keys = [keys[i] for i in tour_order(np.array([camera.center for camera in keys]))]
    if len(keys) < 2:
        raise UserError(
            f"The path '{config.path}' of {run.capture.root} has {len(keys)} cameras.",
            "two or more",
            "choose --path spline, which goes through the training views" if config.path == "held-out" else "add views",
        )
    width = config.width & ~1  # H.264 with yuv420p has even sizes
    height = max(round(width * keys[0].height / keys[0].width / 2) * 2, 2)
    path = interpolate_path(keys, max(round(config.seconds * config.fps), 2))
    return [camera.resized(width, height) for camera in path]


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


def _check(config: RenderConfig) -> None:
    video = Path(config.video)
    if video.suffix.lower() != ".mp4":
        raise UserError(
            f"The video {video} does not end in .mp4.", "an MP4 file", f"name it {video.with_suffix('.mp4')}"
        )
    if not config.layers:
        raise UserError("There are no layers to show.", "one or more", "add --layers rgb")
    if config.width < 16 or config.seconds <= 0 or config.fps <= 0 or not 0 <= config.quality <= 51:
        raise UserError(
            f"Width {config.width}, {config.seconds} seconds, {config.fps} frames a second, quality {config.quality}.",
            "a width of 16 or more, positive seconds and fps, a quality from 0 to 51",
            "correct the value that is out of range",
        )


def _key(folder: Path, cameras: Sequence[Camera], layers: Sequence[str], offset: Float[np.ndarray, "3"]) -> str:
    """Names everything that a frame's pixels depend on."""
    digest = hashlib.sha256((folder / "scene.safetensors").read_bytes())
    digest.update(repr((catacaustics.__version__, tuple(layers), len(cameras))).encode())
    digest.update(offset.tobytes())
    for c in cameras:
        digest.update(repr((c.width, c.height, c.fx, c.fy, c.cx, c.cy)).encode() + c.camera_from_world.tobytes())
    return digest.hexdigest()[:12]


def _path_depths(scene: Scene, cameras: Sequence[Camera]) -> tuple[float, float]:
    """One depth range for the whole film, from a few small renders along the path: colours must not flicker."""
    few = [cameras[i] for i in np.linspace(0, len(cameras) - 1, 5).round().astype(int)]
    ranges = [depth_range(_render(scene, c.resized(160, max(round(160 * c.height / c.width), 1)))) for c in few]
    return min(near for near, _ in ranges), max(far for _, far in ranges)


def _render(scene: Scene, camera: Camera, offset: Float[np.ndarray, "3"] | None = None) -> RenderOutput:
    with torch.no_grad():
        moves = offset is not None and offset.any()
        return scene.render(camera, warp_camera=camera.displaced(offset)) if moves else scene.render(camera)


def _frames(
    scene: Scene,
    cameras: Sequence[Camera],
    offset: Float[np.ndarray, "3"],
    layers: Sequence[Layer],
    depths: tuple[float, float],
    folder: Path,
) -> Iterator[np.ndarray]:
    """The film's frames; those in the folder are read, the others rendered and put there."""
    paths = [folder / f"{i:05d}.png" for i in range(len(cameras))]
    finished = sum(path.is_file() for path in paths)
    if finished:
        print(f"video: {finished} of {len(paths)} frames are finished already, kept")
    for path, camera in zip(tqdm(paths, desc="video", unit="frame"), cameras, strict=True):
        if not path.is_file():
            output = _render(scene, camera, offset)
            write_image(path, np.concatenate([layer_image(output, layer, depths) for layer in layers], 1))
        yield read_image_bytes(path)
