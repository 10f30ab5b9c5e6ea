"""The widest vectors of the CPU's splatter on processors that lack them: compilers make several narrower ones of each.

What depends on their width is compiled nowhere else on such a machine: tiles of 32 pixels, sets of 128 blocks.
"""

import functools
import platform
import re
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from splatter import DTYPES, KERNELS, WIDE, assert_like_reference, device, moved_camera, random_scene

from catacaustics import kernels
from catacaustics.cameras import Viewport
from catacaustics.kernels import load_library

SOURCES = ("bins", "blend_forward", "blend_backward", "project", "threads", "describe")
COMPILER = shutil.which("g++") or shutil.which("clang++")


@functools.cache
def wide_library():
    """The splatter compiled for this machine with vectors of 64 bytes, from a copy of the sources: the width follows
    from the processor's level there and is nobody's to choose."""
    folder = Path(tempfile.mkdtemp())
    shutil.copytree(KERNELS, folder / "cuda_ext")
    header = folder / "cuda_ext" / "cpu" / "simd.h"
    text, changes = re.subn(r"(constexpr int kVectorBytes =) \d+;", r"\1 64;", header.read_text())
    assert changes == 3
    header.write_text(text)
    flags = ["-std=c++17", "-O1", "-fPIC", "-fvisibility=hidden", "-pthread", "-w", "-Wno-psabi"]
    flags += ["-march=native"] if platform.machine() == "x86_64" else []
    flags += ["-DCATACAUSTICS_LEVEL=1", '-DCATACAUSTICS_ARCH="this machine"', '-DCATACAUSTICS_COMPILER=""']

    def build(name):
        made = folder / f"{name}.o"
        source = folder / "cuda_ext" / "cpu" / f"{name}.cpp"
        subprocess.run([COMPILER, *flags, "-c", str(source), "-o", str(made)], check=True, timeout=200)
        return str(made)

    with ThreadPoolExecutor() as pool:
        objects = list(pool.map(build, SOURCES))
    path = folder / "libcatacaustics_wide.so"
    subprocess.run([COMPILER, "-shared", "-pthread", *objects, "-o", str(path)], check=True, timeout=200)
    return load_library(path)


@pytest.mark.skipif(not COMPILER, reason="no C++ compiler")
@DTYPES
@pytest.mark.parametrize("channels", [0, 7, 20])
def test_vectors_of_64_bytes_give_what_the_reference_gives(monkeypatch, dtype, channels):
    library = wide_library()
    assert library.tile == 32
    monkeypatch.setattr(kernels, "find_library", lambda _: kernels.Found(library, ""))
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "cpu")
    monkeypatch.setattr(device, "backend", "cpu, 64")
    scene = random_scene(400, channels, dtype=dtype, size=0.05)
    scene[2][::7] *= 100  # some cover the tiles, most touch a few blocks
    camera, window = moved_camera(150, 110, 120.0, dtype), Viewport(5, 3, 131, 97)
    assert_like_reference(scene, camera, window, WIDE, case=f"{channels} channels")
