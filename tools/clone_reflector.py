"""Copy a reflector and show what came of it, side by side.

    python tools/clone_reflector.py RUN cloned.jpg --move -2.2 0 1.5

From left to right: as trained; a copy that mirrors what the original mirrors, as if its surroundings had come along;
the copy turned and smaller; a copy that mirrors the room from where it stands, as a real mirror would.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from catacaustics.editing import clone_reflector, reflector_index
from catacaustics.errors import UserError
from catacaustics.images import write_image
from catacaustics.run import named_view, open_run


@dataclass(frozen=True)
class Clone:
    """Show copies of a run's reflector.

    Args:
        run: folder that training wrote.
        picture: image file to write.
        move: where to, along the view's axes (right, down, forward), in radii of the reflector.
        turn: of the turned copy, in degrees about the vertical axis of the view.
        scale: of the turned copy.
        view: photograph whose camera looks; the first held-out one if none is named.
        reflector: its name, where there are several.
        width: of each picture in pixels.
    """

    run: Annotated[Path, tyro.conf.Positional]
    picture: Annotated[Path, tyro.conf.Positional]
    move: tuple[float, float, float] = (-2.2, 0.0, 1.5)
    turn: float = 90.0
    scale: float = 0.6
    view: str | None = None
    reflector: str | None = None
    width: int = 320


def main(settings: Clone) -> None:
    run = open_run(settings.run)
    scene, index = run.scene, reflector_index(run.scene, settings.reflector)
    camera = named_view(run.capture, settings.view).camera
    camera = camera.resized(settings.width, round(settings.width * camera.height / camera.width))
    axes = camera.camera_from_world[:3, :3]
    shift = scene.volumes[index].radius * np.array(settings.move) @ axes
    turn = Rotation.from_rotvec(np.radians(settings.turn) * axes[1]).as_matrix()
    smaller = clone_reflector(scene, index, shift, turn, settings.scale)
    made = {"as trained": scene, "copied": clone_reflector(scene, index, shift, np.eye(3)), "turned, smaller": smaller}
    try:
        made["surroundings at rest"] = clone_reflector(scene, index, shift, np.eye(3), resting=True)
    except UserError as error:
        print(error)
    pictures = [one.render(camera).rgb.cpu().numpy() for one in made.values()]
    write_image(settings.picture, np.concatenate(pictures, 1), quality=88)
    print(f"{settings.picture}: {', '.join(made)}")


if __name__ == "__main__":
    main(tyro.cli(Clone))
