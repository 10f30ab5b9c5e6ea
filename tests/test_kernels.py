"""Native libraries: built, found, checked; and what takes over where there is none."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from splatter import KERNELS, front_camera, needs_native, random_scene

from catacaustics import kernels
from catacaustics.errors import UserError
from catacaustics.kernels import NativeError, find_library, load_library
from catacaustics.splatting import splat_points


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A copy of the installed libraries, in which find_library looks; returns the folder."""
    folder = tmp_path / "_native"
    shutil.copytree(find_library("cpu").library.path.parent, folder)
    monkeypatch.setattr(kernels, "_folders", lambda: [folder])
    return folder


@pytest.mark.skipif(not (shutil.which("g++") or shutil.which("clang++")), reason="no C++ compiler")
def test_where_there_is_a_compiler_the_libraries_are_built():
    """Else all tests of native code would be skipped, and nobody would notice."""
    library, problem = find_library("cpu")
    assert library is not None, problem
    assert not shutil.which("nvcc") or (library.path.parent / "libcatacaustics_cuda.so").is_file()


@pytest.mark.skipif(not shutil.which("cmake"), reason="no CMake outside of the installation's own environment")
def test_without_a_compiler_the_package_installs_as_pure_python(tmp_path):
    source = tmp_path / "source"
    for name in ("catacaustics", "cuda_ext"):
        shutil.copytree(KERNELS.parent / name, source / name, ignore=shutil.ignore_patterns("_native", "*.pyc"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(KERNELS.parent / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", str(source)]
    subprocess.run([*command, "-w", str(tmp_path)], check=True, timeout=200, env=os.environ | {"CXX": "no-compiler"})
    [wheel] = tmp_path.glob("*.whl")
    assert wheel.name.endswith("-none-any.whl")


@needs_native
@pytest.mark.parametrize("name", ["empty", "text", "half", "zeroed", "foreign", "strange header"])
def test_a_damaged_or_foreign_library_is_refused_with_a_reason(name, installed):
    path = installed / find_library("cpu").library.path.name
    whole = path.read_bytes()
    middle = len(whole) // 2
    foreign = b"\xb7\x00" if whole[18:20] != b"\xb7\x00" else b"\x3e\x00"
    contents, reason = {
        "empty": (b"", "is not a shared library"),
        "text": (b"#!/bin/sh\n" * 100, "is not a shared library"),
        "half": (whole[:middle], "is cut short"),
        "zeroed": (whole[:middle] + bytes(len(whole) - middle), ""),  # as an interrupted copy leaves it
        "foreign": (whole[:18] + foreign + whole[20:], "another kind of processor"),
        "strange header": (whole[:54] + bytes(2) + whole[56:], "is cut short or damaged"),
    }[name]
    path.write_bytes(contents)
    with pytest.raises(NativeError, match="is not what SHA256SUMS beside it says"):
        load_library(path)
    if reason and sys.platform == "linux":  # what else is looked at: a file that somebody has built by hand has no sum
        (installed / "SHA256SUMS").unlink()
        with pytest.raises(NativeError, match=reason):
            load_library(path)


def test_a_library_that_is_missing_or_no_library_of_ours_is_refused(tmp_path):
    with pytest.raises(NativeError, match="is not there"):
        load_library(tmp_path / "libcatacaustics_cpu.so")
    other = next((Path(torch.__file__).parent / "lib").glob("libc10.*"))
    with pytest.raises(NativeError, match=r"cannot be loaded.*catacaustics_abi"):
        load_library(other)


@needs_native
def test_the_best_whole_library_is_taken_and_what_is_wrong_with_better_ones_is_kept(installed):
    best = find_library("cpu").library.path.name  # the first that is tried
    (installed / best).write_bytes((installed / best).read_bytes()[:5000])
    library, problem = find_library.__wrapped__("cpu")
    assert f"{best} is not what SHA256SUMS beside it says" in problem
    assert library is None or library.path.name != best
    for path in installed.glob("*.so"):
        path.unlink()
    library, problem = find_library.__wrapped__("cpu")
    assert library is None
    assert problem.startswith("not built: install again with")


def test_without_a_library_the_reference_takes_over_and_says_so_once(monkeypatch, caplog):
    monkeypatch.setattr(kernels, "find_library", lambda _: kernels.Found(None, "it was never built"))
    kernels._say_once.cache_clear()
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "auto")
    for _ in range(3):
        splat_points(*random_scene(5), front_camera())
    assert [r.getMessage() for r in caplog.records].count(
        "computing in PyTorch, which is many times slower than native code: it was never built"
    ) == 1
    kernels._say_once.cache_clear()
    with pytest.raises(UserError, match="it was never built"):
        splat_points(*random_scene(5), front_camera(), backend="cpu")


def test_a_backend_that_is_unknown_or_of_another_device_is_refused_by_name(monkeypatch):
    monkeypatch.setenv("CATACAUSTICS_BACKEND", "cdua")
    with pytest.raises(UserError, match="'cdua'"):
        splat_points(*random_scene(5), front_camera())
    with pytest.raises(UserError, match="backend cuda for tensors on cpu"):
        splat_points(*random_scene(5), front_camera(), backend="cuda")
