"""Follow reflected points along the held-out views and draw their trails.

    python tools/track_reflections.py RUN tracks.jpg --truth data_samples/ball

Left the first view with a dot on each point, right the last one with the way that each has gone. On a path-traced
capture the error against the true points of reflection is printed.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro

from catacaustics.editing import reflector_index
from catacaustics.images import write_image
from catacaustics.layers import colorize
from catacaustics.run import named_view, open_run
from catacaustics.tracking import Tracks, draw_dots, follow_points, spread_points, track_errors
from catacaustics.video import camera_path


@dataclass(frozen=True)
class Follow:
    """Follow reflected points.

    Args:
        run: folder that training wrote.
        picture: image file to write.
        count: points to follow, spread over the reflector.
        frames: steps along the path.
        share: of the path that is gone.
        reflector: its name, where there are several.
        truth: the path-traced capture with truth/.
        width: of each picture in pixels.
    """

    run: Annotated[Path, tyro.conf.Positional]
    picture: Annotated[Path, tyro.conf.Positional]
    count: int = 10
    frames: int = 48
    share: float = 0.5
    reflector: str | None = None
    truth: Path | None = None
    width: int = 480


def with_trails(image: np.ndarray, tracks: Tracks) -> np.ndarray:
    """The image with the visible stretches of all tracks, and dots at their ends."""
    picture = (np.clip(image, 0, 1) * 255).astype(np.uint8)
    colors = 255 * colorize((np.arange(len(tracks.points)) + 0.5) / len(tracks.points), "hsv")
    for j, color in enumerate(colors):
        for k in range(len(tracks.pixels) - 1):
            if tracks.visible[k : k + 2, j].all():
                start, end = np.round(16 * (tracks.pixels[k : k + 2, j] - 0.5)).astype(int).tolist()
                cv2.line(picture, tuple(start), tuple(end), tuple(color.tolist()), 1, cv2.LINE_AA, 4)
    return draw_dots(np.float32(picture) / 255, tracks.pixels[-1], tracks.visible[-1])


def main(settings: Follow) -> None:
    run = open_run(settings.run)
    index = reflector_index(run.scene, settings.reflector)
    path = camera_path(run.capture, "held-out", settings.frames, settings.width)
    path = path[: max(2, round(settings.share * len(path)))]
    points = spread_points(run.scene, index, path[0], settings.count)
    tracks = follow_points(run.scene, index, points, path)
    first, last = (run.scene.render(camera).rgb.cpu().numpy() for camera in (path[0], path[-1]))
    both = [draw_dots(first, tracks.pixels[0], tracks.visible[0]), with_trails(last, tracks)]
    write_image(settings.picture, np.concatenate(both, 1), quality=88)
    print(f"{settings.picture}: {len(points)} points, visible in {tracks.visible.mean():.0%} of {len(path)} views")
    if settings.truth is not None:
        errors = track_errors(run, index, tracks, path, 0, named_view(run.capture, None), settings.truth)
        median, high = np.nanpercentile(errors, (50, 95))
        print(f"error against truth: median {median:.2f} px, 95 % {high:.2f} px")


if __name__ == "__main__":
    main(tyro.cli(Follow))
