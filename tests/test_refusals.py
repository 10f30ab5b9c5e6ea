"""What the splatter does not take, refused by name before anything is computed.

In a process of its own, as users call it: here in the tests annotations would refuse wrong shapes and types first.
"""

import subprocess
import sys
from pathlib import Path

from splatter import problem

CASES = {
    "splat(positions=[1, 2, 3])": "positions must be a torch.Tensor, got list",
    "splat(footprints=footprints.numpy())": "footprints must be a torch.Tensor, got ndarray",
    "splat(positions=torch.tensor(3.0))": "positions must have shape (n, 3), got ()",
    "splat(normals=normals[:5])": "normals must have shape (6, 3), got (5, 3)",
    "splat(features=torch.zeros(6))": "features must have shape (6, 6), got (6,)",
    "splat(opacities=opacities.double())": "opacities must be float32 or float64 like positions, got torch.float64",
    "splat(normals=normals.to('meta'))": "normals must be on cpu like positions, got meta",
    "splat(footprints=put(footprints, -2))": "footprints must be >= 0: 1 are not, the first at [3] is -2",
    "splat(footprints=footprints + 1e17)": "footprints must be <= 1e+15: 6 are not, the first at [0] is 1e+17",
    "splat(opacities=put(opacities, 1.5))": "opacities must be <= 1: 1 are not, the first at [3] is 1.5",
    "splat(normals=put(normals, inf))": "normals has 3 values that are not finite, the first at [3, 0]",
    "splat(camera=replace(camera, fx=nan))": "camera.fx must be finite, got nan",
    "splat(camera=replace(camera, cy=-inf))": "camera.cy must be finite, got -inf",
    "splat(camera=replace(camera, camera_from_world=bad_pose))": (
        "camera.camera_from_world has 1 values that are not finite, the first at [1, 2]"
    ),
    "splat(viewport=Viewport(0, 0, -3, 4))": (
        "viewport must be four whole numbers with width and height >= 0, got (0, 0, -3, 4)"
    ),
    "splat(viewport=Viewport(0, 0, 3.5, 4))": (
        "viewport must be four whole numbers with width and height >= 0, got (0, 0, 3.5, 4)"
    ),
    "points_in_view(positions, footprints[:3], camera, camera.viewport)": "footprints must have shape (6,), got (3,)",
    "points_in_view(positions, footprints.double(), camera, camera.viewport)": (
        "footprints must be float32 or float64 like positions, got torch.float64"
    ),
    "points_in_view(positions, footprints, replace(camera, cx=nan), camera.viewport)": (
        "camera.cx must be finite, got nan"
    ),
    "SplatConfig(support=nan)": "support must be above 0 and finite, got nan",
    "SplatConfig(low_pass=-1)": "low_pass must be at least 0 and finite, got -1",
    "SplatConfig(stop_transmittance=1)": "stop_transmittance must be in [0, 1), got 1",
}

CODE = """
import os, sys, torch, numpy as np
sys.path.insert(0, sys.argv[1])
from dataclasses import replace
from math import inf, nan
from catacaustics.cameras import Viewport
from catacaustics.splatting.config import SplatConfig
from catacaustics.splatting import points_in_view, splat_points
from splatter import front_camera, random_scene

positions, normals, footprints, opacities, features = random_scene(6, 6, dtype=torch.float32)
disks = dict(positions=positions, normals=normals, footprints=footprints, opacities=opacities, features=features)
camera, bad_pose = front_camera(), np.eye(4)
bad_pose[1, 2] = inf
def put(tensor, value):
    return tensor.index_fill(0, torch.tensor([3]), value)
def splat(**changes):
    return splat_points(**(disks | {"camera": camera} | changes))
for backend in sys.argv[2].split(","):
    os.environ["CATACAUSTICS_BACKEND"] = backend
    splat()
    for case in sys.argv[3:]:
        try:
            eval(case)
            print("not refused")
        except ValueError as error:
            print(error)
"""


def test_what_cannot_be_splatted_is_refused_with_its_name_what_came_and_what_was_expected():
    backends = [name for name in ("reference", "cpu") if not problem(name)]
    command = [sys.executable, "-c", CODE, str(Path(__file__).parent), ",".join(backends), *CASES]
    said = subprocess.run(command, check=True, capture_output=True, text=True, timeout=100).stdout.splitlines()
    for i, backend in enumerate(backends):
        assert (backend, dict(zip(CASES, said[i * len(CASES) :], strict=False))) == (backend, CASES)
    assert len(said) == len(backends) * len(CASES)
