"""A stand-in for a trained scene with a known answer: every view is the photograph's colours plus an offset."""

import json
from pathlib import Path

import numpy as np
import torch

from catacaustics.cameras import Camera
from catacaustics.capture.dataset import Capture
from catacaustics.images import resize
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.scene import RenderOutput, Scene


class StandInScene(Scene):
    """Knows the views of a capture by their camera centres; other cameras see one colour.

    Args:
        offset: added to the photographs.
        stop_after: number of renders before a KeyboardInterrupt.
    """

    def __init__(
        self,
        capture: Capture,
        offset: float = 0.0,
        volumes: tuple[ReflectionVolume, ...] = (),
        stop_after: int | None = None,
    ):
        torch.nn.Module.__init__(self)
        self.capture, self.offset, self.volumes, self.stop_after = capture, offset, list(volumes), stop_after
        self.renders = 0

    @property
    def device(self) -> torch.device:
        return torch.device("cpu")

    def render(self, camera: Camera, viewport=None, warp_camera=None) -> RenderOutput:
        if self.renders == self.stop_after:
            raise KeyboardInterrupt
        self.renders += 1
        views = [v for v in self.capture.views if np.allclose(v.camera.camera_from_world, camera.camera_from_world)]
        if views:
            photo = resize(self.capture.image(views[0]), camera.width, camera.height) / np.float32(255)
        else:
            color = 0.5 + 0.2 * np.float32(camera.center / np.linalg.norm(camera.center))
            photo = np.broadcast_to(color, (camera.height, camera.width, 3)).copy()
        rgb = torch.from_numpy(np.float32(photo)) + self.offset
        ones = torch.ones(camera.height, camera.width)
        return RenderOutput(rgb, 0.5 * rgb, 0 * rgb + 0.25, 0.75 * ones, ones, 2 * ones)


def make_run(folder: Path, capture: Capture, **config) -> Path:
    """A run's folder whose scene file only has to be there: tests replace `Scene.load`."""
    folder.mkdir(parents=True)
    (folder / "scene.safetensors").write_bytes(b"stand-in")
    settings = {"capture": str(capture.root), "image_size": 64, "warp": "neural"} | config
    (folder / "config.json").write_text(json.dumps(settings))
    return folder
