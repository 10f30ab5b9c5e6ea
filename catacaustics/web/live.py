"""`catacaustics train`, with `--view` beside a viewer of the scene in training.

The training hands over a copy of its scene now and then, and only while a window looks on. Copying and drawing may take
a tenth of the time, so that watching costs the training about as much.
"""

import copy
import time
import traceback
from functools import partial
from pathlib import Path

from catacaustics.capture.dataset import Capture, open_capture
from catacaustics.config import TrainConfig
from catacaustics.scene import Scene
from catacaustics.training.train import train

_SECONDS = 3.0
"""Least time between two copies."""
_SHARE = 0.1
"""Of the time that may go into copying and drawing."""


class LiveView:
    """A viewer that shows copies of a scene in training.

    Args:
        port, browser: as in `catacaustics view`.
        image_size: longer side of a still picture in pixels.
    """

    def __init__(self, capture: Capture, folder: Path, image_size: int, port: int = 8643, browser: bool = True):
        # Not for every training: what serves pages need not be installed where nobody looks.
        from catacaustics.web.viewer import Viewer, serve

        self.server, address = serve(port, browser)
        self.viewer: Viewer | None = None
        self.start = partial(Viewer, self.server, capture=capture, folder=Path(folder), image_size=image_size)
        self.due = 0.0
        self.copies = 0
        print(f"Viewer of the training, as soon as it has a scene:\n\n    {address}\n", flush=True)

    def watch(self, scene: Scene) -> None:
        """Show the scene as it is now, if it is time to and somebody looks. Never stops the training."""
        start = time.monotonic()
        if start < self.due or (self.viewer is not None and not self.viewer.windows):
            return
        drawing = self.viewer.drawing_seconds if self.viewer is not None else 0.0
        try:
            snapshot = copy.deepcopy(scene).requires_grad_(False)
            if self.viewer is None:
                self.viewer = self.start(scene=snapshot)
            else:
                self.viewer.show(snapshot)
        except Exception:  # whatever goes wrong with the window, hours of training go on
            traceback.print_exc()
            print("the viewer stays as it is; the training goes on")
            self.due = float("inf")
            return
        self.copies += 1
        now = time.monotonic()
        self.due = now + max(_SECONDS, (now - start + drawing) / _SHARE)

    def close(self) -> None:
        if self.viewer is not None:
            self.viewer.close()
        self.server.stop()


def train_in_view(config: TrainConfig) -> Scene:
    """`train`; with `config.view` in view of the browser until it ends.

    Raises:
        UserError, KeyboardInterrupt: as `train`.
    """
    if not config.view:
        return train(config)
    live = LiveView(open_capture(config.capture), config.run, min(config.image_size, 800))
    try:
        return train(config, live.watch)
    finally:
        live.close()
