"""The viewer: its cameras, and that a browser sees what `render` makes."""

import copy
import shutil
import socket
import threading
import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import viser
from stand_in import make_run
from toy import make_toy_capture

from catacaustics import cli
from catacaustics.capture.dataset import open_capture
from catacaustics.config import TrainConfig
from catacaustics.errors import UserError
from catacaustics.images import read_image, read_image_bytes
from catacaustics.metrics import psnr
from catacaustics.reflectors.volume import build_volume
from catacaustics.run import open_run
from catacaustics.scene import Scene
from catacaustics.training.initialize import Reflector, initial_scene, primary_seeds, reflection_seeds, start_warps
from catacaustics.web import live
from catacaustics.web.viewer import Viewer, _quaternion, serve, window_camera

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return open_capture(make_toy_capture(tmp_path_factory.mktemp("capture"), width=128, height=96))


@pytest.fixture(scope="module")
def scene(capture):
    config = TrainConfig(capture.root, capture.root, primary_points=3000, reflection_points=300, environment_width=20)
    reflector, rng = Reflector(build_volume(capture, "ball"), "sphere"), np.random.default_rng(0)
    warps = start_warps(capture, [reflector], config)
    seeds = [primary_seeds(capture, [reflector], config.primary_points, rng)]
    seeds += [reflection_seeds(capture, reflector.volume, warps[0], config.reflection_points, rng)]
    return initial_scene(capture, [reflector.volume], warps, seeds, 1.0, config)


def test_a_window_that_stands_where_a_photograph_was_taken_has_its_camera(capture):
    for shown in capture.views:
        camera = shown.camera
        pose = camera.camera_from_world[:3, :3].T
        fov = 2 * np.arctan(camera.height / 2 / camera.fy)
        made = window_camera(_quaternion(pose), camera.center, fov, camera.width, camera.height)
        np.testing.assert_allclose(made.camera_from_world, camera.camera_from_world, atol=1e-12)
        np.testing.assert_allclose(made.intrinsics, camera.intrinsics)


def test_a_shifted_camera_moves_along_its_own_axes(capture):
    camera = capture.views[0].camera
    moved = camera.displaced(np.array([0.1, 0.2, 0.3]))
    local = camera.camera_from_world[:3, :3] @ (moved.center - camera.center)
    np.testing.assert_allclose(local, [0.1, 0.2, 0.3])
    assert np.array_equal(moved.camera_from_world[:3, :3], camera.camera_from_world[:3, :3])


def test_a_run_in_training_is_opened_at_its_last_checkpoint_only_where_that_is_wanted(capture, scene, tmp_path):
    run = make_run(tmp_path / "run", capture)
    (run / "scene.safetensors").unlink()
    scene.save(run / "checkpoint.safetensors", {"step": torch.zeros(1)})
    with pytest.raises(UserError, match="training has not finished"):
        open_run(run)
    opened = open_run(run, device="cpu", unfinished=True)
    assert len(opened.scene.primary) == len(scene.primary)


def test_another_state_of_the_scene_takes_the_place_of_the_first(capture, scene, tmp_path):
    scene.save(tmp_path / "scene.safetensors")
    later = Scene.load(tmp_path / "scene.safetensors")
    with torch.no_grad():
        later.primary.positions += 1
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    try:
        viewer = Viewer(server, scene, capture, tmp_path, 480)
        assert not viewer.clouds  # nobody wants to see them yet
        viewer.clouds_shown.value = "all"
        viewer._choose_shown()
        first = viewer.clouds["primary"].points.astype(float).mean(0)
        assert list(viewer.clouds) == ["primary", "reflection ball"]
        viewer.show(later)
        np.testing.assert_allclose(viewer.clouds["primary"].points.astype(float).mean(0), first + 1, atol=0.01)
        camera = capture.views[0].camera
        assert torch.equal(viewer.render(camera).rgb, later.render(camera).rgb)
    finally:
        server.stop()


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine: apt-get install chromium (as .ci/run does)")
def test_a_browser_shows_the_frame_that_render_makes(capture, scene, tmp_path):
    """The picture goes through JPEG and is stretched to the window, so it is compared smoothed. The browser draws it in
    its own time, so it is looked at until it is there."""
    import cv2

    sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install playwright")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    viewer = Viewer(server, scene, capture, tmp_path, 480)
    arguments = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]

    def seen() -> np.ndarray:
        path = tmp_path / "page.png"
        page.screenshot(path=path)
        return read_image(path)[:, 320:600]  # between the browser's messages and the controls

    def smooth(image: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(np.float32(image), (0, 0), 3)

    def expected(camera, warp=None) -> np.ndarray:
        image = scene.render(camera, warp_camera=warp).rgb.numpy()
        return cv2.resize(image, (960, 600), interpolation=cv2.INTER_LINEAR)[:, 320:600]

    def wait_until(come_true) -> None:
        deadline = time.monotonic() + 60
        while not come_true():
            assert time.monotonic() < deadline
            page.wait_for_timeout(100)

    try:
        with sync_api.sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
            page = browser.new_page(viewport={"width": 960, "height": 600})
            requests = []
            page.on("request", lambda request: requests.append(request.url))
            page.goto(f"http://127.0.0.1:{port}/")
            wait_until(lambda: viewer.windows and "at 480 x 300" in viewer.status.content)
            window = next(iter(viewer.windows.values()))
            camera = window.camera(480)
            np.testing.assert_allclose(camera.center, capture.views[0].camera.center, atol=1e-4)
            frame = expected(camera)
            wait_until(lambda: psnr(smooth(seen()), smooth(frame)) > 35)
            other = expected(capture.views[3].camera.resized(480, 300))
            assert psnr(smooth(other), smooth(frame)) < 25  # another view would not have passed

            page.get_by_role("button", name="Save picture").click()
            saved = tmp_path / "pictures" / "001.png"
            wait_until(saved.is_file)
            picture = scene.render(camera).rgb.numpy()
            assert np.abs(read_image_bytes(saved) / 255 - picture).max() < 0.01

            page.get_by_role("button", name="Freeze here").click()
            viewer._go(window.client, 3)
            there = capture.views[3].camera.center
            wait_until(lambda: np.allclose(window.camera(480).center, there, atol=1e-4))
            assert viewer.warp.value == "frozen"
            turned = window.camera(480)
            np.testing.assert_allclose(viewer.warp_camera(turned).center, camera.center, atol=1e-4)
            frame = expected(turned, camera)
            wait_until(lambda: psnr(smooth(seen()), smooth(frame)) > 35)
            assert all(url.startswith((f"http://127.0.0.1:{port}/", "data:", "blob:")) for url in requests)
            browser.close()
    finally:
        viewer.close()
        server.stop()


class Looker:
    """What a browser's window is to the viewer, without a browser."""

    client_id = 7

    def __init__(self, camera):
        self.pictures, self.scene, pose = [], self, camera.camera_from_world
        aspect = camera.width / camera.height
        self.camera = SimpleNamespace(
            wxyz=_quaternion(pose[:3, :3].T), position=camera.center, fov=0.8, aspect=aspect, on_update=lambda _: None
        )
        self.atomic = nullcontext

    def add_notification(self, *_, **__):
        pass

    def set_background_image(self, image, *_, **__):
        self.pictures.append(image)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


def test_a_training_is_copied_only_while_somebody_looks_and_shown_as_it_was(capture, scene, tmp_path, monkeypatch):
    monkeypatch.setattr(live, "_SECONDS", 0.0)
    monkeypatch.setattr(live, "_SHARE", 1e9)
    view = live.LiveView(capture, tmp_path, 64, free_port(), browser=False)
    training = copy.deepcopy(scene)
    try:
        view.watch(training)
        view.watch(training)
        assert view.copies == 1  # the first one; then nobody looked
        looker = Looker(capture.views[0].camera)
        view.viewer._connect(looker)
        with torch.no_grad():
            training.primary.features += 0.3
        view.watch(training)
        assert view.copies == 2
        camera = capture.views[0].camera
        expected = training.render(camera).rgb
        with torch.no_grad():
            training.primary.features += 0.3  # the training goes on
        assert torch.equal(view.viewer.render(camera).rgb, expected)
        deadline = time.monotonic() + 30
        while not any(image.shape[1] == 64 for image in looker.pictures):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        assert view.viewer.drawing_seconds > 0
        view.viewer._disconnect(looker)
        view.watch(training)
        assert view.copies == 2
    finally:
        view.close()


def test_an_interrupted_film_of_the_viewer_goes_on(capture, scene, tmp_path, monkeypatch):
    server, _ = serve(free_port(), browser=False)
    try:
        viewer = Viewer(server, scene, capture, tmp_path, 64)
        looker = Looker(capture.views[0].camera)
        event = SimpleNamespace(client=looker)
        viewer._connect(looker)
        viewer.path = [v.camera.resized(32, 24) for v in capture.views[:2]]
        viewer.seconds.value, viewer.fps.value = 0.5, 12.0
        drawn, render = [], viewer.render

        def interrupted(camera):
            drawn.append(camera)
            if len(drawn) == 4:
                raise KeyboardInterrupt
            return render(camera)

        monkeypatch.setattr(viewer, "render", lambda c: interrupted(c) if c.width == 32 else render(c))
        with pytest.raises(KeyboardInterrupt):
            viewer._save_film(event)
        assert not (tmp_path / "films" / "001.mp4").exists()
        viewer._save_film(event)
        assert len(drawn) == 4 + 3  # of six frames three were finished
        assert (tmp_path / "films" / "001.mp4").read_bytes()[4:8] == b"ftyp"
    finally:
        viewer.close()
        server.stop()


def test_watching_takes_its_share_of_the_time_at_most(capture, scene, tmp_path):
    view = live.LiveView(capture, tmp_path, 64, free_port(), browser=False)
    try:
        view.watch(scene)
        assert view.due >= time.monotonic() + live._SECONDS - 1
        view.viewer.windows[1] = SimpleNamespace(close=lambda: None)
        view.due, view.viewer.drawing_seconds = 0.0, 5.0
        view.viewer.touch = lambda: None
        view.watch(scene)
        assert view.due > time.monotonic() + 45  # five seconds of drawing in fifty
    finally:
        view.close()


def test_a_viewer_that_closes_waits_for_the_picture_under_way_and_sends_none_after_it(capture, scene, tmp_path):
    view = live.LiveView(capture, tmp_path, 64, free_port(), browser=False)
    view.watch(scene)
    viewer, looker = view.viewer, Looker(capture.views[0].camera)
    begun, render = threading.Event(), viewer.render

    def slowly(camera):
        begun.set()
        time.sleep(0.3)
        return render(camera)

    viewer.render = slowly
    viewer._connect(looker)
    viewer.touch()
    assert begun.wait(30)
    view.close()
    assert looker.pictures == []
    assert not any(thread.is_alive() for thread in viewer.threads)


def test_what_goes_wrong_with_the_window_does_not_stop_the_training(capture, scene, tmp_path, capsys):
    view = live.LiveView(capture, tmp_path, 64, free_port(), browser=False)
    try:
        view.start = lambda scene: 1 / 0
        view.watch(scene)
        view.watch(scene)
        assert capsys.readouterr().out.count("the training goes on") == 1
    finally:
        view.close()


def test_train_opens_the_viewer_and_closes_it_when_it_is_done(tmp_path, capsys):
    root = make_toy_capture(tmp_path / "capture")
    small = ["--iterations", "25", "--image-size", "64", "--primary-points", "1000", "--environment-width", "20"]
    assert cli.main(["train", str(root), str(tmp_path / "run"), "--model", "none", *small, "--view"]) == 0
    told = capsys.readouterr().out
    port = int(told.split("has a scene:\n\n    http://127.0.0.1:")[1].split("/")[0])
    with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port), timeout=5):
        pass
    assert (tmp_path / "run" / "scene.safetensors").is_file()
