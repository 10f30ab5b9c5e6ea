"""What only native code has: operators of torch, threads, memory, processes, levels of the processor."""

import ctypes
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from splatter import (
    DTYPES,
    EVERYWHERE,
    TOLERANCE,
    WIDE,
    front_camera,
    needs_native,
    random_scene,
    results,
    splat_points,
)

from catacaustics import kernels
from catacaustics.cameras import Viewport
from catacaustics.kernels import NativeError, find_library, load_library
from catacaustics.splatting import native
from catacaustics.splatting.config import SplatConfig

pytestmark = needs_native


def test_a_function_that_splats_compiles_as_one_graph():
    """In a process of its own: the checks of shapes that tests add cannot be traced."""
    code = """
import sys, torch
sys.path.insert(0, sys.argv[1])
from splatter import front_camera, random_scene
from catacaustics.splatting import splat_points

scene, camera = [t.requires_grad_() for t in random_scene(50, dtype=torch.float32, size=0.1)], front_camera()
def loss(*scene):
    out = splat_points(*scene, camera, backend="cpu")
    return (out.image**2).sum() + out.transmittance.sum()

torch._dynamo.config.capture_dynamic_output_shape_ops = True  # how many points are visible is known when it runs
compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
for a, b in zip(torch.autograd.grad(compiled(*scene), scene), torch.autograd.grad(loss(*scene), scene)):
    torch.testing.assert_close(a, b)
"""
    subprocess.run([sys.executable, "-c", code, str(Path(__file__).parent)], check=True, timeout=200)


@pytest.mark.parametrize("low_pass", [0.3, 1e-4])
def test_projection_gradients_pass_finite_differences_for_the_camera_too(low_pass):
    positions, normals, footprints, opacities, _ = random_scene(7, size=0.2)
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, 0.3, -0.2], [-0.3, 0, 0.1], [0.2, -0.1, 0]]).double())
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turn, torch.tensor([0.1, -0.05, 0.2])
    lens = torch.tensor([30.0, 33.0, 12.3, 8.8], dtype=torch.float64)

    def projected(positions, normals, footprints, pose, lens):
        unit = torch.nn.functional.normalize(normals, dim=1)
        cuts = (-500, -500, 1000, 1000, low_pass, 3.33, 0.0, 0.01, *EVERYWHERE)
        return native.splat_project(positions, unit, footprints, opacities, pose, lens, *cuts)[:2]

    inputs = [t.clone().requires_grad_() for t in (positions, normals, footprints, pose, lens)]
    assert torch.autograd.gradcheck(projected, inputs, eps=1e-7, atol=1e-5, rtol=1e-5)


def test_the_operators_keep_torchs_rules():
    scene = random_scene(20, 3, dtype=torch.float32, size=0.1)
    points = [t.requires_grad_() for t in scene[:3]]
    pose, lens = torch.eye(4), torch.tensor([30.0, 33.0, 12.3, 8.8])
    window = [0, 0, 24, 18]
    camera = (pose.requires_grad_(), lens.requires_grad_(), *window)
    project = (*points, scene[3], *camera, 0.3, 3.33, 0.0, 0.01, *EVERYWHERE)
    torch.library.opcheck(native.splat_project, project)
    with torch.no_grad():
        means, forms, visible = native.splat_project(*project)
        screen = (means, forms, scene[3].detach(), visible, *window, 3.33, 0.0)
        torch.library.opcheck(native.splat_bin, screen)
        bins = native.splat_bin(*screen)
    inputs = [t.detach().requires_grad_() for t in (means, forms, scene[3], scene[4])]
    blend = (*inputs, visible, *bins, *window, 0.0, False)
    torch.library.opcheck(native.splat_blend, blend)
    with torch.no_grad():
        image, transmittance = native.splat_blend(*blend)
        splats = (scene[4].detach(), visible, *bins, *window, 0.0, False)
        torch.library.opcheck(native.splat_blend_backward, (image, transmittance, *splats))
        g = (torch.rand_like(means), torch.rand_like(forms))
        camera = [t.detach() for t in (*points, pose, lens)]
        torch.library.opcheck(native.splat_project_backward, (*g, *camera, visible, 0.3))


@DTYPES
def test_results_are_the_same_bit_for_bit_for_every_number_of_threads(dtype):
    scene, camera = random_scene(30_000, 5, dtype=dtype, size=0.02), front_camera(200, 150, 180.0)
    pose, lens = torch.eye(4, dtype=dtype), torch.tensor([180.0, 198.0, 100.3, 74.8], dtype=dtype)
    before, all_results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3, 7):
            torch.set_num_threads(threads)
            got = results(scene, camera, None, SplatConfig(), "cpu")
            inputs = [t.clone().requires_grad_() for t in (pose, lens)]
            window = [0, 0, 200, 150]
            means, forms, _ = native.splat_project(*scene[:4], *inputs, *window, 0.3, 3.33, 0.0, 0.01, *EVERYWHERE)
            (means.sum() + forms.sum()).backward()
            all_results.append([*got.values(), *(t.grad for t in inputs)])
    finally:
        torch.set_num_threads(before)
    for other in all_results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(all_results[0], other, strict=True))


def test_a_whole_image_has_the_gradients_of_its_halves_together():
    """Also where the gradients of the tiles do not fit memory at once."""
    scene, camera = random_scene(300_000, 16, dtype=torch.float32, size=0.002), front_camera(640, 400, 500.0)
    weights = torch.rand(400, 640, 16)

    def gradients(*windows):
        leaves = [t.clone().requires_grad_() for t in scene]
        for x0, width in windows:
            out = splat_points(*leaves, camera, Viewport(x0, 0, width, 400), backend="cpu")
            (out.image * weights[:, x0 : x0 + width]).sum().backward()
        return [t.grad for t in leaves]

    for whole, halves in zip(gradients((0, 640)), gradients((0, 320), (320, 320)), strict=True):
        torch.testing.assert_close(whole, halves, rtol=0, atol=1e-4 * float(whole.abs().max()))


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from Linux' /proc")
def test_memory_kept_for_calls_to_come_is_bounded_and_given_back_when_asked():
    def resident() -> int:
        ctypes.CDLL(None).malloc_trim(0)  # what is free in malloc is not held by the library
        return 1024 * int(Path("/proc/self/status").read_text().split("VmRSS:")[1].split()[0])

    scene = [t.requires_grad_() for t in random_scene(400_000, 8, dtype=torch.float32, size=0.002)]
    splat_points(*scene, front_camera(640, 400, 500.0), backend="cpu").image.sum().backward()
    before = resident()
    find_library("cpu").library.handle.catacaustics_release()
    assert 2**24 < before - resident() < 2**28 + 2**23


def test_the_screen_positions_are_in_the_graph_for_densification():
    scene = [t.requires_grad_() for t in random_scene(30, dtype=torch.float32, size=0.1)]
    out = splat_points(*scene, front_camera(), backend="cpu")
    out.screen.retain_grad()
    out.image.sum().backward()
    assert out.screen.grad.abs().max() > 0
    assert len(out.screen) == len(out.visible)


def test_every_variant_that_this_processor_runs_gives_the_same(monkeypatch):
    scene, camera = random_scene(2000, 6, dtype=torch.float32, size=0.05), front_camera(120, 90, 100.0)
    best = results(scene, camera, None, WIDE, "cpu")
    tried = 0
    for path in sorted(find_library("cpu").library.path.parent.glob("*_cpu*.so")):
        try:
            variant = load_library(path)
        except NativeError as error:
            assert "needs instructions that this processor lacks" in str(error)  # noqa: PT017
            continue
        tried += 1
        monkeypatch.setattr(kernels, "find_library", lambda _, variant=variant: kernels.Found(variant, ""))
        for name, value in results(scene, camera, None, WIDE, "cpu").items():
            largest = float(best[name].abs().max())
            torch.testing.assert_close(value, best[name], rtol=0, atol=TOLERANCE[torch.float32] * largest)
    assert tried


def test_a_forked_process_splats_too():
    code = (
        "import os, sys, torch; sys.path.insert(0, sys.argv[1]);"
        "from splatter import random_scene, front_camera;"
        "from catacaustics.splatting import splat_points;"
        "scene = random_scene(5000, dtype=torch.float32); torch.set_num_threads(2);"
        "splat_points(*scene, front_camera(), backend='cpu');"
        "child = os.fork();\n"
        "if child == 0:\n"
        "    out = splat_points(*scene, front_camera(), backend='cpu'); os._exit(0 if out.image.max() > 0 else 1)\n"
        "sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))"
    )
    subprocess.run([sys.executable, "-c", code, str(Path(__file__).parent)], check=True, timeout=100)
