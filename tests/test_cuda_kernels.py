"""The GPU's kernels where there is no GPU: compiled by NVIDIA's compiler, and run thread by thread on a CPU core.

The tests of test_splatting.py, test_parity.py and test_hard_cases.py run on the emulated kernels too (backend
`emulated`).
"""

import re
import shutil
import struct
import subprocess

import pytest
import torch
from splatter import DTYPES, KERNELS, emulated_library, front_camera, random_scene, results, splat_points

from catacaustics import kernels
from catacaustics.cameras import Viewport
from catacaustics.splatting.config import SplatConfig

NVCC = shutil.which("nvcc") or shutil.which("/usr/local/cuda/bin/nvcc")


@pytest.fixture
def emulated(monkeypatch):
    """Splats with the emulated kernels."""
    found = emulated_library()
    if found.problem:
        pytest.skip(found.problem)
    monkeypatch.setattr(kernels, "find_library", lambda _: found)
    return found.library


def crowd(dtype=torch.float32):
    """400 splats, small and large, in 3 x 3 tiles that are cut off by the viewport, several chunks in each."""
    scene = random_scene(400, 7, dtype=dtype, size=0.05)
    scene[2][::7] *= 100
    return scene, front_camera(60, 50, 60.0), Viewport(5, 3, 41, 37)


DETERMINISTIC = SplatConfig(alpha_min=1e-3, deterministic=True)


needs_nvcc = pytest.mark.skipif(not NVCC, reason="no CUDA compiler (nvcc)")


def known_generations():
    """Those of 80, 90, 100 and 120 that this compiler knows."""
    known = subprocess.run([NVCC, "--list-gpu-code"], capture_output=True, text=True, check=True).stdout.split()
    return [arch for arch in (80, 90, 100, 120) if f"sm_{arch}" in known]


def machine_code(data):
    """Generations of which a file of nvcc's holds machine code. Each of its containers is a header, in which its length
    is, and entries: kind (2 is machine code, 1 is text for later compilers), lengths of header and body, generation."""
    found = set()
    for at in (match.start() for match in re.finditer(b"\x50\xed\x55\xba", data)):
        header, length = struct.unpack_from("<HQ", data, at + 6)
        entry, end = at + header, at + header + length
        while entry < end:
            kind, _, size, body = struct.unpack_from("<HHIQ", data, entry)
            found |= {struct.unpack_from("<I", data, entry + 28)[0]} if kind == 2 else set()
            if kind not in (1, 2):
                break  # these bytes stand in the code by chance
            entry += size + body
    return found


@needs_nvcc
def test_compilers_from_12_8_on_know_every_generation():
    said = subprocess.run([NVCC, "--version"], capture_output=True, text=True, check=True).stdout
    version = tuple(map(int, re.search(r"release (\d+)\.(\d+)", said).groups()))
    assert known_generations() == [80, 90, 100, 120] or version < (12, 8)


@needs_nvcc
def test_the_library_holds_code_for_every_generation_that_its_compiler_knows():
    path = next((folder / "libcatacaustics_cuda.so" for folder in kernels._folders() if folder.is_dir()), None)
    if path is None or not path.is_file():
        pytest.skip("the GPU's library is not built")
    data = path.read_bytes()
    archs = known_generations()
    assert machine_code(data) == set(archs)
    said = " ".join(f"sm_{arch}" for arch in archs)  # its description, for doctor
    assert f"{said} + PTX".encode() in data


@needs_nvcc
def test_every_kernel_compiles_for_every_generation_of_gpus_and_keeps_its_sums_in_registers(tmp_path):
    archs = known_generations()
    targets = f"--generate-code=arch=compute_80,code=[{','.join(f'sm_{arch}' for arch in archs)}]"  # as in the build
    flags = [
        "--fatbin",
        "-std=c++17",
        "--threads=0",
        "-Xptxas=-v",
        '-DCATACAUSTICS_ARCHS="all"',
        "-odir",
        str(tmp_path),
    ]
    sources = sorted(map(str, (KERNELS / "cuda").glob("*.cu")))
    done = subprocess.run([NVCC, *flags, targets, *sources], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    compiled = sorted(tmp_path.iterdir())
    assert len(compiled) == len(sources)
    assert all(machine_code(path.read_bytes()) == set(archs) for path in compiled)
    # Of the kernels in float32 that training spends its time in.
    frames = re.findall(r"Function properties for \S+(blend_\w+If\S+)\n\s*(\d+) bytes stack frame", done.stderr)
    assert len(frames) >= 6 * len(archs)
    assert not [name for name, stack in frames if int(stack) > 32]  # an array of sums takes 64 bytes or more


@pytest.mark.skipif(not shutil.which("cmake"), reason="no CMake")
def test_a_build_that_fails_leaves_its_reason_for_doctor_and_lets_the_other_libraries_be(tmp_path, monkeypatch):
    compiler = tmp_path / "nvcc"
    compiler.write_text("#!/bin/sh\necho 'nvcc fatal : Unsupported gpu architecture'; exit 1\n")
    compiler.chmod(0o755)
    folder = tmp_path / "_native"
    folder.mkdir()
    places = {
        "nvcc": compiler,
        "library": folder / "libcatacaustics_cuda.so",
        "failure": folder / "cuda_failure.txt",
        "stamp": tmp_path / "built",
    }
    defined = [f"-D{name}={path}" for name, path in places.items()]
    subprocess.run(["cmake", *defined, "-P", str(KERNELS / "cuda" / "build.cmake")], check=True, capture_output=True)
    assert places["stamp"].exists()
    monkeypatch.setattr(kernels, "_folders", lambda: [folder])
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    problem = kernels.find_library.__wrapped__("cuda").problem
    assert problem == "it could not be built: nvcc fatal : Unsupported gpu architecture"


@DTYPES
def test_no_result_depends_on_the_order_in_which_threads_and_blocks_run(emulated, monkeypatch, dtype):
    forward = results(*crowd(dtype), DETERMINISTIC, "cpu")
    monkeypatch.setenv("EMULATED_ORDER", "reversed")
    for name, value in results(*crowd(dtype), DETERMINISTIC, "cpu").items():
        assert torch.equal(value, forward[name]), name


def test_atomic_additions_give_the_gradients_of_the_ordered_ones(emulated):
    ordered = results(*crowd(), DETERMINISTIC, "cpu")
    for name, value in results(*crowd(), SplatConfig(alpha_min=1e-3), "cpu").items():
        torch.testing.assert_close(value, ordered[name], rtol=0, atol=1e-5 * float(ordered[name].abs().max()))


@pytest.mark.parametrize("settings", [{"deterministic": True}, {"stop_transmittance": 0.3}], ids=str)
def test_kernels_write_all_that_they_read_and_stay_within_their_memory(emulated, monkeypatch, settings):
    """All memory is handed out full of not-a-numbers, between fences."""
    config = SplatConfig(alpha_min=1e-3, **settings)
    expected = results(*crowd(), config, "cpu")
    fenced, plain_empty = [], torch.empty

    def empty(*size, **options):
        if options.get("dtype") != torch.uint8:
            return plain_empty(*size, **options)
        fenced.append((torch.full((size[0] + 128,), 255, dtype=torch.uint8), size[0]))
        return fenced[-1][0][64 : 64 + size[0]]

    monkeypatch.setattr(torch, "empty", empty)
    torch.use_deterministic_algorithms(True)  # fills torch's own new memory with not-a-numbers
    try:
        for name, value in results(*crowd(), config, "cpu").items():
            torch.testing.assert_close(value, expected[name], rtol=0, atol=1e-5 * float(expected[name].abs().max()))
    finally:
        torch.use_deterministic_algorithms(False)
    assert len(fenced) > 10
    for memory, size in fenced:
        assert memory[:64].eq(255).all()
        assert memory[64 + size :].eq(255).all()


def test_two_tiles_never_share_a_checkpoint():
    """floor(b / c) - floor(a / c) + 1 rows are enough for the entries from a to b, c a row."""
    a, b = torch.meshgrid(torch.arange(200), torch.arange(200), indexing="ij")
    for chunk in (8, 16):
        rows = torch.div(b, chunk, rounding_mode="floor") - torch.div(a, chunk, rounding_mode="floor") + 1
        assert (rows * chunk >= b - a)[b >= a].all()


def test_a_kernel_that_fails_is_an_error_and_not_the_end_of_the_process(emulated):
    scene, camera, viewport = crowd()
    with pytest.raises(ValueError, match="viewports of up to a million pixels"):
        splat_points(*scene, camera, viewport._replace(width=2**21, height=1), backend="cpu")
