"""What the splatter computes."""

import math
from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True)
class SplatConfig:
    """What the splatter computes; every cut-off is here and nowhere else. The defaults are exact within `support`.

    The side of a tile is no setting: no result depends on it, and native libraries are compiled for the one that is
    fastest on their processor (16 pixels; 32 with AVX-512).
    """

    low_pass: float = 0.3
    """nu: variance in px^2 added to both axes of every footprint (a pixel-sized low-pass filter)."""
    support: float = 3.33
    """Mahalanobis radius of a splat: it contributes nothing outside this ellipse (3.33: below 1/255 of its opacity)."""
    alpha_min: float = 0.0
    """Contributions with less alpha are dropped; 0 is exact, 1/255 is common practice."""
    stop_transmittance: float = 0.0
    """Early stop: what lies behind is not drawn in a pixel where transmittance has fallen below this; 0 is exact, 1e-4
    is common practice. Image and gradients belong to the same function."""
    near: float = 0.01
    """Points nearer to the camera plane than this (world units) are dropped."""
    guard_band: float = 0.5
    """Points whose centre lies farther outside the image than this share of its size are dropped: beside the camera the
    affine projection is meaningless, and one such point would cover the image."""
    pair_budget: int = 4_000_000
    """PyTorch only: splat-pixel pairs held at a time, about 60 bytes each; results do not depend on it."""
    deterministic: bool = False
    """GPU only: gradients are the same bit for bit in every run, as always on the CPU, for more memory and time."""

    def __post_init__(self):
        """Raise ValueError for settings that mean nothing; for ones that are not numbers, too."""
        rules = {
            "low_pass": (0 <= self.low_pass < math.inf, "at least 0 and finite"),
            "support": (0 < self.support < math.inf, "above 0 and finite"),
            "alpha_min": (0 <= self.alpha_min < 1, "in [0, 1)"),
            "stop_transmittance": (0 <= self.stop_transmittance < 1, "in [0, 1)"),
            "near": (0 < self.near < math.inf, "above 0 and finite"),
            "guard_band": (0 <= self.guard_band < math.inf, "at least 0 and finite"),
            "pair_budget": (0 < self.pair_budget < math.inf, "above 0 and finite"),
        }
        for name, (right, wanted) in rules.items():
            if not right:
                raise ValueError(f"{name} must be {wanted}, got {getattr(self, name)}")

    @classmethod
    def exact(cls, **settings: Any) -> "SplatConfig":
        """No cut-off but `support`; other settings by name."""
        return replace(cls(alpha_min=0.0, stop_transmittance=0.0), **settings)

    @classmethod
    def fast(cls, **settings: Any) -> "SplatConfig":
        """Early stop, which saves most for its error; a cut-off of alpha saves less and errs more (figures: README).
        Other settings by name."""
        return replace(cls(alpha_min=0.0, stop_transmittance=1e-4), **settings)
