"""Photographs at the resolution of a training stage, read when needed, kept while memory allows."""

from collections import OrderedDict
from collections.abc import Callable, Sequence

import numpy as np

from catacaustics.cameras import Camera, Viewport
from catacaustics.capture.dataset import Capture, View
from catacaustics.images import resize
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.shapes import Bool, Float, UInt8


def scaled_camera(camera: Camera, image_size: int, scale: float) -> Camera:
    """The camera at `scale` times the training size: its longer side reduced to `image_size` where it is larger."""
    factor = scale * min(1.0, image_size / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))


def photograph(capture: Capture, view: View, camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """A view's photograph in [0, 1] at a camera's size."""
    return resize(capture.image(view), camera.width, camera.height).astype(np.float32) / 255


class PhotographCache:
    """Reduced photographs as 8-bit arrays, and masks of the same size; the least recently used are dropped beyond
    `limit_bytes`."""

    def __init__(self, capture: Capture, limit_bytes: int = 1 << 30):
        self._capture = capture
        self._limit = limit_bytes
        self._arrays: OrderedDict[tuple[str, str, int, int], np.ndarray] = OrderedDict()
        self._bytes = 0

    def get(self, view: View, width: int, height: int) -> UInt8[np.ndarray, "height width 3"]:
        key = ("photograph", view.name, width, height)
        return self._kept(key, lambda: resize(self._capture.image(view), width, height))

    def masks(
        self, view: View, camera: Camera, volumes: Sequence[ReflectionVolume]
    ) -> Bool[np.ndarray, "volumes height width"]:
        """Where each volume shows in a photograph at a camera's size; volumes are the same in every call."""
        none = np.zeros((0, camera.height, camera.width), bool)
        key = ("masks", view.name, camera.width, camera.height)
        return self._kept(key, lambda: np.stack([v.project_mask(camera) for v in volumes]) if volumes else none)

    def _kept(self, key: tuple[str, str, int, int], make: Callable[[], np.ndarray]) -> np.ndarray:
        if key not in self._arrays:
            self._arrays[key] = make()
            self._bytes += self._arrays[key].nbytes
            while self._bytes > self._limit and len(self._arrays) > 1:
                self._bytes -= self._arrays.popitem(last=False)[1].nbytes
        self._arrays.move_to_end(key)
        return self._arrays[key]


def choose_patch(
    camera: Camera,
    masks: Bool[np.ndarray, "volumes height width"],
    size: int,
    reflector_share: float,
    rng: np.random.Generator,
) -> Viewport:
    """A random square patch inside the image; with probability `reflector_share` its middle lies on a reflector."""
    width, height = min(size, camera.width), min(size, camera.height)
    x, y = rng.uniform(0, camera.width), rng.uniform(0, camera.height)
    if len(masks) and rng.uniform() < reflector_share:
        pixels = np.flatnonzero(masks[rng.integers(len(masks))])
        if len(pixels):
            y, x = divmod(int(pixels[rng.integers(len(pixels))]), camera.width)
    else:
        # Uniform over positions of the patch, not of its middle: corners would be seen too often.
        x = x * (camera.width - width) / camera.width + width / 2
        y = y * (camera.height - height) / camera.height + height / 2
    x0 = int(np.clip(round(x - width / 2), 0, camera.width - width))
    y0 = int(np.clip(round(y - height / 2), 0, camera.height - height))
    return Viewport(x0, y0, width, height)
