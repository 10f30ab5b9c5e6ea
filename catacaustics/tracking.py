"""Tracks of reflected points: where what a mirror shows goes when the camera moves.

A track follows one source point of a reflection cloud. The warp says where each view shows it; it is visible where it
has a share of the picture there. On path-traced captures the truth is the same thing's true point of reflection.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from catacaustics.cameras import Camera, Viewport, pixel_centers
from catacaustics.capture.dataset import Capture, View, open_capture
from catacaustics.capture.truth import read_reflectors, read_truth, truth_path
from catacaustics.config import TrackConfig
from catacaustics.editing import reflector_index
from catacaustics.errors import UserError
from catacaustics.files import write_json, write_text
from catacaustics.geometry import Similarity, fit_similarity
from catacaustics.images import to_bytes, write_image
from catacaustics.layers import colorize
from catacaustics.reflectors.quadric import specular_points
from catacaustics.run import Run, named_view, open_run, scene_file
from catacaustics.scene import ReflectionDisks, Scene
from catacaustics.shapes import Bool, Float, Int, UInt8
from catacaustics.splatting import points_in_view, splat_points
from catacaustics.video import camera_path, check_film, film_key, frame_count, write_film

_INSIDE = 0.5
"""Weight of reflections from which a pixel belongs to a reflector."""


class Tracks(NamedTuple):
    """Points (rows of a reflection cloud), and for each view where they are displayed (x, y; nan where not at all),
    their weights in the picture there, and whether they are visible."""

    points: Int[np.ndarray, "t"]
    pixels: Float[np.ndarray, "views t 2"]
    weights: Float[np.ndarray, "views t"]
    visible: Bool[np.ndarray, "views t"]


def blending_weights(
    scene: Scene,
    index: int,
    camera: Camera,
    pixel: Float[np.ndarray, "2"],
    disks: Sequence[ReflectionDisks] | None = None,
) -> tuple[Int[torch.Tensor, "k"], Float[torch.Tensor, "k"]]:
    """Rows of reflection cloud `index` near a pixel, and each point's share alpha_i T_i of the reflections there, by
    the derivative of the picture with respect to what the points show. Nearer reflectors hide it.

    Args:
        disks: all reflectors' `Scene.reflection_disks` in this view, where they are at hand.
    """
    x, y = np.floor(pixel).astype(int).tolist()
    viewport = Viewport(x, y, 1, 1)
    disks = disks or _all_disks(scene, camera)
    through = 1.0
    for i in scene.reflector_order(camera):
        near = points_in_view(disks[i].positions, disks[i].footprints, camera, viewport, scene.splatting)
        rows, positions, normals, footprints, opacities, _ = (t[near] for t in disks[i])
        shown = torch.ones(len(near), 1, device=scene.device, requires_grad=i == index)
        output = splat_points(positions, normals, footprints, opacities, shown, camera, viewport, scene.splatting)
        if i == index:
            (weights,) = torch.autograd.grad(output.image.sum(), shown)
            return rows, through * weights[:, 0]
        through *= float(output.transmittance)
    raise ValueError(f"the scene has no reflector {index}")


def _all_disks(scene: Scene, camera: Camera) -> list[ReflectionDisks]:
    with torch.no_grad():
        return [scene.reflection_disks(i, camera) for i in range(len(scene.volumes))]


def point_at(
    scene: Scene,
    index: int,
    camera: Camera,
    pixel: Float[np.ndarray, "2"],
    disks: Sequence[ReflectionDisks] | None = None,
) -> int:
    """The point with the largest weight at a pixel; `disks` as for `blending_weights`.

    Raises:
        UserError: the pixel lies outside the image or shows no reflection.
    """
    rows, weights = np.zeros(0), np.zeros(0)
    if (pixel >= 0).all() and (pixel < [camera.width, camera.height]).all():
        rows, weights = blending_weights(scene, index, camera, pixel, disks)
    if not len(rows) or float(weights.max()) <= 0:
        raise UserError(
            f"Nothing is reflected by {scene.volumes[index].name} at pixel {pixel[0]:g}, {pixel[1]:g}.",
            f"a pixel on the reflector, in a picture of {camera.width} x {camera.height}",
            "choose another pixel (see tracks.jpg of a run without --pixels), or leave --pixels out",
        )
    return int(rows[int(weights.argmax())])


def spread_points(scene: Scene, index: int, camera: Camera, count: int, least_weight: float = 0.05) -> list[int]:
    """At most `count` visible points, spread over a reflector: at pixels that are each as far from the others and from
    the rim as can be.

    Raises:
        UserError: the view does not show the reflector.
    """
    inside = _reflecting(scene, index, camera)
    free = pixel_centers(camera.viewport)[inside]
    rim = pixel_centers(camera.viewport)[~inside]
    if not len(free) or not len(rim):
        raise UserError(
            f"The view does not show the reflector {scene.volumes[index].name}.",
            "a view with the reflector in it",
            "choose another view with --view",
        )
    from scipy.spatial import KDTree

    room = KDTree(rim).query(free)[0]
    disks, chosen = _all_disks(scene, camera), list[int]()
    for _ in range(20 * count):
        pixel = free[room.argmax()]
        room = np.minimum(room, np.linalg.norm(free - pixel, axis=1))
        point = point_at(scene, index, camera, pixel, disks)
        if point not in chosen and _images(scene, index, camera, point, disks)[1].max(initial=0) >= least_weight:
            chosen.append(point)
        if len(chosen) == count or room.max() < 1:
            break
    return chosen


def _images(
    scene: Scene, index: int, camera: Camera, point: int, disks: Sequence[ReflectionDisks]
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k"]]:
    """Pixels of a point's images, and its share of the reflections at each; 0 outside the picture."""
    positions = disks[index].positions[disks[index].rows == point].cpu().numpy().astype(np.float64)
    pixels = camera.project(positions)[0]
    weights = np.zeros(len(pixels))
    for i in np.flatnonzero(((pixels >= 0) & (pixels < [camera.width, camera.height])).all(1)):
        rows, shares = blending_weights(scene, index, camera, pixels[i], disks)
        weights[i] = float(shares[rows == point].sum())
    return pixels, weights


def _reflecting(scene: Scene, index: int, camera: Camera) -> Bool[np.ndarray, "height width"]:
    """Pixels where a reflector shows reflections."""
    with torch.no_grad():
        layers = scene.layers(camera)
        weight = layers.rho * (1 - layers.reflection_transmittance)
    return (weight.cpu().numpy() > _INSIDE) & scene.volumes[index].project_mask(camera)


def follow_points(
    scene: Scene, index: int, points: Sequence[int], cameras: Sequence[Camera], least_weight: float = 0.05
) -> Tracks:
    """Where views show points of reflection cloud `index`; where a mirror shows several images of a point, that with
    the largest share of the reflections, and from then on the one nearest to where it was.

    Args:
        least_weight: a point is visible where it has this share of the reflections at its middle's pixel, and that
            pixel lies in the reflector.
    """
    from tqdm import tqdm

    count = len(points)
    pixels = np.full((len(cameras), count, 2), np.nan)
    weights = np.zeros((len(cameras), count))
    visible = np.zeros((len(cameras), count), bool)
    last = np.full((count, 2), np.nan)
    for k, camera in enumerate(tqdm(cameras, desc="tracks", unit="view")):
        inside = _reflecting(scene, index, camera)
        disks = _all_disks(scene, camera)
        for j, point in enumerate(points):
            places, shares = _images(scene, index, camera, point, disks)
            if len(places):
                near = np.linalg.norm(places - last[j], axis=1)
                image = near.argmin() if np.isfinite(last[j]).all() else shares.argmax()
                pixels[k, j], weights[k, j] = places[image], shares[image]
                last[j] = places[image]
            if weights[k, j] >= max(least_weight, 1e-9):
                x, y = np.floor(pixels[k, j]).astype(int)
                visible[k, j] = inside[y, x]
    return Tracks(np.array(points, np.int64), pixels, weights, visible)


# Truth of path-traced captures


def sources_at(truth_root: Path, view: View, pixels: Float[np.ndarray, "t 2"], width: int) -> Float[np.ndarray, "t 3"]:
    """World positions of what is mirrored at pixels of a path-traced view `width` pixels wide: interpolated between
    pixel centres where those show one surface, else the nearest; nan where nothing is."""
    sources = read_truth(truth_root, view.name).source
    height, own_width = sources.shape[:2]
    place = pixels * own_width / width - 0.5
    low = np.floor(np.nan_to_num(place)).astype(int)
    part = place - low
    corners, shares = [], []
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = (low + [dx, dy]).T
        outside = (x < 0) | (x >= own_width) | (y < 0) | (y >= height)
        corner = sources[np.clip(y, 0, height - 1), np.clip(x, 0, own_width - 1)]
        corners.append(np.where(outside[:, None], np.nan, corner))
        shares.append(np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1]))
    four, share = np.stack(corners), np.stack(shares)
    nearest = four[share.argmax(0), np.arange(len(pixels))]
    blended = (share[..., None] * four).sum(0)
    smooth = np.linalg.norm(four - blended, axis=-1).max(0) < 0.2 * np.linalg.norm(nearest - blended.mean(0), axis=-1)
    return np.where((smooth & np.isfinite(blended).all(1))[:, None], blended, nearest)


def run_from_truth(run: Capture, truth: Capture) -> Similarity:
    """From the coordinates of a path-traced capture to those of a calibration of its photographs.

    Raises:
        UserError: fewer than three views in common.
    """
    centers = {Path(v.name).stem: v.camera.center for v in truth.views}
    pairs = [(centers[stem], v.camera.center) for v in run.views if (stem := Path(v.name).stem) in centers]
    if len(pairs) < 3:
        raise UserError(
            f"{truth.root} and {run.root} have {len(pairs)} views in common.",
            "the path-traced capture that the run was trained on",
            "correct --truth",
        )
    return fit_similarity(*(np.array(side) for side in zip(*pairs, strict=True)))


def true_pixels(
    geometry: dict[str, Any], sources: Float[np.ndarray, "t 3"], camera: Camera, run_from_truth: Similarity
) -> Float[np.ndarray, "t 2"]:
    """Where an analytic mirror (truth/reflectors.json) shows world positions to a camera; nan where it does not.
    Objects between are left out of account.

    Args:
        sources: in the coordinates of the truth, as the geometry.
        camera: in the run's.

    Raises:
        UserError: the mirror is neither a sphere, an ellipsoid nor a plane.
    """
    points = run_from_truth.apply(sources)
    center = camera.center
    if geometry["type"] == "plane":
        corners = run_from_truth.apply(np.array(geometry["corners"], float))
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        heights, own = (points - corners[0]) @ normal, (center - corners[0]) @ normal
        positions, visible = points - 2 * heights[:, None] * normal, heights * own > 0
    elif geometry["type"] in ("sphere", "ellipsoid"):
        axes = np.eye(3) * geometry["radius"] if "radius" in geometry else None
        if axes is None:
            axes = np.array(geometry["rotation"], float) @ np.diag(geometry["radii"])
        axes = run_from_truth.scale * run_from_truth.rotation @ axes
        middle = run_from_truth.apply(np.array(geometry["center"], float)[None])[0]
        tensors = [torch.from_numpy(np.ascontiguousarray(a)) for a in (points, center, middle, axes)]
        found = specular_points(tensors[0], tensors[1], tensors[2], tensors[3])
        assert found.visible is not None  # solved anew
        positions, visible = found.points.numpy(), found.visible.numpy()
    else:
        raise UserError(
            f"The true mirror is a {geometry['type']}.",
            "a sphere, an ellipsoid or a plane",
            "leave --truth out: tracks on other mirrors cannot be measured",
        )
    pixels, depth = camera.project(positions)
    seen = visible & (depth > 0) & np.isfinite(points).all(1)
    return np.where(seen[:, None], pixels, np.nan)


def track_errors(
    run: Run, index: int, tracks: Tracks, cameras: Sequence[Camera], first: int, view: View, truth_root: Path
) -> Float[np.ndarray, "views t"]:
    """Distances in pixels between tracks and the true places of what the points show in the first view; nan where a
    point or its truth is not visible.

    Args:
        first: the index among `cameras` of the view that has truth, for which `view` stands.
    """
    truth = open_capture(truth_root)
    similarity = run_from_truth(run.capture, truth)
    own = next(v for v in truth.views if Path(v.name).stem == Path(view.name).stem)
    geometry = read_reflectors(truth_root)[run.scene.volumes[index].name]
    sources = sources_at(truth_root, own, tracks.pixels[first], cameras[first].width)
    true = np.stack([true_pixels(geometry, sources, camera, similarity) for camera in cameras])
    return np.where(tracks.visible, np.linalg.norm(tracks.pixels - true, axis=-1), np.nan)


# Pictures


def draw_dots(
    image: Float[np.ndarray, "height width 3"],
    pixels: Float[np.ndarray, "t 2"],
    visible: Bool[np.ndarray, "t"],
    radius: float | None = None,
) -> UInt8[np.ndarray, "height width 3"]:
    """The image with a coloured dot on each visible point; a point has the same colour in every picture."""
    import cv2

    size = radius or max(image.shape[1] / 110, 2.0)
    picture = np.ascontiguousarray(to_bytes(image))
    colors = 255 * colorize((np.arange(len(pixels)) + 0.5) / max(len(pixels), 1), "hsv")
    for pixel, color in zip(pixels[visible], colors[visible], strict=True):
        place = tuple(np.round((pixel - 0.5) * 16).astype(int).tolist())
        for extent, shade in ((size + 1, (0.0, 0.0, 0.0)), (size, tuple(color.tolist()))):
            cv2.circle(picture, place, round(extent * 16), shade, -1, cv2.LINE_AA, 4)
    return picture


def track(config: TrackConfig) -> None:
    """Write OUT/tracks.csv, tracks.json, tracks.jpg and tracks.mp4; with truth, print the error in pixels.

    Raises:
        UserError: no such run, reflector or view, points that are not there, or settings out of range.
    """
    out, film = Path(config.out), Path(config.out) / "tracks.mp4"
    check_film(film, config.width, config.seconds, config.fps, config.quality)
    if len(config.pixels) % 2 or config.count < 1 or not 0 <= config.least_weight <= 1:
        raise UserError(
            f"{len(config.pixels)} pixel coordinates, a count of {config.count}, least weight {config.least_weight:g}.",
            "pairs X Y, one or more points, a weight from 0 to 1",
            "correct --pixels, --count or --least-weight",
        )
    run = open_run(config.run, config.capture, config.device)
    index = reflector_index(run.scene, config.reflector)
    view = named_view(run.capture, config.view)
    path = camera_path(run.capture, config.path, frame_count(config.seconds, config.fps), config.width)
    start = view.camera.resized(path[0].width, path[0].height)
    points = _chosen_points(run.scene, index, start, config)
    tracks = follow_points(run.scene, index, points, [start, *path], config.least_weight)
    errors = None
    if config.truth is not None or truth_path(run.capture.root, view.name).is_file():
        errors = track_errors(run, index, tracks, [start, *path], 0, view, config.truth or run.capture.root)[1:]
    tracks = tracks._replace(**{name: getattr(tracks, name)[1:] for name in ("pixels", "weights", "visible")})
    _write_tables(out, view, path, tracks, errors)

    def draw(i: int) -> np.ndarray:
        return draw_dots(run.scene.render(path[i]).rgb.cpu().numpy(), tracks.pixels[i], tracks.visible[i])

    shown = np.linspace(0, len(path) - 1, 4).round().astype(int).tolist()
    write_image(out / "tracks.jpg", np.concatenate([draw(i) for i in shown], 1))
    if config.film:
        key = film_key(scene_file(run.folder).read_bytes(), path, tracks.points.tolist(), index, config.least_weight)
        write_film(film, len(path), draw, key, config.fps, config.quality)
    print(f"tracks: {len(points)} points in {len(path)} views, visible in {tracks.visible.mean():.0%}: {out}")
    if errors is not None and np.isfinite(errors).any():
        median, high = np.nanpercentile(errors, (50, 95))
        print(f"against truth: median {median:.2f} px, 95 % {high:.2f} px ({np.isfinite(errors).sum()} positions)")


def _chosen_points(scene: Scene, index: int, camera: Camera, config: TrackConfig) -> list[int]:
    known = len(scene.reflections[index].positions)
    wrong = [p for p in config.points if not 0 <= p < known]
    if wrong:
        raise UserError(f"There is no reflection point {wrong[0]}.", f"0 to {known - 1}", "correct --points")
    pixels = np.array(config.pixels).reshape(-1, 2)
    chosen = [*config.points, *(point_at(scene, index, camera, pixel) for pixel in pixels)]
    return list(dict.fromkeys(chosen)) or spread_points(scene, index, camera, config.count, config.least_weight)


def _write_tables(
    out: Path, view: View, cameras: Sequence[Camera], tracks: Tracks, errors: Float[np.ndarray, "views t"] | None
) -> None:
    lines = ["frame,point,x,y,weight,visible" + (",error" if errors is not None else "")]
    for k in range(len(cameras)):
        for j, point in enumerate(tracks.points):
            x, y = tracks.pixels[k, j]
            row = f"{k},{point},{x:.3f},{y:.3f},{tracks.weights[k, j]:.4f},{int(tracks.visible[k, j])}"
            lines.append(row + (f",{errors[k, j]:.3f}" if errors is not None else ""))
    write_text(out / "tracks.csv", "\n".join(lines) + "\n")
    table: dict[str, Any] = {"chosen_in": view.name, "width": cameras[0].width, "height": cameras[0].height}
    table["cameras"] = [
        {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "camera_from_world": c.camera_from_world.tolist()}
        for c in cameras
    ]
    table["tracks"] = [
        {
            "point": int(point),
            "pixels": [[round(float(v), 3) for v in p] if np.isfinite(p).all() else None for p in tracks.pixels[:, j]],
            "weights": [round(float(w), 4) for w in tracks.weights[:, j]],
            "visible": tracks.visible[:, j].tolist(),
        }
        for j, point in enumerate(tracks.points)
    ]
    if errors is not None and np.isfinite(errors).any():
        median, high = (float(v) for v in np.nanpercentile(errors, (50, 95)))
        table["error_in_pixels"] = {
            "median": median,
            "percentile_95": high,
            "positions": int(np.isfinite(errors).sum()),
        }
    write_json(out / "tracks.json", table)
