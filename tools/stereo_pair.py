"""Stereo pairs with ever more comfortable reflections: pictures, and what happens to their disparity.

    python tools/stereo_pair.py RUN OUT

Writes OUT/pair_full.jpg and pair_comfortable.jpg (left eye's picture on the left), OUT/anaglyph.jpg (full above
comfortable, for red-cyan glasses), and OUT/disparity.json and prints it as a table.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from catacaustics.files import write_json
from catacaustics.images import write_image
from catacaustics.run import named_view, open_run
from catacaustics.stereo import (
    anaglyph,
    reflection_disparity,
    render_pair,
    side_by_side,
    surface_disparity,
    usual_rig,
)


@dataclass(frozen=True)
class Pair:
    """Measure comfortable stereo on a run.

    Args:
        run: folder that training wrote.
        out: folder to write.
        warp_separations: the reflections' shares of the eye separation.
        separation: between the eyes in world units; a thirtieth of the distance to the screen if none is given.
        view: photograph whose camera stands between the eyes; the first held-out one if none is named.
        width: of one eye's picture in pixels.
    """

    run: Annotated[Path, tyro.conf.Positional]
    out: Annotated[Path, tyro.conf.Positional]
    warp_separations: tuple[float, ...] = (1.0, 0.75, 0.5, 0.25, 0.0)
    separation: float | None = None
    view: str | None = None
    width: int = 480


def main(settings: Pair) -> None:
    run = open_run(settings.run)
    camera = named_view(run.capture, settings.view).camera
    camera = camera.resized(settings.width, round(settings.width * camera.height / camera.width))
    rig = usual_rig(run.scene, camera)
    rig = rig._replace(separation=settings.separation or rig.separation)
    joined = []
    for name, share in (("full", 1.0), ("comfortable", 0.0)):
        left, right = (o.rgb.cpu().numpy() for o in render_pair(run.scene, camera, rig._replace(warp=share)))
        write_image(settings.out / f"pair_{name}.jpg", side_by_side(left, right))
        joined.append(anaglyph(left, right))
    write_image(settings.out / "anaglyph.jpg", np.concatenate(joined, 0))
    measured = {
        f"{share:g}": reflection_disparity(run.scene, camera, rig._replace(warp=share))
        for share in settings.warp_separations
    }
    measured["surface"] = surface_disparity(run.scene, camera, rig._replace(warp=0.0))
    print(f"eyes {rig.separation:.4g} apart, screen at {rig.screen:.4g}, disparity in pixels at {camera.width} wide")
    print(f"{'warp separation':<16}{'5 %':>8}{'median':>8}{'95 %':>8}{'vertical 95 %':>15}")
    for name, d in measured.items():
        print(f"{name:<16}{d.low:>8.2f}{d.median:>8.2f}{d.high:>8.2f}{d.vertical:>15.2f}")
    rows = {name: d._asdict() for name, d in measured.items()}
    write_json(settings.out / "disparity.json", {"rig": rig._asdict(), "disparity": rows})


if __name__ == "__main__":
    main(tyro.cli(Pair))
