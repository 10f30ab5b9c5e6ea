"""The house stands: imports point downward, the package is light, files are small."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import catacaustics

PACKAGE = Path(catacaustics.__file__).parent

# Bottom up. Modules of one folder share a floor and may import one another.
FLOORS = [
    "shapes",
    "errors",
    "threads",
    "config",
    "kernels",
    "files",
    "geometry",
    "cameras",
    "images",
    "points",
    "splatting",
    "capture",
    "reflectors",
    "renderer_native",
    "renderer",
    "environment",
    "scene",
    "losses",
    "metrics",
    "run",
    "layers",
    "page",
    "training",
    "report",
    "evaluation",
    "catacaustic",
    "ablation",
    "editing",
    "video",
    "stereo",
    "tracking",
    "export",
    "reconstruct",
    "refraction",
    "web",
    "doctor",
    "cli",
]


def imports_of(path: Path) -> set[str]:
    """Package modules a file imports when it is loaded (imports inside functions are listed separately below)."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("catacaustics."):
            names.add(node.module.split(".")[1])
    return names


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_file_imports_only_from_floors_below_or_its_own_folder(path):
    floor = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if floor == "__init__":
        return
    assert floor in FLOORS, f"{floor} has no place in the house yet: add it to FLOORS"
    above = {name for name in imports_of(path) if FLOORS.index(name) > FLOORS.index(floor)}
    allowed = {"reflectors"} if floor == "capture" else set()  # calibration checks masks against the volume
    assert above <= allowed, f"{path.name} imports {above} from above"


def test_importing_the_package_needs_only_torch_and_numpy():
    heavy = "scipy cv2 pycolmap open3d matplotlib av torchmetrics tyro plyfile safetensors mitsuba"
    code = (
        "import sys; import catacaustics, catacaustics.scene, catacaustics.splatting;"
        f"print([m for m in {heavy.split()!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_training_needs_neither_pycolmap_nor_open3d_and_help_needs_nothing_heavy():
    code = "import sys; sys.modules.update(pycolmap=None, open3d=None); import catacaustics.training.loop"
    subprocess.run([sys.executable, "-c", code], check=True)
    code = (
        "import sys; from catacaustics.cli import main; main(['--help']);"
        "assert not {'torch', 'numpy', 'tyro'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_no_file_is_longer_than_600_lines_and_none_defers_annotations():
    for path in [*PACKAGE.rglob("*.py"), *PACKAGE.parent.glob("tools/**/*.py"), *PACKAGE.parent.glob("tests/*.py")]:
        text = path.read_text()
        assert len(text.splitlines()) <= 600, path
        assert "from __future__ import " + "annotations" not in text, path
