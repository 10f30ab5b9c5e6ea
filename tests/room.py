"""A small synthetic scene for tests of calibration: a textured corner of a box, photographed with exact cameras."""

from pathlib import Path

import numpy as np

from catacaustics.cameras import Camera, Viewport, pixel_centers
from catacaustics.geometry import look_at
from catacaustics.images import write_image


def texture(size: int, seed: int) -> np.ndarray:
    """Noise at several scales, RGB in [0, 1]."""
    import cv2

    rng = np.random.default_rng(seed)
    result = np.zeros((size, size, 3), np.float32)
    for cells, weight in ((24, 0.5), (64, 0.8), (128, 0.6)):
        noise = rng.random((cells, cells, 3)).astype(np.float32)
        result += weight * cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip((result - result.min()) / np.ptp(result), 0, 1)


def cameras(count: int = 8, width: int = 320, height: int = 240, focal: float = 280.0) -> list[Camera]:
    """On an arc in front of the corner at the origin, at two heights, 9 degrees apart."""
    result = []
    for k in range(count):
        angle = np.radians(45 + 9 * (k - (count - 1) / 2))
        eye = 3.2 * np.array([np.cos(angle), np.sin(angle), 0.5 + 0.12 * (k % 2)])
        target = np.array([0.5, 0.5, 0.6])
        pose = look_at(eye, target, np.array([0.0, 0.0, 1.0]))
        result.append(Camera(width, height, focal, focal, width / 2, height / 2, pose))
    return result


def render(camera: Camera, textures: list[np.ndarray], supersample: int = 2) -> np.ndarray:
    """The planes x = 0, y = 0 and z = 0, each 4 units wide, as seen by a camera; float RGB."""
    import cv2

    big = camera.resized(camera.width * supersample, camera.height * supersample)
    rays = big.ray_directions(pixel_centers(Viewport(0, 0, big.width, big.height)))
    best = np.full(rays.shape[:2], np.inf)
    image = np.full((*rays.shape[:2], 3), 0.5, np.float32)
    for axis, picture in enumerate(textures):
        with np.errstate(divide="ignore"):
            t = -camera.center[axis] / rays[..., axis]
        t = np.where(t > 0, t, np.inf)
        nearer = t < best
        hit = camera.center + rays * np.where(np.isfinite(t), t, 0)[..., None]
        u, v = (hit[..., i] for i in range(3) if i != axis)
        scale = picture.shape[0] / 8
        sample = cv2.remap(
            picture,
            ((u + 4) * scale).astype(np.float32),
            ((v + 4) * scale).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )
        image = np.where(nearer[..., None], sample, image)
        best = np.where(nearer, t, best)
    return cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def photographs(folder: Path, views: list[Camera], brightness: float = 1.0) -> None:
    """Write photographs of the corner as view_00.jpg ..."""
    textures = [texture(1024, seed) for seed in range(3)]
    for k, camera in enumerate(views):
        write_image(folder / f"view_{k:02d}.jpg", brightness * render(camera, textures))
