"""How near a picture seen through glass is to its path-traced reference: on the whole image, on glass alone, by place.

Images are RGB, sRGB values in [0, 1]. T.* belong to the refractive pixels: those whose first surface is transparent.
"""

from typing import Any, NamedTuple

import numpy as np

from catacaustics.metrics import PROTOCOL, compare
from catacaustics.refraction.frames import Frame
from catacaustics.shapes import Bool, Float

MEASURES = {
    "L1": "mean absolute difference over pixels and channels",
    "PSNR": PROTOCOL["psnr"],
    "SSIM": PROTOCOL["ssim"],
    "FLIP": PROTOCOL["flip"],
    "T.L1": "as L1, over the refractive pixels",
    "T.PSNR": "as PSNR, MSE over the refractive pixels and channels",
    "T.SSIM": "mean over the refractive pixels of the whole images' SSIM map; its windows see their surroundings too",
    "T.Amp": "both images set to 0 outside the refractive pixels, orthonormal 2-D FFT of each channel, mean over "
    "frequencies and channels of (|FFT(I)| - |FFT(I')|)^2, divided by the share of refractive pixels",
    "R.L1": "colour at the predicted landing points, looked up as the model does, against the texture's colour at the "
    "true ones: mean absolute difference over refractive pixels that land and channels; albedo, sRGB-encoded",
    "regions": "T.L1 and R.L1 of all pixels of the split together: off screen (the landing point lies outside the "
    "image or behind the camera), hidden (on the screen, but another thing is nearer), seen (the others), internal "
    "reflection (the path holds a total one), many (4 or more events)",
    "mean": "mean of the frames' values over the frames that show glass; regions are pooled over pixels",
}
"""What the numbers mean; every metrics.json and report states it."""

HIDDEN_DEPTH = 0.03
"""A landing point whose depth differs from the screen's by more than this (scene units) is hidden."""


class Region(NamedTuple):
    """Sums over the pixels of a region: `pixels` with a reference, `landings` with a landing point."""

    pixels: int
    t_l1: float
    landings: int
    r_l1: float


def t_amplitude(
    image: Float[np.ndarray, "h w 3"], reference: Float[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]
) -> float:
    """T.Amp: mean over frequencies and channels of (|FFT(I)| - |FFT(I')|)^2 of the images set to 0 outside the mask.

    The FFT is orthonormal and the mean is divided by the mask's share of the image: by Parseval's theorem an error of
    constant size and unlike phase then gives about its square, however large image and mask are.

    Raises:
        ValueError: an empty mask.
    """
    if not mask.any():
        raise ValueError("t_amplitude needs a mask with pixels in it")
    spectra = [np.abs(np.fft.fft2(x * mask[..., None], axes=(0, 1), norm="ortho")) for x in (image, reference)]
    return float(((spectra[0] - spectra[1]) ** 2).mean() / mask.mean())


def landing_regions(frame: Frame) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Refractive pixels by where and how their path lands, by the truth; `seen`, `off screen` and `hidden` are those
    that land, apart."""
    lands = frame.landing_object >= 0
    clip = frame.landing @ frame.world_to_clip[:, :3].T + frame.world_to_clip[:, 3]
    depth = clip[..., 3]
    front = depth > 1e-6
    ndc = np.where(front[..., None], clip[..., :2] / np.where(front, depth, 1)[..., None], 2.0)
    inside = (np.abs(ndc) <= 1).all(-1)
    side = frame.screen_depth.shape[0]
    column, row = (np.clip(((v + 1) / 2 * side).astype(int), 0, side - 1) for v in (ndc[..., 0], -ndc[..., 1]))
    near = np.abs(frame.screen_depth[row, column] - depth) <= HIDDEN_DEPTH
    return {
        "seen": lands & inside & near,
        "off screen": lands & ~inside,
        "hidden": lands & inside & ~near,
        "internal reflection": frame.refractive & frame.internal_reflection,
        "many": frame.refractive & (frame.events >= 4),
    }


def measure_frame(
    frame: Frame,
    image: Float[np.ndarray, "h w 3"],
    looked_up: Float[np.ndarray, "h w 3"] | None,
    true_color: Float[np.ndarray, "h w 3"],
) -> tuple[dict[str, Any], dict[str, Region], Float[np.ndarray, "h w"]]:
    """Metrics of one frame, sums of its regions, and its FLIP map.

    Args:
        image: the model's.
        looked_up: colour at the predicted landing points; None for a model without R-buffer.
        true_color: the texture's colour at the true landing points.
    """
    glass = frame.refractive
    comparison = compare(image, frame.reference, glass)
    error = np.abs(image - frame.reference).mean(-1)
    lands = frame.landing_object >= 0
    misses = np.zeros_like(error) if looked_up is None else np.abs(looked_up - true_color).mean(-1)
    row: dict[str, Any] = {"L1": float(error.mean())} | _named("", comparison.whole.as_dict())
    if comparison.inside is not None:
        row |= {"T.L1": float(error[glass].mean())} | _named("T.", comparison.inside.as_dict())
        row["T.Amp"] = t_amplitude(image, frame.reference, glass)
    if looked_up is not None and lands.any():
        row["R.L1"] = float(misses[lands].mean())
    regions = {
        name: Region(int(m.sum()), float(error[m].sum()), int((m & lands).sum()), float(misses[m & lands].sum()))
        for name, m in landing_regions(frame).items()
    }
    return row, regions, comparison.flip_map


def _named(prefix: str, values: dict[str, float]) -> dict[str, float]:
    return {prefix + key.upper(): value for key, value in values.items()}


def mean_rows(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Means of the frames' values; a frame without glass has no T.* and does not count there."""
    keys = dict.fromkeys(key for row in rows for key in row)
    return {key: float(np.mean([row[key] for row in rows if key in row])) for key in keys}


def pool_regions(parts: list[dict[str, Region]], r_buffer: bool) -> dict[str, dict[str, float | int]]:
    """T.L1, R.L1 and share of pixels of each region, pooled over all frames; a region without pixels is left out."""
    pooled: dict[str, dict[str, float | int]] = {}
    for name in parts[0]:
        total = Region(*(sum(values) for values in zip(*(part[name] for part in parts), strict=True)))
        if total.pixels:
            pooled[name] = {"pixels": total.pixels, "T.L1": total.t_l1 / total.pixels}
            if r_buffer and total.landings:
                pooled[name]["R.L1"] = total.r_l1 / total.landings
    return pooled
