"""One frozen dataclass a command: the same object is the Python API, the command line and config.json.

Fields without a default are positional arguments; the text below a field is its help.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class CalibrateConfig:
    """Photographs in, a calibrated capture with a fused point cloud out."""

    photos: Path
    """Folder of photographs, a COLMAP workspace (images/ and sparse/), or a folder with transforms.json."""
    capture: Path
    """Folder to write; finished stages found there are kept."""
    masks: Path | None = None
    """Reflector masks at the size of the photographs: MASKS/REFLECTOR/STEM.png, white = reflector."""
    max_size: int = 1600
    """Longer side of the undistorted photographs in pixels; larger photographs are reduced."""
    camera_model: Literal["SIMPLE_RADIAL", "OPENCV", "PINHOLE"] = "SIMPLE_RADIAL"
    """Lens model that structure from motion estimates."""
    held_out_every: int = 8
    """Every n-th photograph is held out for measuring."""
    stereo_size: int = 800
    """Longer side of the images that multi-view stereo works on."""


@dataclass(frozen=True)
class SplatConfig:
    """What the splatter computes; every cut-off is here and nowhere else."""

    low_pass: float = 0.3
    """nu: variance in px^2 added to both axes of every footprint (a pixel-sized low-pass filter)."""
    support: float = 3.33
    """Mahalanobis radius of a splat: it contributes nothing outside this ellipse (3.33: below 1/255 of its opacity)."""
    alpha_min: float = 0.0
    """Contributions with less alpha are dropped; 0 is exact, 1/255 is common practice."""
    near: float = 0.01
    """Points nearer to the camera plane than this (world units) are dropped."""
    pair_budget: int = 4_000_000
    """Splat-pixel pairs held at a time: bounds memory at about 60 bytes a pair; results do not depend on it."""
