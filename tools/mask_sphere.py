"""Masks of a ball: fit one sphere to the circles drawn on three photographs, and paint it in all of them.

    python tools/mask_sphere.py WORKSPACE MASKS --reflector ball --circle VIEW X Y RADIUS --circle ... --circle ...

WORKSPACE is anything that `catacaustics calibrate` takes as calibrated: a COLMAP workspace, a capture, transforms.json.
VIEW is a photograph's name or a part of it that no other has; X, Y and RADIUS are pixels of that photograph. Masks are
MASKS/REFLECTOR/STEM.png at the photographs' size, lens distortion included. Draw circles in views from different sides.

The ball of the mirror_ball photographs (the fit leaves 0.34 px; in the other views its outline is 1 to 3 px off, as
their poses are):

    python tools/mask_sphere.py $CATACAUSTICS_CAPTURES/mirror_ball masks --reflector ball \\
        --circle 003820 518.2 387 93.3 --circle 004246 512.6 382.6 106.3 --circle 004502 510.7 375 100
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

from catacaustics.cameras import Viewport, pixel_centers
from catacaustics.capture.colmap import ColmapImage, ColmapModel
from catacaustics.capture.importers import read_source
from catacaustics.capture.undistort import split_params, undistort_points
from catacaustics.errors import UserError
from catacaustics.geometry import normalize, rigid_inverse
from catacaustics.images import write_image


def find_view(model: ColmapModel, part: str) -> ColmapImage:
    found = [i for i in model.images if part == i.name] or [i for i in model.images if part in i.name]
    if len(found) != 1:
        raise UserError(
            f"{len(found)} photographs have {part} in their names.", "a part of exactly one name", "write more of it"
        )
    return found[0]


def fit_sphere(model: ColmapModel, circles: list[tuple[str, float, float, float]]) -> tuple[np.ndarray, float, float]:
    """Centre, radius and root mean square error in pixels of the sphere whose outlines match circles (view, x, y, r).

    A sphere's outline is the cone of rays at the angle asin(radius / distance) to its centre.
    """
    from scipy.optimize import least_squares

    origins, rays, middles, focals = [], [], [], []
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    for part, x, y, r in circles:
        image = find_view(model, part)
        camera, world_from_camera = model.cameras[image.camera_id], rigid_inverse(image.camera_from_world)
        pixels = np.concatenate([[[x, y]], np.stack([x + r * np.cos(turn), y + r * np.sin(turn)], -1)])
        points = undistort_points(camera, pixels)
        directions = normalize(np.c_[points, np.ones(len(points))]) @ world_from_camera[:3, :3].T
        origins.append(world_from_camera[:3, 3])
        middles.append(directions[0])
        rays.append(directions[1:])
        focals.append(split_params(camera)[0].mean())
    origins, rays, middles, focals = map(np.array, (origins, rays, middles, focals))

    # Start: the point nearest to the rays through the circles' centres, and the mean radius there.
    across = np.eye(3) - middles[:, :, None] * middles[:, None, :]
    start = np.linalg.solve(across.sum(0), (across @ origins[:, :, None]).sum(0))[:, 0]
    sines = np.linalg.norm(np.cross(rays, middles[:, None]), axis=-1).mean(1)
    radius = (np.linalg.norm(start - origins, axis=-1) * sines).mean()

    def errors(sphere: np.ndarray) -> np.ndarray:
        toward = sphere[:3] - origins
        distance = np.linalg.norm(toward, axis=-1, keepdims=True)
        angle = np.arccos(np.clip((rays * (toward / distance)[:, None]).sum(-1), -1, 1))
        return (focals[:, None] * (angle - np.arcsin(np.clip(sphere[3] / distance, -1, 1)))).ravel()

    answer = least_squares(errors, np.r_[start, radius])
    return answer.x[:3], float(answer.x[3]), float(np.sqrt((answer.fun**2).mean()))


def paint(model: ColmapModel, center: np.ndarray, radius: float, grow: float, folder: Path) -> int:
    """Write the sphere's mask in every view that sees it; returns their number."""
    written = 0
    camera_id, rays = None, np.zeros(0)
    for image in tqdm(sorted(model.images, key=lambda i: i.camera_id), "paint", unit="mask"):
        camera = model.cameras[image.camera_id]
        if image.camera_id != camera_id:
            camera_id, pixels = image.camera_id, pixel_centers(Viewport(0, 0, camera.width, camera.height))
            points = undistort_points(camera, pixels.reshape(-1, 2))
            rays = normalize(np.c_[points, np.ones(len(points))]).reshape(*pixels.shape[:2], 3)
        toward = image.camera_from_world[:3, :3] @ center + image.camera_from_world[:3, 3]
        distance = np.linalg.norm(toward)
        limit = np.arcsin(min(radius / distance, 1)) + grow / split_params(camera)[0].mean()
        mask = rays @ (toward / distance) >= np.cos(limit)  # rays outside the lens are NaN: not in the mask
        if mask.any():
            write_image(folder / Path(image.name).with_suffix(".png"), mask)
            written += 1
    return written


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("masks", type=Path)
    parser.add_argument("--reflector", default="ball")
    parser.add_argument("--circle", nargs=4, action="append", required=True, metavar=("VIEW", "X", "Y", "RADIUS"))
    parser.add_argument("--grow", type=float, default=0, help="pixels added around the outline")
    options = parser.parse_args(arguments)
    model, _ = read_source(options.workspace)
    circles = [(view, float(x), float(y), float(r)) for view, x, y, r in options.circle]
    if len(circles) < 2:
        parser.error("draw circles in 2 or more views, better 3")
    center, radius, error = fit_sphere(model, circles)
    print(f"sphere at {np.round(center, 4).tolist()}, radius {radius:.4f}; outlines to {error:.2f} px (RMS)")
    count = paint(model, center, radius, options.grow, options.masks / options.reflector)
    print(f"{count} of {len(model.images)} views see it; masks in {options.masks / options.reflector}")


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
