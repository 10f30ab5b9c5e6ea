"""Undistortion: photographs of any COLMAP camera model become PINHOLE photographs; masks take the same path.

The distortion formulas are those of COLMAP's documentation, "Camera Models". Pixel centres are at +0.5 here and in
COLMAP, at 0 in OpenCV.
"""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from catacaustics.cameras import Camera
from catacaustics.capture.colmap import ColmapCamera, ColmapModel, pinhole_params
from catacaustics.capture.dataset import View
from catacaustics.errors import UserError
from catacaustics.files import read_json, write_bytes, write_json
from catacaustics.images import list_images, read_image_bytes, read_mask, resize, write_image
from catacaustics.shapes import Float, UInt8

JPEG_QUALITY = 95
"""Quality of undistorted photographs that come from JPEG files; all others become PNG."""

_SINGLE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
_FISHEYE = {"OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"}


def split_params(camera: ColmapCamera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Focal lengths (fx, fy), principal point (cx, cy) and distortion parameters of a COLMAP camera."""
    p = np.asarray(camera.params, float)
    if camera.model in _SINGLE_FOCAL:
        return p[[0, 0]], p[1:3], p[3:]
    return p[:2], p[2:4], p[4:]


def _bent(points: np.ndarray, k: np.ndarray, tangential: np.ndarray) -> np.ndarray:
    """Radial polynomial 1 + k1 r^2 + k2 r^4 + ... and tangential distortion p1, p2."""
    r2 = (points**2).sum(-1, keepdims=True)
    radial = np.ones_like(r2)
    for i, value in enumerate(k):
        radial += value * r2 ** (i + 1)
    bent = points * radial
    if tangential.any():
        bent += 2 * points[..., :1] * points[..., 1:] * tangential + tangential[::-1] * (r2 + 2 * points**2)
    return bent


def _distorted(model: str, points: np.ndarray, d: np.ndarray) -> np.ndarray:
    none = np.zeros(2)
    if model in ("SIMPLE_PINHOLE", "PINHOLE"):
        return points
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        return _bent(points, d, none)
    if model == "OPENCV":
        return _bent(points, d[:2], d[2:])
    if model == "FULL_OPENCV":
        r2 = (points**2).sum(-1, keepdims=True)
        denominator = 1 + d[5] * r2 + d[6] * r2**2 + d[7] * r2**3
        radial = _bent(points, d[[0, 1, 4]], none) / denominator
        return radial + _bent(points, np.zeros(0), d[2:4]) - points
    r = np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-12)
    if model == "FOV":
        omega = d[0]
        if abs(omega) < 1e-6:  # the series' first term; the formula below loses its digits here
            return points * (1 + omega**2 * (r**2 / 3 - 1 / 12))
        return points * np.arctan(2 * r * np.tan(omega / 2)) / (r * omega)
    angle = points * (np.arctan(r) / r)
    if model != "THIN_PRISM_FISHEYE":
        return _bent(angle, d, none)
    thin_prism = d[6:8] * (angle**2).sum(-1, keepdims=True)
    return _bent(angle, d[[0, 1, 4, 5]], d[2:4]) + thin_prism


def distort(camera: ColmapCamera, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Pixel coordinates in the distorted photograph of points (x / z, y / z) of the camera's z = 1 plane."""
    focal, principal, d = split_params(camera)
    return focal * _distorted(camera.model, points, d) + principal


def _jacobian(camera: ColmapCamera, points: np.ndarray) -> np.ndarray:
    """d distort / d points, (n, 2, 2), by central differences."""
    step = 1e-6 * np.maximum(1, np.abs(points).max(-1, keepdims=True))
    columns = []
    for axis in np.eye(2):
        columns.append((distort(camera, points + step * axis) - distort(camera, points - step * axis)) / (2 * step))
    return np.stack(columns, -1)


def undistort_points(camera: ColmapCamera, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """The inverse of `distort`, by damped Newton steps; NaN for pixels that no ray in front of the camera reaches."""
    focal, principal, _ = split_params(camera)
    points = (pixels - principal) / focal
    if camera.model in _FISHEYE:
        angle = np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-12)
        points = points * np.tan(np.minimum(angle, 1.4)) / angle
    residual = distort(camera, points) - pixels
    damping = np.ones(len(points))
    for _ in range(100):
        active = np.flatnonzero(np.abs(residual).max(-1) > 1e-9 * max(camera.width, camera.height))
        if not len(active):
            break
        (a, b), (c, d) = np.moveaxis(_jacobian(camera, points[active]), 0, -1)
        x, y = residual[active].T
        determinant = a * d - b * c
        determinant = np.where(np.abs(determinant) > 1e-12, determinant, 1e-12)
        step = np.stack([d * x - b * y, a * y - c * x], -1) / determinant[:, None]
        tried = points[active] - damping[active, None] * step
        tried_residual = distort(camera, tried) - pixels[active]
        better = np.linalg.norm(tried_residual, axis=-1) < np.linalg.norm(residual[active], axis=-1)
        damping[active] = np.where(better, np.minimum(2 * damping[active], 1), damping[active] / 2)
        points[active[better]], residual[active[better]] = tried[better], tried_residual[better]
    # Beyond the point where the polynomial folds back, a solution is not a ray that the lens sees.
    good = (np.abs(residual).max(-1) <= 1e-6) & (np.linalg.det(_jacobian(camera, points)) > 0)
    return np.where(good[:, None], points, np.nan)


def _reach(camera: ColmapCamera, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far straight lines from `start` run in the z = 1 plane before they leave the photograph.

    Returns:
        End points (n, 2), and for each the side of the photograph it left by: 0 left, 1 top, 2 right, 3 bottom, or -1
        where the line reached the size limit (twice the photograph's size) first.
    """
    size, focal = np.array([camera.width, camera.height]), split_params(camera)[0]
    angle = np.arange(2048) * (2 * np.pi / 2048)
    directions = np.stack([np.cos(angle), np.sin(angle)], -1)
    edge = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size
    corners = undistort_points(camera, edge.astype(float)) - start
    corners = corners[np.isfinite(corners).all(-1)]
    directions = np.concatenate([directions, corners / np.linalg.norm(corners, axis=-1, keepdims=True)])
    limit = (size / focal / np.maximum(np.abs(directions), 1e-12)).min(-1)

    def pixels(distance: np.ndarray) -> np.ndarray:
        return distort(camera, start + distance[..., None] * directions)

    inside_to, outside_from = np.zeros(len(limit)), limit.copy()
    before, running, folded = pixels(inside_to), np.ones(len(limit), bool), np.zeros(len(limit), bool)
    for fraction in np.arange(1, 513) / 512:
        here = pixels(fraction * limit)
        folds = ((here - before) * focal * directions).sum(-1) <= 0
        leaves = ((here < 0) | (here > size)).any(-1)
        folded |= running & folds
        outside_from = np.where(running & (folds | leaves), fraction * limit, outside_from)
        running &= ~(folds | leaves)
        inside_to = np.where(running, fraction * limit, inside_to)
        before = here
    for _ in range(45):
        middle = (inside_to + outside_from) / 2
        here = pixels(middle)
        inside = ((here >= 0) & (here <= size)).all(-1) & ~folded
        inside_to, outside_from = np.where(inside, middle, inside_to), np.where(inside, outside_from, middle)
    here = pixels(outside_from)
    overshoot = (
        np.stack([-here[:, 0], -here[:, 1], here[:, 0] - size[0], here[:, 1] - size[1]], -1) / size[[0, 1, 0, 1]]
    )
    toward = np.concatenate([-directions, directions], -1) * (focal / size)[[0, 1, 0, 1]]
    side = np.where(folded, toward.argmax(-1), overshoot.argmax(-1))
    return start + inside_to[:, None] * directions, np.where(running, -1, side)


def pinhole_camera(camera: ColmapCamera, max_size: int | None = None) -> ColmapCamera:
    """The PINHOLE camera that a distorted photograph is resampled to.

    Rule: the same focal lengths and optical axis; the largest rectangle whose sides clear the undistorted border of
    the photograph everywhere, so that no pixel is blank (COLMAP's blank_pixels = 0), but at most twice the
    photograph's width and height (wide fisheye lenses); the principal point goes wherever that puts it. Then reduced
    so that the longer side is at most `max_size`.

    Raises:
        UserError: the distortion parameters make no usable photograph.
    """
    if camera.model in ("PINHOLE", "SIMPLE_PINHOLE"):
        width, height = camera.width, camera.height
        params = np.array(pinhole_params(camera))
    else:
        focal = split_params(camera)[0]
        start = undistort_points(camera, np.array([[camera.width / 2, camera.height / 2]]))[0]
        low = high = np.zeros(2)
        if np.isfinite(start).all():
            reach = np.array([camera.width, camera.height]) / focal
            low, high = start - reach, start + reach
            ends, side = _reach(camera, start)
            for axis in (0, 1):
                low[axis] = max(low[axis], ends[side == axis, axis].max(initial=-np.inf))
                high[axis] = min(high[axis], ends[side == axis + 2, axis].min(initial=np.inf))
        extent = (high - low) * focal
        width, height = np.floor(extent + 1e-6).astype(int).tolist()
        if min(width, height) < 0.1 * min(camera.width, camera.height):
            raise UserError(
                f"A {camera.model} camera of {camera.width} x {camera.height} pixels with the parameters "
                f"{np.asarray(camera.params).tolist()} leaves {max(width, 0)} x {max(height, 0)} undistorted pixels.",
                "a lens model whose distortion does not fold the photograph over",
                "calibrate again with a simpler lens model (--camera-model SIMPLE_RADIAL)",
            )
        params = np.concatenate([focal, -low * focal - (extent - [width, height]) / 2])
    if max_size is not None and max(width, height) > max_size:
        scale = max_size / max(width, height)
        small = max(round(width * scale), 1), max(round(height * scale), 1)
        params = params * np.array([small[0] / width, small[1] / height] * 2)
        width, height = small
    return ColmapCamera("PINHOLE", width, height, params)


@lru_cache(maxsize=1)
def _source_map(camera: ColmapCamera, pinhole: ColmapCamera) -> tuple[np.ndarray, np.ndarray] | None:
    """Where each pixel of `pinhole`, enlarged to the photograph's scale, lies in the photograph (OpenCV's fixed-point
    maps, steps of 1/32 pixel). None where that is the photograph itself."""
    import cv2

    focal, principal, _ = split_params(camera)
    enlarge = np.maximum(focal / pinhole.params[:2], 1)
    width, height = np.rint(enlarge * [pinhole.width, pinhole.height]).astype(int)
    scale = np.array([width / pinhole.width, height / pinhole.height])
    f, c = pinhole.params[:2] * scale, pinhole.params[2:] * scale
    plain = camera.model in ("PINHOLE", "SIMPLE_PINHOLE") and (width, height) == (camera.width, camera.height)
    if plain and np.allclose([*f, *c], [*focal, *principal], rtol=0, atol=1e-6):
        return None
    coarse, fine = np.empty((height, width, 2), np.int16), np.empty((height, width), np.uint16)
    x = (np.arange(width) + 0.5 - c[0]) / f[0]
    for top in range(0, height, 64):  # strips: the formulas hold many temporary arrays
        y = (np.arange(top, min(top + 64, height)) + 0.5 - c[1]) / f[1]
        source = (distort(camera, np.stack(np.meshgrid(x, y), -1)) - 0.5).astype(np.float32)
        rows = slice(top, top + len(y))
        coarse[rows], fine[rows] = cv2.convertMaps(source[..., 0], source[..., 1], cv2.CV_16SC2)
    return coarse, fine


def undistort_image(
    image: UInt8[np.ndarray, "height width *channels"], camera: ColmapCamera, pinhole: ColmapCamera
) -> UInt8[np.ndarray, "new_height new_width *channels"]:
    """Resample a photograph (8-bit, RGB or gray) from `camera` to `pinhole` (made by `pinhole_camera`).

    Bicubic at the photograph's own scale, then area averaging down to the pinhole's size, so that reducing does not
    alias. An image that needs no change is returned itself.
    """
    import cv2

    _check_size(image, camera)
    maps = _source_map(camera, pinhole)
    if maps is not None:
        image = cv2.remap(image, *maps, interpolation=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return resize(image, pinhole.width, pinhole.height)


def undistort_mask(mask: np.ndarray, camera: ColmapCamera, pinhole: ColmapCamera) -> np.ndarray:
    """Resample a boolean mask (height, width) exactly as `undistort_image` does a photograph (bilinear, then area
    averaging, then True where at least half of a pixel is covered)."""
    import cv2

    _check_size(mask, camera)
    coverage = mask.astype(np.uint8) * 255
    maps = _source_map(camera, pinhole)
    if maps is not None:
        coverage = cv2.remap(coverage, *maps, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return resize(coverage, pinhole.width, pinhole.height) > 127


def _check_size(image: np.ndarray, camera: ColmapCamera, name: str = "An image") -> None:
    if image.shape[:2] != (camera.height, camera.width):
        raise UserError(
            f"{name} has {image.shape[1]} x {image.shape[0]} pixels.",
            f"{camera.width} x {camera.height}, the size of its calibrated camera",
            "use the photographs that were calibrated, and masks painted on them at full size",
        )


def find_masks(masks: Path, names: list[str]) -> dict[str, dict[str, Path]]:
    """Mask files of photographs: {reflector: {photograph name: file}}.

    A mask is MASKS/REFLECTOR/ plus the photograph's name with its suffix replaced (`a.jpg` -> `a.png`) or with one
    more (`a.jpg.png`). Masks of photographs that are not in `names` are left out.

    Raises:
        UserError: no reflector folder, or a reflector none of whose masks belongs to a photograph.
    """
    found: dict[str, dict[str, Path]] = {}
    by_stem = {str(Path(name).with_suffix("")): name for name in names} | {name: name for name in names}
    for folder in sorted(p for p in Path(masks).glob("*") if p.is_dir() and not p.name.startswith(".")):
        files = list_images(folder)
        stems = [str(path.relative_to(folder).with_suffix("")) for path in files]
        found[folder.name] = {by_stem[s]: path for s, path in zip(stems, files, strict=True) if s in by_stem}
        if not found[folder.name]:
            example = files[0].relative_to(folder) if files else "none at all"
            raise UserError(
                f"None of the {len(files)} masks in {folder} belongs to a calibrated photograph (first: {example}).",
                f"masks named like the photographs, such as {Path(names[0]).with_suffix('.png')}",
                "rename the masks, or remove the folder",
            )
    if not found:
        raise UserError(
            f"There is no reflector folder in {masks}.",
            "MASKS/REFLECTOR/STEM.png, one folder for each reflector, such as MASKS/ball/IMG_0001.png",
            "put the masks into a folder named after the reflector",
        )
    return found


def _output_names(model: ColmapModel) -> dict[str, str]:
    """File names in the capture; raises UserError where two photographs would share a file or a mask."""
    outputs: dict[str, str] = {}
    stems: dict[Path, str] = {}
    for name in (image.name for image in model.images):
        path = Path(name)
        if path.is_absolute() or ".." in path.parts:
            raise UserError(
                f"The model names a photograph {name}.", "a path inside the photographs' folder", "rename it"
            )
        other = stems.setdefault(path.with_suffix(""), name)
        if other != name or name in outputs:
            raise UserError(
                f"Two photographs have the same stem: {other} and {name}.",
                "names that differ before the suffix, because masks are named by it",
                "rename one of them and calibrate again",
            )
        outputs[name] = name if path.suffix.lower() in (".jpg", ".jpeg", ".png") else str(path.with_suffix(".png"))
    return outputs


def _newer(output: Path, source: Path) -> bool:
    return output.is_file() and source.is_file() and output.stat().st_mtime_ns >= source.stat().st_mtime_ns


def _write_photo(source: Path, output: Path, camera: ColmapCamera, pinhole: ColmapCamera, upright: bool) -> None:
    image = read_image_bytes(source, upright)
    _check_size(image, camera, str(source))
    result = undistort_image(image, camera, pinhole)
    unchanged = result is image and source.suffix == output.suffix
    # Copied as it is, a JPEG file is not compressed twice; its orientation tag must then mean nothing.
    if unchanged and (upright or np.array_equal(read_image_bytes(source), image)):
        write_bytes(output, source.read_bytes())
    else:
        write_image(output, result, JPEG_QUALITY)


def undistort_views(
    model: ColmapModel,
    photos: Path | Mapping[str, Path],
    masks: Path | None,
    out: Path,
    max_size: int | None = None,
    upright: bool = False,
) -> list[View]:
    """Write undistorted photographs and masks into a capture folder, one view at a time.

    Views that are finished are skipped: their files are newer than their sources and were made with the same camera
    (recorded in OUT/undistorted.json). JPEG stays JPEG at quality 95 and keeps its name; PNG stays PNG; other formats
    become PNG. A photograph that needs no change is copied.

    Args:
        model: cameras and poses of the photographs.
        photos: their folder, or a file for each image name of the model.
        masks: folder MASKS/REFLECTOR/..., see `find_masks`; at the size of the photographs.
        out: the capture's folder; images/ and masks/ are written below it.
        max_size: longer side of the results in pixels.
        upright: the EXIF orientation was applied before calibration (COLMAP and pycolmap ignore it).

    Returns:
        The views in the model's order; write them with `write_capture`.

    Raises:
        UserError: photographs are missing (named, before any work), of another size than their camera, or unreadable;
            masks that belong to nothing.
    """
    from tqdm import tqdm

    out = Path(out)
    names = _output_names(model)
    sources = dict(photos) if isinstance(photos, Mapping) else {name: Path(photos) / name for name in names}
    missing = [name for name in names if name not in sources or not sources[name].is_file()]
    if missing:
        raise UserError(
            f"{len(missing)} of {len(names)} calibrated photographs are missing: {', '.join(missing[:5])}"
            f"{' ...' if len(missing) > 5 else ''}.",
            "every photograph that the model names",
            f"restore them{'' if isinstance(photos, Mapping) else f' in {photos}'}",
        )
    found = find_masks(masks, list(names)) if masks is not None else {}
    pinholes = {i: pinhole_camera(c, max_size) for i, c in model.cameras.items()}
    recipes = {
        names[image.name]: [
            [c.model, c.width, c.height, *np.asarray(c.params).tolist()]
            for c in (model.cameras[image.camera_id], pinholes[image.camera_id])
        ]
        for image in model.images
    }
    stamp = out / "undistorted.json"
    finished = read_json(stamp) if stamp.is_file() else {}
    views = []
    # By camera, because the sampling map of the last camera is kept.
    for image in tqdm(sorted(model.images, key=lambda i: i.camera_id), "undistort", unit="photo"):
        camera, pinhole, name = model.cameras[image.camera_id], pinholes[image.camera_id], names[image.name]
        same = finished.get(name) == recipes[name]
        jobs: list[tuple[Path, Path, str | None]] = [(sources[image.name], out / "images" / name, None)]
        for reflector, files in found.items():
            if image.name in files:
                output = out / "masks" / reflector / Path(name).with_suffix(".png")
                jobs.append((files[image.name], output, reflector))
        for source, output, reflector in jobs:
            if same and _newer(output, source):
                continue
            if reflector is None:
                _write_photo(source, output, camera, pinhole, upright)
            else:
                mask = read_mask(source)
                _check_size(mask, camera, f"The mask {source}")
                write_image(output, undistort_mask(mask, camera, pinhole))
        if not same:
            finished[name] = recipes[name]
            write_json(stamp, finished)
        parameters = pinhole_params(pinhole)
        views.append(View(name, Camera(pinhole.width, pinhole.height, *parameters, image.camera_from_world)))
    order = {names[image.name]: i for i, image in enumerate(model.images)}
    return sorted(views, key=lambda view: order[view.name])
