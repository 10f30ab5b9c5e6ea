"""One frozen dataclass a command: the same object is the Python API, the command line and config.json."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

# tyro is imported for positional markers only; it needs neither torch nor numpy.
Positional = tyro.conf.Positional


@dataclass(frozen=True)
class CalibrateConfig:
    """Photographs in, a calibrated capture with a fused point cloud out."""

    photos: Positional[Path]
    """Folder of photographs, a COLMAP workspace (images/ and sparse/), or a folder with transforms.json."""
    capture: Positional[Path]
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
