"""Image and mask files, resizing by a named filter, video. RGB, (height, width, 3), sRGB as stored."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np

from catacaustics.errors import UserError
from catacaustics.files import atomic_path, write_bytes
from catacaustics.shapes import Bool, Float, UInt8

IMAGE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})

RESIZE_FILTER = "area (cv2.INTER_AREA)"
"""The filter of `resize`, named in every report: metrics at another filter cannot be compared."""


def _decode(path: Path, *flag_names: str) -> np.ndarray:
    import cv2

    try:
        data = np.fromfile(path, np.uint8)
    except FileNotFoundError as error:
        raise UserError(f"There is no image {path}.", "an image file", "check the path, or restore the file") from error
    flags = sum(getattr(cv2, name) for name in flag_names)
    image = cv2.imdecode(data, flags) if data.size else None
    if image is None:
        size = "is empty (0 bytes)" if not data.size else f"cannot be decoded ({data.size} bytes)"
        raise UserError(
            f"The image {path} {size}.",
            "a complete JPEG, PNG, TIFF, BMP or WebP file",
            "copy the file again from its source, or delete it",
        )
    return image


def read_image_bytes(path: Path, upright: bool = True) -> UInt8[np.ndarray, "height width 3"]:
    """An image as 8-bit RGB.

    Args:
        upright: apply the EXIF orientation; COLMAP does not.

    Raises:
        UserError: the file is missing, empty or cannot be decoded.
    """
    flags = ("IMREAD_COLOR",) if upright else ("IMREAD_COLOR", "IMREAD_IGNORE_ORIENTATION")
    return np.ascontiguousarray(_decode(path, *flags)[..., ::-1])


def read_image(path: Path) -> Float[np.ndarray, "height width 3"]:
    """An image as float32 RGB in [0, 1]; raises as `read_image_bytes`."""
    return read_image_bytes(path).astype(np.float32) / 255


def read_mask(path: Path) -> Bool[np.ndarray, "height width"]:
    """A mask image: True where white (above half). Raises as `read_image_bytes`."""
    return _decode(path, "IMREAD_GRAYSCALE") > 127


def to_bytes(image: np.ndarray) -> np.ndarray:
    """Float [0, 1] (clamped), boolean or 8-bit image as uint8."""
    if image.dtype == np.uint8:
        return image
    if image.dtype == bool:
        return image.astype(np.uint8) * 255
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


def encode_image(image: np.ndarray, suffix: str, quality: int = 95) -> bytes:
    """Encode an RGB (height, width, 3) or gray (height, width) image as the format of `suffix` (".png", ".jpg")."""
    import cv2

    data = to_bytes(image)
    if data.ndim == 3:
        data = data[..., ::-1]
    jpeg = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    options = jpeg if suffix.lower() in (".jpg", ".jpeg") else []
    return cv2.imencode(suffix, np.ascontiguousarray(data), options)[1].tobytes()


def write_image(path: Path, image: np.ndarray, quality: int = 95) -> None:
    """Write an RGB or gray image atomically; the suffix chooses the format, `quality` applies to JPEG."""
    write_bytes(path, encode_image(image, Path(path).suffix, quality))


def resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize a float or 8-bit image: area averaging when it shrinks, bilinear when it grows."""
    import cv2

    if image.shape[:2] == (height, width):
        return image
    shrinks = width * height < image.shape[0] * image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def list_images(folder: Path) -> list[Path]:
    """Image files under a folder, subfolders included, sorted by name; hidden files are skipped."""
    return sorted(
        p
        for p in Path(folder).rglob("*")
        if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file() and not p.name.startswith(".")
    )


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float = 24.0, quality: int = 20) -> int:
    """Write an H.264 MP4 that common players and browsers open (yuv420p, BT.709). Returns the number of frames.

    Args:
        frames: RGB images, float in [0, 1] or 8-bit, all of one size; odd sizes lose their last row or column.
        quality: constant rate factor of x264: lower is better, 18 is visually lossless.

    Raises:
        ValueError: no frames, or frames of several sizes.
    """
    import av
    from av.video.reformatter import Colorspace

    # Without the tags players guess the colour matrix from the frame's size.
    tags = "colorprim=bt709:transfer=bt709:colormatrix=bt709"
    options = {"crf": str(quality), "preset": "medium", "x264-params": tags}
    count, stream, size = 0, None, None
    with (
        atomic_path(path) as temporary,
        av.open(str(temporary), "w", format="mp4", options={"movflags": "faststart"}) as container,
    ):
        for image in frames:
            data = np.ascontiguousarray(to_bytes(image)[: image.shape[0] & ~1, : image.shape[1] & ~1])
            if stream is None:
                size = data.shape
                stream = container.add_stream("libx264", Fraction(fps).limit_denominator(65535), options)
                stream.height, stream.width, stream.pix_fmt = size[0], size[1], "yuv420p"
            elif data.shape != size:
                raise ValueError(f"write_video needs frames of one size, got {size} and {data.shape}")
            frame = av.VideoFrame.from_ndarray(data, "rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
            container.mux(stream.encode(frame))
            count += 1
        if stream is None:
            raise ValueError("write_video needs one or more frames")
        container.mux(stream.encode())
    return count
