"""Photographs at the resolution of a training stage, read when needed, kept while memory allows."""

from collections import OrderedDict

import numpy as np

from catacaustics.cameras import Camera, Viewport
from catacaustics.capture.dataset import Capture, View
from catacaustics.images import resize
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.shapes import Float, UInt8


def scaled_camera(camera: Camera, image_size: int, scale: float) -> Camera:
    """The camera at `scale` times the training size: its longer side reduced to `image_size` where it is larger."""
    factor = scale * min(1.0, image_size / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))


def photograph(capture: Capture, view: View, camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """A view's photograph in [0, 1] at a camera's size."""
    return resize(capture.image(view), camera.width, camera.height).astype(np.float32) / 255


class PhotographCache:
    """Reduced photographs as 8-bit arrays; the least recently used are dropped beyond `limit_bytes`."""

    def __init__(self, capture: Capture, limit_bytes: int = 1 << 30):
        self._capture = capture
        self._limit = limit_bytes
        self._images: OrderedDict[tuple[str, int, int], np.ndarray] = OrderedDict()
        self._bytes = 0

    def get(self, view: View, width: int, height: int) -> UInt8[np.ndarray, "height width 3"]:
        key = (view.name, width, height)
        if key not in self._images:
            image = resize(self._capture.image(view), width, height)
            self._images[key] = image
            self._bytes += image.nbytes
            while self._bytes > self._limit and len(self._images) > 1:
                self._bytes -= self._images.popitem(last=False)[1].nbytes
        self._images.move_to_end(key)
        return self._images[key]


def choose_patch(
    camera: Camera, volumes: list[ReflectionVolume], size: int, reflector_share: float, rng: np.random.Generator
) -> Viewport:
    """A random square patch inside the image; with probability `reflector_share` its middle lies on a reflector."""
    width, height = min(size, camera.width), min(size, camera.height)
    x, y = rng.uniform(0, camera.width), rng.uniform(0, camera.height)
    if volumes and rng.uniform() < reflector_share:
        mask = volumes[rng.integers(len(volumes))].project_mask(camera)
        rows, columns = np.nonzero(mask)
        if len(rows):
            pick = rng.integers(len(rows))
            x, y = columns[pick], rows[pick]
    else:
        # Uniform over positions of the patch, not of its middle: corners would be seen too often.
        x = x * (camera.width - width) / camera.width + width / 2
        y = y * (camera.height - height) / camera.height + height / 2
    x0 = int(np.clip(round(x - width / 2), 0, camera.width - width))
    y0 = int(np.clip(round(y - height / 2), 0, camera.height - height))
    return Viewport(x0, y0, width, height)
