"""Stereo pairs, in which the reflections may have a smaller eye separation than the scene.

What the two eyes see in a curved mirror can differ too much to be fused, and by height as well. Reflections follow the
cameras of the warp, so their eyes can be brought together: with both at one place, the reflection is a picture painted
on the mirror, and its disparity is that of the surface.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from catacaustics.cameras import Camera
from catacaustics.config import StereoConfig
from catacaustics.errors import UserError
from catacaustics.files import write_json
from catacaustics.images import write_image
from catacaustics.reflectors.revolution import Revolution, ray_distances
from catacaustics.reflectors.warps import PlaneWarp, RevolutionWarp, mirror_of
from catacaustics.run import named_view, open_run, scene_file
from catacaustics.scene import ReflectionDisks, RenderOutput, Scene
from catacaustics.shapes import Float
from catacaustics.splatting import splat_points
from catacaustics.video import camera_path, check_film, film_key, frame_count, write_film

_LUMA = np.array([0.299, 0.587, 0.114], np.float32)
_LEAST_WEIGHT = 0.5
"""Share that a reflection must have of a pixel to be measured there."""


class Rig(NamedTuple):
    """Two eyes beside each other, looking in parallel; their pictures are shifted so that what is at `screen` distance
    (along the line of sight) has no disparity. `warp` is the reflections' share of the eye separation: 1 is physically
    right, 0 puts the picture of the middle on the mirror."""

    separation: float
    screen: float
    warp: float = 1.0

    def eyes(self, camera: Camera) -> tuple[Camera, Camera]:
        """The left and the right eye of a camera between them."""
        shift = camera.fx * self.separation / 2 / self.screen
        left, right = (_aside(camera, side * self.separation / 2) for side in (-1, 1))
        return _shifted(left, -shift), _shifted(right, shift)

    def warp_cameras(self, camera: Camera) -> tuple[Camera, Camera]:
        """The cameras that the eyes' reflections follow."""
        return _aside(camera, -self.warp * self.separation / 2), _aside(camera, self.warp * self.separation / 2)


class Disparity(NamedTuple):
    """Right minus left, in pixels, over the left eye's pixels of reflectors; positive behind the screen. 5th, 50th and
    95th percentile of the horizontal one, 95th percentiles of the absolute horizontal and vertical ones."""

    low: float
    median: float
    high: float
    horizontal: float
    vertical: float
    pixels: int


def _aside(camera: Camera, distance: float) -> Camera:
    return camera.displaced(np.array([distance, 0.0, 0.0]))


def _shifted(camera: Camera, pixels: float) -> Camera:
    return Camera(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx + pixels, camera.cy, camera.camera_from_world
    )


def usual_rig(scene: Scene, camera: Camera, warp: float = 1.0) -> Rig:
    """The screen touches the nearest reflector from the front (without one: the middle of what is seen); the eyes are a
    thirtieth of that distance apart."""
    depths = [float(camera.project(v.vertices)[1].min()) for v in scene.volumes]
    depths = [d for d in depths if d > 0]
    if not depths:
        output = scene.render(camera.resized(96, max(round(96 * camera.height / camera.width), 1)))
        covered = output.depth[output.alpha > 0.5]
        depths = [float(covered.median()) if len(covered) else 1.0]
    return Rig(min(depths) / 30, min(depths), warp)


def render_pair(scene: Scene, camera: Camera, rig: Rig) -> tuple[RenderOutput, RenderOutput]:
    """What the left and the right eye see."""
    pairs = zip(rig.eyes(camera), rig.warp_cameras(camera), strict=True)
    left, right = (scene.render(eye, warp_camera=follows) for eye, follows in pairs)
    return left, right


def side_by_side(
    left: Float[np.ndarray, "height width 3"], right: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height both 3"]:
    """Left eye's picture on the left: for parallel viewing, 3D screens and headsets."""
    return np.concatenate([left, right], 1)


def anaglyph(
    left: Float[np.ndarray, "height width 3"], right: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width 3"]:
    """For red-cyan glasses, red left. The red channel is the left eye's brightness, so that coloured things do not
    look bright to one eye and dark to the other ("half colour")."""
    return np.concatenate([(left @ _LUMA)[..., None], right[..., 1:]], -1)


def reflection_disparity(scene: Scene, camera: Camera, rig: Rig) -> Disparity:
    """Disparity of what reflectors show: displayed positions projected into both eyes, blended per pixel.

    Raises:
        UserError: no reflection is seen.
    """
    right, follows = rig.eyes(camera)[1], rig.warp_cameras(camera)[1]

    def displayed(index: int, disks: ReflectionDisks) -> Float[np.ndarray, "n 3"]:
        other = scene.reflection_disks(index, right, warp_camera=follows)
        return _same_images(disks, other, scene.volumes[index].radius)

    return _disparity(scene, camera, rig, displayed)


def _same_images(disks: ReflectionDisks, other: ReflectionDisks, size: float) -> Float[np.ndarray, "n 3"]:
    """The other eye's images of the same points, the nearest ones where a mirror shows several; nan where none."""
    from scipy.spatial import KDTree

    apart = 1e6 * size  # images of different points are never near
    here, there = (np.c_[apart * d.rows.cpu().numpy()[:, None], _float64(d.positions)] for d in (disks, other))
    if not len(there):
        return np.full((len(here), 3), np.nan)
    gap, nearest = map(np.asarray, KDTree(there).query(here))
    return np.where(gap[:, None] < apart / 2, there[nearest, 1:], np.nan)


def surface_disparity(scene: Scene, camera: Camera, rig: Rig) -> Disparity:
    """Disparity of the reflectors' surfaces where the left eye sees what they show: at the same disks, blended over the
    same pixels as `reflection_disparity`, so that a picture on the surface has just this disparity.

    Raises:
        UserError: no reflection is seen.
    """
    left = rig.eyes(camera)[0]

    def on_the_surface(index: int, disks: ReflectionDisks) -> Float[np.ndarray, "n 3"]:
        pixels = left.project(_float64(disks.positions))[0]
        return left.unproject(pixels, surface_depth(scene, index, left, pixels))

    return _disparity(scene, camera, rig, on_the_surface)


def _disparity(
    scene: Scene,
    camera: Camera,
    rig: Rig,
    seen: Callable[[int, ReflectionDisks], Float[np.ndarray, "n 3"]],
) -> Disparity:
    """Disparity per pixel of all reflectors, blended over the left eye's disks.

    Args:
        seen: a reflector's index and its disks in the left eye to the world points that the right eye sees, nan where
            it sees none.
    """
    left, right = rig.eyes(camera)
    follows = rig.warp_cameras(camera)[0]
    weight = scene.render(left, warp_camera=follows).reflection_weight.cpu().numpy()
    values = [np.zeros((0, 2))]
    with torch.no_grad():
        for i, volume in enumerate(scene.volumes):
            disks = scene.reflection_disks(i, left, warp_camera=follows)
            shifts = right.project(seen(i, disks))[0] - left.project(_float64(disks.positions))[0]
            both = np.isfinite(shifts).all(1, keepdims=True)
            features = torch.from_numpy(np.c_[np.where(both, shifts, 0), both]).to(disks.positions)
            output = splat_points(*disks[1:5], features, left, config=scene.splatting)
            image = output.image.cpu().numpy()
            shown = (weight > _LEAST_WEIGHT) & volume.project_mask(left) & (image[..., 2] > _LEAST_WEIGHT)
            values.append(image[shown][:, :2] / image[shown][:, 2:])
    return _summary(np.concatenate(values))


def surface_depth(
    scene: Scene, index: int, camera: Camera, pixels: Float[np.ndarray, "*n 2"]
) -> Float[np.ndarray, "*n"]:
    """Depth of a reflector's surface at pixel coordinates, nan beside it: of its fitted mirror, or of its volume where
    the rung has no mirror."""
    volume, mirror = scene.volumes[index], mirror_of(scene.warps[index])
    rays, start = camera.ray_directions(pixels), camera.center
    if mirror is None:
        normals, limits = volume.halfspaces[:, :3], volume.halfspaces[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            cuts = -(normals @ start + limits) / (rays @ normals.T)
        entering = rays @ normals.T < 0
        depth = np.where(entering, cuts, -np.inf).max(-1)
        depth = np.where(depth <= np.where(entering, np.inf, cuts).min(-1), depth, np.nan)
    elif isinstance(mirror, PlaneWarp):
        normal, distance = (_float64(t) for t in mirror.plane())
        with np.errstate(divide="ignore"):
            depth = (distance - normal @ start) / (rays @ normal)
    elif isinstance(mirror, RevolutionWarp):
        lengths = np.linalg.norm(rays, axis=-1, keepdims=True)
        surface = Revolution(*(value.detach().cpu().double() for value in mirror.surface()))
        flat = torch.from_numpy((rays / lengths).reshape(-1, 3))
        depth = ray_distances(surface, torch.from_numpy(start), flat).numpy().reshape(lengths.shape[:-1])
        depth = depth / lengths[..., 0]
    else:
        center, axes = (_float64(t) for t in mirror.shape())
        inverse = np.linalg.inv(axes)
        u, v = rays @ inverse.T, inverse @ (start - center)
        a, b, c = (u * u).sum(-1), u @ v, v @ v - 1
        root = np.sqrt(np.where(b * b >= a * c, b * b - a * c, np.nan))
        depth = (-b + root if bool(mirror.concave) else -b - root) / a
    return np.where(depth > 0, depth, np.nan)


def _float64(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().astype(np.float64)


def _summary(values: np.ndarray) -> Disparity:
    if not len(values):
        raise UserError("No reflection is seen from there.", "a view of a reflector", "choose another view with --view")
    low, median, high = np.percentile(values[:, 0], (5, 50, 95))
    absolute = np.percentile(np.abs(values), 95, axis=0)
    return Disparity(float(low), float(median), float(high), float(absolute[0]), float(absolute[1]), len(values))


def stereo(config: StereoConfig) -> None:
    """Write OUT/left.png, right.png, anaglyph.png, side_by_side.png, stereo.json, and on request a film.

    Raises:
        UserError: no such run or view, or settings out of range.
    """
    out = Path(config.out)
    film = out / "film.mp4"
    check_film(film, config.width, config.seconds, config.fps, config.quality)
    if not 0 <= config.warp_separation <= 1 or min(config.separation or 1, config.screen or 1) <= 0:
        raise UserError(
            f"Separation {config.separation}, screen {config.screen}, warp separation {config.warp_separation:g}.",
            "positive lengths in world units, a warp separation from 0 to 1",
            "correct the value that is out of range",
        )
    run = open_run(config.run, config.capture, config.device)
    scene = run.scene
    view = named_view(run.capture, config.view)
    camera = view.camera.resized(config.width, max(round(config.width * view.camera.height / view.camera.width), 1))
    usual = usual_rig(scene, camera)
    screen = config.screen or usual.screen
    rig = Rig(config.separation or screen / 30, screen, config.warp_separation)
    left, right = (output.rgb.cpu().numpy() for output in render_pair(scene, camera, rig))
    pictures = {"left": left, "right": right, "anaglyph": anaglyph(left, right)}
    for name, picture in (pictures | {"side_by_side": side_by_side(left, right)}).items():
        write_image(out / f"{name}.png", picture)
    measured = _measured(scene, camera, rig)
    settings = {"view": view.name, "separation": rig.separation, "screen": rig.screen, "warp_separation": rig.warp}
    write_json(out / "stereo.json", settings | {"disparity": {k: d._asdict() for k, d in measured.items()}})
    print(f"eyes {rig.separation:.4g} apart, screen at {rig.screen:.4g}; pictures: {out}")
    if measured:
        _print_table(measured)
    else:
        print(f"no reflection is seen in {view.name}, so there are no disparities to compare")
    if config.film is not None:
        cameras = camera_path(run.capture, config.path, frame_count(config.seconds, config.fps), config.width)
        join = side_by_side if config.film == "side-by-side" else anaglyph

        def draw(i: int) -> np.ndarray:
            return join(*(output.rgb.cpu().numpy() for output in render_pair(scene, cameras[i], rig)))

        key = film_key(scene_file(run.folder).read_bytes(), cameras, config.film, rig)
        write_film(film, len(cameras), draw, key, config.fps, config.quality)


def _measured(scene: Scene, camera: Camera, rig: Rig) -> dict[str, Disparity]:
    """Disparities before and after, and of the surface; empty where no reflection is seen."""
    full = rig._replace(warp=1.0)
    try:
        return {
            "full": reflection_disparity(scene, camera, full),
            "chosen": reflection_disparity(scene, camera, rig),
            "surface": surface_disparity(scene, camera, rig),
        }
    except UserError:
        return {}


def _print_table(measured: dict[str, Disparity]) -> None:
    names = {"full": "reflections, full separation", "chosen": "reflections, as chosen", "surface": "their surface"}
    print(f"{'disparity in pixels':<30}{'5 %':>8}{'median':>8}{'95 %':>8}{'|.| 95 %':>10}{'vertical 95 %':>15}")
    for key, d in measured.items():
        print(f"{names[key]:<30}{d.low:>8.2f}{d.median:>8.2f}{d.high:>8.2f}{d.horizontal:>10.2f}{d.vertical:>15.2f}")
