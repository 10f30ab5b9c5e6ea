"""The layers of a rendered view as pictures for people: colours, weight, depth, error maps."""

from typing import Literal

import numpy as np

from catacaustics.scene import RenderOutput
from catacaustics.shapes import Bool, Float

Layer = Literal["rgb", "primary", "reflection", "weight", "depth"]

DEPTH_COLORMAP = "turbo"
ERROR_COLORMAP = "magma"
_EMPTY = 0.35
"""Gray of pixels without depth."""


def colorize(values: Float[np.ndarray, "*shape"], colormap: str) -> Float[np.ndarray, "*shape 3"]:
    """Numbers in [0, 1] (clamped) as colours of a matplotlib colormap, in [0, 1]."""
    from matplotlib import colormaps

    return colormaps[colormap](np.clip(values, 0, 1))[..., :3].astype(np.float32)


def depth_range(output: RenderOutput) -> tuple[float, float]:
    """1st and 99th percentile of the depth at pixels that are at least half covered; (0, 1) where there are none."""
    depth, covered = output.depth.cpu().numpy(), output.alpha.cpu().numpy() >= 0.5
    if not covered.any():
        return 0.0, 1.0
    near, far = np.percentile(depth[covered], (1, 99))
    return float(near), float(max(far, near * 1.001 + 1e-9))


def layer_image(output: RenderOutput, layer: Layer, depths: tuple[float, float]) -> Float[np.ndarray, "height width 3"]:
    """A layer as RGB in [0, 1].

    Args:
        depths: the depths at the two ends of the depth colours; pixels less than half covered are gray.
    """
    if layer in ("rgb", "primary", "reflection"):
        colors = {"rgb": output.rgb, "primary": output.primary_rgb, "reflection": output.reflection_rgb}[layer]
        return np.clip(colors.float().cpu().numpy(), 0, 1)
    if layer == "weight":
        weight = np.clip(output.reflection_weight.float().cpu().numpy(), 0, 1)
        return np.repeat(weight[..., None], 3, -1)
    near, far = depths
    depth = output.depth.float().cpu().numpy()
    covered = output.alpha.float().cpu().numpy() >= 0.5
    colors = colorize((depth - near) / (far - near), DEPTH_COLORMAP)
    return np.where(covered[..., None], colors, np.float32(_EMPTY))


def error_image(
    flip: Float[np.ndarray, "height width"], mask: Bool[np.ndarray, "height width"] | None
) -> Float[np.ndarray, "height width 3"]:
    """A FLIP error map in FLIP's colours, 0 to 1, with the mask's outline in white."""
    import cv2

    picture = colorize(flip, ERROR_COLORMAP)
    if mask is not None:
        outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        picture = cv2.drawContours(np.ascontiguousarray(picture), outlines, -1, (1.0, 1.0, 1.0), 1)
    return picture
