"""Mitsuba: start it with a variant that works on this machine, or say what is missing; its sensors."""

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from catacaustics.cameras import Camera
from catacaustics.errors import UserError
from catacaustics.geometry import rigid_inverse

VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")
VECTORISED = VARIANTS[:2]
OLDEST_LLVM = 17
"""Older ones end the whole process on some processors: "Cannot select fminimum"."""
_LLVM_REMEDY = f"install the library of LLVM {OLDEST_LLVM} or newer (Debian, Ubuntu: `apt-get install -y libllvm19`)"


def choose_variant(variant: str = "auto", known: Sequence[str] = VARIANTS) -> str:
    """Start Mitsuba with a variant and return its name; `auto` takes the first of `known` that works.

    Raises:
        UserError: Mitsuba is missing, or the variant asked for does not work here.
    """
    if variant not in ("auto", *known):
        raise UserError(f"There is no variant {variant}.", f"one of auto, {', '.join(known)}", "name one of them")
    try:
        import drjit as dr
        import mitsuba as mi
    except ImportError as error:
        raise UserError(
            "Mitsuba is not installed.", "the Python package mitsuba", "pip install 'catacaustics[scenes]'"
        ) from error
    scalar = ", or use --variant scalar_rgb" if "scalar_rgb" in known else ""
    problems = []
    for name in known if variant == "auto" else (variant,):
        try:
            mi.set_variant(name)
            np.array(mi.Float(1.0) + 1.0)  # the compiler or driver is looked for only now
            if name == "llvm_ad_rgb" and (version := dr.detail.llvm_version())[0] < OLDEST_LLVM:
                raise RuntimeError(f"LLVM {version[0]} is too old")
        except (RuntimeError, ImportError) as error:
            problems.append(f"{name}: {str(error).strip().splitlines()[-1]}")
            continue
        if name == "scalar_rgb" and variant == "auto":
            print(
                f"No usable LLVM library: rendering with scalar_rgb, which is slow. To go faster, {_LLVM_REMEDY}.",
                file=sys.stderr,
            )
        return name
    remedy = _LLVM_REMEDY + scalar if variant in ("auto", "llvm_ad_rgb") else "use --variant auto"
    raise UserError(f"Mitsuba cannot start {'; '.join(problems)}.", "a working Mitsuba variant", remedy)


def perspective_sensor(camera: Camera, near: float, far: float, sampler: str) -> Any:
    """Mitsuba's sensor of a camera with square pixels and a box filter, for linear RGB images; needs a variant."""
    import mitsuba as mi

    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * camera.fx)))),
            "fov_axis": "x",
            "near_clip": near,
            "far_clip": far,
            "to_world": mi.ScalarTransform4f(rigid_inverse(camera.camera_from_world) @ np.diag([-1.0, -1.0, 1.0, 1.0])),
            "sampler": {"type": sampler},
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
        }
    )
