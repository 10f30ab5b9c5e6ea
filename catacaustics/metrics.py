"""How near a rendered image is to its photograph: PSNR, SSIM, FLIP and, where its weights are installed, LPIPS.

Images are RGB, float32, sRGB values in [0, 1]. The renders are clamped to [0, 1] and not rounded to 8 bits. Over many
views the mean of the per-view values is reported, which is the field's practice (averaging the squared errors first
would give another, lower PSNR); PSNR is capped so that one perfect view cannot make a mean infinite.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from catacaustics.shapes import Bool, Float

PSNR_CAP = 100.0
"""dB. Stands for the infinite PSNR of identical images; a mean squared error of 1e-10 reaches it."""

PROTOCOL = {
    "psnr": f"-10 log10(MSE) in dB, MSE over pixels and channels, data range 1.0, capped at {PSNR_CAP:g} dB",
    "ssim": "mean of the per-pixel map over pixels and channels; Gaussian window 11 x 11, sigma 1.5, "
    "K1 = 0.01, K2 = 0.03, data range 1.0, reflected borders (torchmetrics)",
    "flip": "mean of the per-pixel LDR-FLIP map, 67.02 pixels per degree (flip-evaluator's default)",
    "inside": "PSNR: MSE over the mask's pixels; SSIM, FLIP: mean of the whole image's map over the mask's pixels",
    "mean": "mean of the per-view values",
    "images": "sRGB in [0, 1]; renders clamped, not rounded to 8 bits",
}
"""What the numbers mean, in words; every metrics.json and report states it."""

_PIXELS_PER_DEGREE = 67.02064514160156


@dataclass(frozen=True)
class Metrics:
    """Errors of one image, or their means.

    Args:
        psnr: peak signal-to-noise ratio in dB, at most PSNR_CAP; higher is better.
        ssim: structural similarity, at most 1; higher is better.
        flip: FLIP error in [0, 1]; lower is better.
        lpips: LPIPS distance of the whole image, lower is better; None where it was not measured.
    """

    psnr: float
    ssim: float
    flip: float
    lpips: float | None = None

    def as_dict(self) -> dict[str, float]:
        """For JSON: what was not measured is left out."""
        return {key: value for key, value in asdict(self).items() if value is not None}


@dataclass(frozen=True, eq=False)
class Comparison:
    """A render measured against its photograph.

    Args:
        whole: over all pixels.
        inside: over the mask's pixels; None without a mask or where it is empty.
        flip_map: FLIP error of every pixel, in [0, 1].
    """

    whole: Metrics
    inside: Metrics | None
    flip_map: Float[np.ndarray, "height width"]


def compare(
    render: Float[np.ndarray, "height width 3"],
    photo: Float[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"] | None = None,
) -> Comparison:
    """Measure a render against its photograph, everywhere and inside a mask.

    Raises:
        ValueError: other sizes, a side below 11 pixels (SSIM's window), or values that are not finite.
    """
    if render.shape != photo.shape or (mask is not None and mask.shape != photo.shape[:2]):
        raise ValueError(f"compare needs images of one size, got {render.shape}, {photo.shape}")
    if min(photo.shape[:2]) < 11:
        raise ValueError(f"compare needs 11 or more pixels a side, got {photo.shape[1]} x {photo.shape[0]}")
    if not (np.isfinite(render).all() and np.isfinite(photo).all()):
        raise ValueError("compare needs finite images")
    render, photo = (np.clip(image, 0, 1).astype(np.float32) for image in (render, photo))
    ssim, flip = ssim_map(render, photo), flip_map(render, photo)
    inside = None
    if mask is not None and mask.any():
        inside = Metrics(psnr(render[mask], photo[mask]), float(ssim[mask].mean()), float(flip[mask].mean()))
    distance = None if lpips_missing() else _lpips(render, photo)
    return Comparison(Metrics(psnr(render, photo), float(ssim.mean()), float(flip.mean()), distance), inside, flip)


def mean_metrics(values: Sequence[Metrics]) -> Metrics:
    """Means of the per-view values; LPIPS only where every view has it.

    Raises:
        ValueError: no values.
    """
    if not values:
        raise ValueError("mean_metrics needs one or more values")
    lpips = [v.lpips for v in values if v.lpips is not None]
    return Metrics(
        float(np.mean([v.psnr for v in values])),
        float(np.mean([v.ssim for v in values])),
        float(np.mean([v.flip for v in values])),
        float(np.mean(lpips)) if len(lpips) == len(values) else None,
    )


def psnr(render: Float[np.ndarray, "*n 3"], photo: Float[np.ndarray, "*n 3"]) -> float:
    """PSNR in dB over all pixels and channels, at most PSNR_CAP."""
    import torch
    from torchmetrics.functional.image import peak_signal_noise_ratio

    preds, target = (torch.from_numpy(np.ascontiguousarray(x, np.float64)) for x in (render, photo))
    return min(float(peak_signal_noise_ratio(preds, target, data_range=1.0)), PSNR_CAP)


def ssim_map(
    render: Float[np.ndarray, "height width 3"], photo: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width"]:
    """Structural similarity around every pixel, mean of the channels (Wang et al., TIP 2004)."""
    import torch
    from torchmetrics.functional.image import structural_similarity_index_measure

    preds, target = (torch.from_numpy(np.ascontiguousarray(x)).movedim(-1, 0)[None] for x in (render, photo))
    _, values = structural_similarity_index_measure(
        preds, target, gaussian_kernel=True, sigma=1.5, kernel_size=11, data_range=1.0, return_full_image=True
    )
    return values[0].mean(0).numpy()


def flip_map(
    render: Float[np.ndarray, "height width 3"], photo: Float[np.ndarray, "height width 3"]
) -> Float[np.ndarray, "height width"]:
    """LDR-FLIP error of every pixel (Andersson et al., HPG 2020)."""
    import flip_evaluator

    parameters = {"ppd": _PIXELS_PER_DEGREE}
    values, _, _ = flip_evaluator.evaluate(
        np.ascontiguousarray(photo),
        np.ascontiguousarray(render),
        "LDR",
        applyMagma=False,
        computeMeanError=False,
        parameters=parameters,
    )
    return values[..., 0]


def lpips_missing() -> str:
    """Why LPIPS cannot be measured here, or "" where it can. Weights are never downloaded."""
    import torch

    try:
        from torchvision.models import VGG16_Weights  # pyright: ignore[reportMissingImports]
    except ImportError:
        return "torchvision is not installed"
    weights = Path(torch.hub.get_dir()) / "checkpoints" / Path(VGG16_Weights.DEFAULT.url).name
    return "" if weights.is_file() else f"the weights {weights.name} are not in torch's hub folder"


@cache
def _lpips_network() -> Any:
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    return LearnedPerceptualImagePatchSimilarity(net_type="vgg", normalize=True)


def _lpips(render: np.ndarray, photo: np.ndarray) -> float:
    import torch

    network = _lpips_network()
    images = (torch.from_numpy(np.ascontiguousarray(x)).movedim(-1, 0)[None] for x in (render, photo))
    with torch.no_grad():
        value = float(network(*images))
    network.reset()
    return value
