"""Edit reflections and show what came of it, side by side.

    python tools/edit_reflections.py RUN edited.jpg --surroundings beach.jpg

From left to right: as trained; reflections that follow a camera to the right of the view's; tinted; erased; mirroring
another place (a drawn sky over a chequered floor, where no latitude-longitude image is given).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from catacaustics.cameras import up_direction
from catacaustics.editing import adjust_reflections, decouple_reflections, reflector_index, replace_surroundings
from catacaustics.errors import UserError
from catacaustics.images import read_image, write_image
from catacaustics.run import named_view, open_run
from catacaustics.scene import Scene


@dataclass(frozen=True)
class Edit:
    """Show edits of a run's reflections.

    Args:
        run: folder that training wrote.
        picture: image file to write.
        view: photograph whose camera looks; the first held-out one if none is named.
        reflector: its name, where there are several.
        offset: of the camera that reflections follow, right, in distances to the reflector.
        tint: colour that reflections are multiplied with.
        surroundings: latitude-longitude image to mirror.
        width: of each picture in pixels.
    """

    run: Annotated[Path, tyro.conf.Positional]
    picture: Annotated[Path, tyro.conf.Positional]
    view: str | None = None
    reflector: str | None = None
    offset: float = 0.4
    tint: tuple[float, float, float] = (1.0, 0.75, 0.35)
    surroundings: Path | None = None
    width: int = 320


def drawn_panorama() -> np.ndarray:
    """A sky over a chequered floor."""
    height, width = 256, 512
    latitude = ((np.arange(height) + 0.5) / height - 0.5)[:, None]
    longitude = ((np.arange(width) + 0.5) / width * 2 * np.pi)[None]
    sky = np.array([0.25, 0.5, 0.9]) + (0.5 + latitude)[..., None] * np.array([1.2, 0.8, 0.1])
    distance = 1 / np.tan(np.maximum(latitude, 1e-3) * np.pi)
    squares = (np.floor(2 * distance * np.cos(longitude)) + np.floor(2 * distance * np.sin(longitude))) % 2
    floor = np.where(squares[..., None] > 0, [0.95, 0.9, 0.8], [0.25, 0.1, 0.1])
    return np.where((latitude < 0)[..., None], np.clip(sky, 0, 1) + 0 * longitude[..., None], floor).astype(np.float32)


def edits(scene: Scene, index: int, settings: Edit, right: np.ndarray, up: np.ndarray) -> dict[str, Scene]:
    """Edited scenes by name; those that the model does not allow are left out, with the reason."""
    panorama = drawn_panorama() if settings.surroundings is None else read_image(settings.surroundings)
    makers = {
        "warp camera moved": lambda: decouple_reflections(scene, index, settings.offset * right),
        "tinted": lambda: adjust_reflections(scene, index, 1.0, settings.tint),
        "erased": lambda: adjust_reflections(scene, index, 0.0),
        "other surroundings": lambda: replace_surroundings(scene, index, panorama, up),
    }
    made = {"as trained": scene}
    for name, make in makers.items():
        try:
            made[name] = make()
        except UserError as error:
            print(f"{name}: {error}")
    return made


def main(settings: Edit) -> None:
    run = open_run(settings.run)
    index = reflector_index(run.scene, settings.reflector)
    camera = named_view(run.capture, settings.view).camera
    camera = camera.resized(settings.width, round(settings.width * camera.height / camera.width))
    distance = np.linalg.norm(run.scene.volumes[index].center - camera.center)
    right = distance * camera.camera_from_world[0, :3]
    made = edits(run.scene, index, settings, right, up_direction([v.camera for v in run.capture.views]))
    pictures = [scene.render(camera).rgb.cpu().numpy() for scene in made.values()]
    write_image(settings.picture, np.concatenate(pictures, 1), quality=88)
    print(f"{settings.picture}: {', '.join(made)}")


if __name__ == "__main__":
    main(tyro.cli(Edit))
