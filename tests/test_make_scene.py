"""Path-traced captures: the renderer's conventions against closed forms, and every scene in miniature."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from catacaustics.cameras import pixel_centers
from catacaustics.capture.dataset import open_capture
from catacaustics.capture.truth import read_truth
from catacaustics.errors import UserError
from catacaustics.images import read_image
from catacaustics.refraction.variants import choose_variant

TOOLS = Path(__file__).parents[1] / "tools"
sys.path.insert(0, str(TOOLS))

from make_scene import MakeScene, check_camera, main, make_scene  # noqa: E402
from scene_maker.cameras import camera_at  # noqa: E402
from scene_maker.catalogue import SCENES  # noqa: E402
from scene_maker.model import Light, Reflector, SceneModel  # noqa: E402
from scene_maker.render import Renderer  # noqa: E402
from scene_maker.solids import box, panel, sheet  # noqa: E402

pytest.importorskip("mitsuba")


@pytest.fixture
def llvm() -> str:
    try:
        return choose_variant("llvm_ad_rgb")
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def small_ball(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("ball")
    make_scene(tiny("ball", folder), DETAIL)
    return folder


def gray(value: int):
    return lambda height, width: np.full((height, width, 3), value, np.uint8)


def tiny(scene: str, out: Path, **changes) -> MakeScene:
    # The scalar renderer has nothing to compile, which takes longer than these pictures.
    config = MakeScene(scene, out, width=32, height=24, train=2, held_out=1, spp=1, variant="scalar_rgb")
    return replace(config, **changes)


DETAIL = 0.06
"""Textures of the scenes made here: few texels."""


FAR_WALL = panel((-9, -9, 9), (0, 18, 0), (0, 0, -18), gray(128), 2)


def test_a_known_point_is_photographed_at_the_pixel_our_camera_projects_it_to(llvm):
    points = np.array([[0.0, 0, 0], [0.5, 0.3, -0.2], [-0.6, 0.2, 0.25], [0.2, -0.5, 0.3]])
    camera = camera_at(np.array([2.6, 0.4, 0.5]), np.array([0.1, 0, 0]), 160, 100, roll=0.2)
    toward = camera.center
    lights = []
    for p in points:
        # A small square light about the point that faces the camera.
        right = np.cross([0, 0, 1.0], toward - p)
        right *= 0.03 / np.linalg.norm(right)
        down = np.cross(right, toward - p)
        down *= 0.03 / np.linalg.norm(down)
        lights.append(Light(p - right / 2 - down / 2, right, down, (5, 5, 5)))
    behind = panel((9, 9, 9), (0, -1, 0), (0, 0, -1), gray(0), 12)
    renderer = Renderer(SceneModel([behind], lights, [], []))
    renderer.illuminate([np.zeros((3, 3, 3))])
    image = renderer.photograph(camera, 256, 0)[..., 0]
    pixels, _ = camera.project(points)
    for pixel in pixels:
        near = np.linalg.norm(pixel_centers(camera.viewport) - pixel, axis=-1) < 6
        weight = image * near
        seen = (pixel_centers(camera.viewport) * weight[..., None]).sum((0, 1)) / weight.sum()
        assert np.linalg.norm(seen - pixel) < 0.1


def test_the_depth_of_a_sphere_matches_the_closed_form(llvm):
    center, radius = np.array([0.1, -0.2, 0.3]), 0.4
    sphere = Reflector("ball", {"type": "sphere", "center": center.tolist(), "radius": radius})
    renderer = Renderer(SceneModel([FAR_WALL], [], [sphere], []))
    camera = camera_at(np.array([2.0, 0.5, 0.8]), center + 0.1, 64, 48, roll=0.3)
    truth, seen = renderer.truth(camera)
    rays = camera.ray_directions(pixel_centers(camera.viewport))
    a, b = (rays**2).sum(-1), ((camera.center - center) * rays).sum(-1)
    c = ((camera.center - center) ** 2).sum() - radius**2
    discriminant = b**2 - a * c
    np.testing.assert_array_equal(seen >= 0, discriminant > 0)
    depth = (-b - np.sqrt(np.maximum(discriminant, 0))) / a
    np.testing.assert_allclose(truth.depth[seen >= 0], depth[seen >= 0], rtol=2e-5)
    points = camera.unproject(pixel_centers(camera.viewport), truth.depth)[seen >= 0]
    np.testing.assert_allclose(truth.normals[seen >= 0], (points - center) / radius, atol=2e-3)


def test_what_a_flat_mirror_shows_lies_at_its_mirror_image(llvm):
    mirror = Reflector("mirror", {"type": "plane"}, sheet((0, -1, 1), (0, 2, 0), (0, 0, -2)))
    wall = panel((3, 40, 40), (1, -80, 0), (0, 0, -80), gray(128), 2)
    renderer = Renderer(SceneModel([wall], [], [mirror], []))
    camera = camera_at(np.array([1.5, 0.7, 0.4]), np.zeros(3), 48, 32)
    truth, _ = renderer.truth(camera)
    found = np.isfinite(truth.source).all(-1)
    assert found.any()
    np.testing.assert_array_equal(found, truth.mirror_mask)
    image = truth.source[found] * (-1, 1, 1)  # mirrored in the plane x = 0
    pixels, _ = camera.project(image)
    np.testing.assert_allclose(pixels, pixel_centers(camera.viewport)[found], atol=0.01)


def test_two_mirrors_at_a_right_angle_turn_the_picture_by_half_a_turn(llvm):
    sides = [sheet((0, 0, 2), (0, 2, 0), (0, 0, -4)), sheet((2, 0, 2), (-2, 0, 0), (0, 0, -4))]
    mirrors = [Reflector(f"side_{i}", {"type": "plane"}, side) for i, side in enumerate(sides)]
    wall = panel((25, -15, 20), (-40, 40, 0), (0, 0, -40), gray(128), 2)
    renderer = Renderer(SceneModel([wall], [], mirrors, []))
    camera = camera_at(np.array([1.2, 1.3, 0.1]), np.zeros(3), 32, 24)
    truth, _ = renderer.truth(camera)
    # Seen from inside the corner, a ray that meets both sides has turned back about the corner, the z axis.
    rays = camera.ray_directions(pixel_centers(camera.viewport))
    first = camera.unproject(pixel_centers(camera.viewport), truth.depth)
    on_x = np.abs(first[..., 0]) < 1e-4
    second = np.where(on_x, -first[..., 1] / rays[..., 1], -first[..., 0] / rays[..., 0])
    hit = first + second[..., None] * rays * np.where(on_x[..., None], (-1, 1, 1), (1, -1, 1))
    both = (second > 0) & (hit[..., :2] < 2 - 1e-3).all(-1) & (np.abs(hit[..., 2]) < 2 - 1e-3)
    both &= np.isfinite(truth.source).all(-1)
    assert both.mean() > 0.5
    pixels, _ = camera.project(truth.source[both] * (-1, -1, 1))
    np.testing.assert_allclose(pixels, pixel_centers(camera.viewport)[both], atol=0.01)


def test_an_open_white_floor_below_an_even_sky_is_as_bright_as_the_sky(llvm):
    sky = np.full((16, 32, 3), 0.75, np.float32)
    floor = panel((-1, 1, 0), (2, 0, 0), (0, -2, 0), gray(188), 8)  # sRGB 188 reflects half
    renderer = Renderer(SceneModel([floor], [], [], [], sky))
    light = renderer.irradiance(256, 0)
    np.testing.assert_allclose(np.concatenate([part.ravel() for part in light]), 0.75, rtol=0.02)
    renderer.illuminate(light)
    image = renderer.photograph(camera_at(np.array([0.1, 0, 1.0]), np.zeros(3), 16, 16), 4, 0)
    np.testing.assert_allclose(image, 0.75 * 0.503, rtol=0.03)


@pytest.mark.parametrize("scene", SCENES)
def test_every_scene_makes_a_capture(scene, tmp_path):
    make_scene(tiny(scene, tmp_path, train=1), DETAIL)
    capture = open_capture(tmp_path)
    assert [v.name for v in capture.held_out] == ["path_000.jpg"]
    assert capture.reflectors == (["ball", "egg"] if scene == "pair" else [scene])
    for view in capture.views:
        assert read_image(tmp_path / "images" / view.name).std() > 0.05
        truth = read_truth(tmp_path, view.name)
        masks = [capture.mask(view, reflector) for reflector in capture.reflectors]
        np.testing.assert_array_equal(np.any(masks, axis=0), truth.mirror_mask)
        assert np.isfinite(truth.source[truth.mirror_mask]).any()


def test_a_stopped_run_goes_on_and_keeps_what_is_finished(small_ball, tmp_path):
    folder = tmp_path / "ball"
    shutil.copytree(small_ball, folder)
    kept, lost = folder / "images/train_000.jpg", folder / "images/train_001.jpg"
    written = kept.stat().st_mtime_ns
    lost.unlink()
    make_scene(tiny("ball", folder), DETAIL)
    assert kept.stat().st_mtime_ns == written
    assert lost.read_bytes() == (small_ball / "images/train_001.jpg").read_bytes()  # the same seed
    assert not (folder / "light.npz").exists()


def test_another_seed_makes_other_pictures(small_ball, tmp_path):
    make_scene(tiny("ball", tmp_path, seed=1), DETAIL)
    a, b = (read_image(folder / "images/train_000.jpg") for folder in (small_ball, tmp_path))
    assert np.abs(a - b).mean() > 0.05


def test_a_folder_begun_with_other_settings_is_refused(small_ball):
    with pytest.raises(UserError, match="spp 1"):
        make_scene(tiny("ball", small_ball, spp=2), DETAIL)


def test_an_unknown_scene_is_refused_with_the_names_of_all(tmp_path, capsys):
    assert main(["teapot", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert all(name in said for name in SCENES)


def test_a_camera_inside_an_object_or_without_a_view_is_refused(llvm):
    sphere = Reflector("ball", {"type": "sphere", "center": [0, 0, 0], "radius": 0.3})
    crate = box((2, 0, -0.5), (1, 1, 1), gray(128))
    renderer = Renderer(SceneModel([FAR_WALL, *crate], [], [sphere], []))
    good = camera_at(np.array([0.0, 2, 0]), np.zeros(3), 48, 32)
    check_camera(renderer, "good.jpg", good)
    for eye, reason in (((2.0, 0, 0), "inside an object"), ((0, 0.37, 0), "0.07 m from"), ((4.0, 0, 0), "clear view")):
        with pytest.raises(UserError, match=reason):
            check_camera(renderer, "bad.jpg", camera_at(np.array(eye), np.zeros(3), 48, 32))


def without_llvm(code: str) -> subprocess.CompletedProcess:
    script = (
        f"import os, sys; os.environ['DRJIT_LIBLLVM_PATH'] = '/nothing/here.so'; sys.path.insert(0, {str(TOOLS)!r})\n"
    )
    return subprocess.run(
        [sys.executable, "-c", script + code], capture_output=True, text=True, timeout=120, check=False
    )


def test_a_missing_llvm_library_is_named():
    done = without_llvm("from catacaustics.refraction.variants import choose_variant; choose_variant('llvm_ad_rgb')")
    assert "UserError" in done.stderr
    assert "libllvm" in done.stderr


def test_without_llvm_the_scalar_renderer_traces_the_same_geometry_and_says_that_it_is_slow():
    done = without_llvm(
        "import numpy as np\n"
        "from scene_maker.render import Renderer\n"
        "from catacaustics.refraction.variants import choose_variant\n"
        "from scene_maker.cameras import camera_at\n"
        "from scene_maker.model import Reflector, SceneModel\n"
        "from scene_maker.solids import panel\n"
        "assert choose_variant('auto') in ('scalar_rgb', 'cuda_ad_rgb')\n"
        "wall = panel((-9, -9, 9), (0, 18, 0), (0, 0, -18), lambda h, w: np.full((h, w, 3), 188, np.uint8), 0.2)\n"
        "ball = Reflector('ball', {'type': 'sphere', 'center': [0, 0, 0], 'radius': 0.5})\n"
        "renderer = Renderer(SceneModel([wall], [], [ball], [], np.ones((8, 16, 3), np.float32)))\n"
        "renderer.illuminate(renderer.irradiance(2, 0))\n"
        "camera = camera_at(np.array([2.0, 0, 0]), np.zeros(3), 9, 9)\n"
        "truth, _ = renderer.truth(camera)\n"
        "print(round(float(truth.depth[4, 4]), 4), renderer.photograph(camera, 1, 0).shape)\n"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "1.5 (9, 9, 3)"
    assert "libllvm" in done.stderr or "cuda" in done.stderr.lower()
