"""`catacaustics view`: walk through a trained scene in the browser, by viser.

Pictures are rendered here and sent to the browser: small ones while the camera moves, sized so that they keep up, and
sharp ones as soon as it stands still.
"""

import threading
import time
import webbrowser
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from catacaustics.cameras import Camera, interpolate_path, up_direction
from catacaustics.capture.dataset import Capture
from catacaustics.config import ViewConfig
from catacaustics.errors import UserError
from catacaustics.export import point_colors
from catacaustics.geometry import rigid, rigid_inverse
from catacaustics.images import to_bytes, write_image
from catacaustics.layers import Layer, depth_range, layer_image
from catacaustics.run import open_run, scene_file
from catacaustics.scene import PointParameters, RenderOutput, Scene
from catacaustics.shapes import Float, UInt8
from catacaustics.video import film_key, frame_count, write_film
from catacaustics.web.proposal import look_at_point
from catacaustics.web.server import has_screen

_FRAME_SECONDS = 0.1
"""A picture of a moving camera should take this long."""
_STILL_SECONDS = 0.2
_SHOWN_POINTS = 200_000
"""Most points of a cloud that are sent to the browser."""
_FOLLOWS, _FROZEN, _SHIFTED = "follows the view", "frozen", "shifted from the view"


def view(config: ViewConfig) -> None:
    """Serve the viewer until interrupted. A run that is still training is shown as of its last checkpoint.

    Raises:
        UserError: no scene yet, or no capture.
    """
    run = open_run(config.run, config.capture, config.device, unfinished=True)
    shown = scene_file(config.run, unfinished=True).stat().st_mtime_ns
    server, address = serve(config.port, config.browser)
    viewer = Viewer(server, run.scene, run.capture, run.folder, config.image_size)
    print(f"Viewer for {run.folder}:\n\n    {address}\n\nCtrl+C stops it.", flush=True)
    try:
        while True:
            time.sleep(2)
            path = scene_file(config.run, unfinished=True)
            newest = path.stat().st_mtime_ns if path.is_file() else shown
            if newest != shown:
                shown = newest
                viewer.show(Scene.load(path, run.scene.device))
    except KeyboardInterrupt:
        print("\nStopped.")
    finally:
        viewer.close()
        server.stop()


def serve(port: int, browser: bool) -> tuple[Any, str]:
    """A viser server on 127.0.0.1 at this port or the next free one, and its address, opened in the browser where that
    is wanted and there is a screen."""
    import viser

    server = viser.ViserServer(host="127.0.0.1", port=port, label="catacaustics", verbose=False)
    address = f"http://127.0.0.1:{server.get_port()}/"
    if browser and has_screen():
        webbrowser.open(address)
    return server, address


def window_camera(
    wxyz: Float[np.ndarray, "4"], position: Float[np.ndarray, "3"], fov: float, width: int, height: int
) -> Camera:
    """The camera of a browser window.

    Args:
        wxyz: quaternion of world_from_camera, OpenCV axes.
        fov: vertical angle of view in radians.
    """
    w, x, y, z = wxyz / np.linalg.norm(wxyz)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    focal = height / 2 / np.tan(fov / 2)
    pose = rigid_inverse(rigid(rotation, np.asarray(position, float)))
    return Camera(width, height, float(focal), float(focal), width / 2, height / 2, pose)


class Viewer:
    """The viewer's controls and one `_Window` for each browser that looks.

    Args:
        server: a viser server.
        folder: the run's folder; pictures and films are written below it.
        image_size: longer side of a still picture in pixels.
    """

    def __init__(self, server: Any, scene: Scene, capture: Capture, folder: Path, image_size: int):
        self.server, self.scene, self.capture, self.folder = server, scene, capture, Path(folder)
        self.lock = threading.Lock()
        self.windows: dict[int, _Window] = {}
        self.threads: list[threading.Thread] = []
        self.frozen: Camera | None = None
        self.path: list[Camera] = []
        self.clouds: dict[str, Any] = {}
        self.drawing_seconds = 0.0
        cameras = [v.camera for v in capture.train]
        self.target = look_at_point(cameras)
        self.reach = float(np.median([np.linalg.norm(c.center - self.target) for c in cameras]))
        server.scene.set_up_direction(tuple(up_direction(cameras)))
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._controls(image_size)
        self._show_cameras()
        self._show_scene()
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    def show(self, scene: Scene) -> None:
        """Go over to another state of the scene."""
        with self.lock:
            self.scene = scene
            self.drawing_seconds = 0.0
        self._show_scene()
        self.touch()

    def close(self) -> None:
        """Stop drawing and wait for the pictures under way: a server that has stopped takes none, and Python must not
        end inside of one."""
        for window in list(self.windows.values()):
            window.close()
        for thread in self.threads:
            thread.join()

    def touch(self) -> None:
        """Draw all windows again."""
        for window in list(self.windows.values()):
            window.changed.set()

    def warp_camera(self, camera: Camera) -> Camera | None:
        """The camera that decides where reflections lie; None: the view's own."""
        if self.warp.value == _FROZEN:
            return self.frozen
        if self.warp.value == _SHIFTED:
            return camera.displaced(np.array(self.offset.value, float) * self.reach)
        return None

    def render(self, camera: Camera) -> RenderOutput:
        """What the windows show from a camera."""
        with self.lock, torch.no_grad():
            return self.scene.render(camera, warp_camera=self.warp_camera(camera))

    # Controls --------------------------------------------------------------------------------------------------------

    def _controls(self, image_size: int) -> None:
        gui = self.server.gui
        self.status = gui.add_markdown("")
        self.layer = gui.add_dropdown("Layer", get_args(Layer))
        self.size = gui.add_slider("Picture size", min(200, image_size), max(2000, image_size), 20, image_size)
        names = [v.name for v in self.capture.views]
        self.photograph = gui.add_dropdown("Photograph", names)
        gui.add_button("Go there").on_click(lambda event: self._go(event.client, names.index(self.photograph.value)))
        with gui.add_folder("Show"):
            self.cameras_shown = gui.add_checkbox("Cameras", False)
            self.clouds_shown = gui.add_dropdown("Points", ("none", "primary", "reflections", "all"))
            self.volumes_shown = gui.add_checkbox("Reflection volumes", False)
        with gui.add_folder("Camera of the warp"):
            self.warp = gui.add_dropdown("It", (_FOLLOWS, _FROZEN, _SHIFTED))
            self.offset = gui.add_vector3("Right, down, forward", (0.0, 0.0, 0.0), step=0.01)
            gui.add_button("Freeze here").on_click(self._freeze)
        with gui.add_folder("Pictures and films"):
            gui.add_button("Save picture").on_click(self._save_picture)
            self.keys = gui.add_markdown("No key cameras yet.")
            gui.add_button("Add this camera").on_click(self._add_key)
            gui.add_button("Start anew").on_click(self._clear_keys)
            self.seconds = gui.add_number("Seconds", 5.0, min=0.5, max=600.0, step=0.5)
            self.fps = gui.add_number("Pictures a second", 24.0, min=1.0, max=120.0, step=1.0)
            self.quality = gui.add_slider("Quality (lower is better)", 0, 51, 1, 20)
            gui.add_button("Render film").on_click(self._save_film)
        for control in (self.layer, self.size, self.warp, self.offset):
            control.on_update(lambda _: self.touch())
        for control in (self.cameras_shown, self.clouds_shown, self.volumes_shown):
            control.on_update(lambda _: self._choose_shown())

    def _choose_shown(self) -> None:
        for frustum in self.frusta:
            frustum.visible = self.cameras_shown.value
        if self.clouds_stale and self.clouds_shown.value != "none":
            self._send_clouds()
        for name, cloud in self.clouds.items():
            kind = "primary" if name == "primary" else "reflections"
            cloud.visible = self.clouds_shown.value in (kind, "all")
        for mesh in self.meshes:
            mesh.visible = self.volumes_shown.value

    def _freeze(self, event: Any) -> None:
        self.frozen = self.windows[event.client.client_id].camera(16)
        self.warp.value = _FROZEN
        self.touch()

    def _go(self, client: Any, index: int) -> None:
        camera = self.capture.views[index].camera
        world_from_camera = rigid_inverse(camera.camera_from_world)
        with client.atomic():
            client.camera.wxyz = _quaternion(world_from_camera[:3, :3])
            client.camera.position = camera.center
            client.camera.fov = 2 * np.arctan(camera.height / 2 / camera.fy)
            # The window's camera turns about what lies ahead, as far away as the middle of the scene.
            forward = world_from_camera[:3, 2]
            ahead = max(float((self.target - camera.center) @ forward), 0.2 * self.reach)
            client.camera.look_at = camera.center + ahead * forward

    def _save_picture(self, event: Any) -> None:
        folder = self.folder / "pictures"
        number = 1 + max((int(p.stem) for p in folder.glob("*.png") if p.stem.isdecimal()), default=0)
        window = self.windows[event.client.client_id]
        picture = window.picture(self.render(window.camera(int(self.size.value))))
        self._try(event.client, folder / f"{number:03d}.png", lambda path: write_image(path, picture))

    def _add_key(self, event: Any) -> None:
        self.path.append(self.windows[event.client.client_id].camera(int(self.size.value)))
        self._tell_keys()

    def _clear_keys(self, event: Any) -> None:
        self.path = []
        self._tell_keys()

    def _tell_keys(self) -> None:
        self.keys.content = f"Key cameras: {len(self.path)}" if self.path else "No key cameras yet."

    def _save_film(self, event: Any) -> None:
        if len(self.path) < 2:
            event.client.add_notification("A film needs two cameras", "Add two or more.", auto_close_seconds=5)
            return
        folder = self.folder / "films"
        number = 1 + max((int(p.stem) for p in folder.glob("*.mp4") if p.stem.isdecimal()), default=0)
        cameras = interpolate_path(self.path, frame_count(self.seconds.value, self.fps.value))
        window = self.windows[event.client.client_id]

        def draw(i: int) -> np.ndarray:
            self.keys.content = f"Film: picture {i + 1} of {len(cameras)}"
            return window.picture(self.render(cameras[i]))

        frozen = self.frozen.camera_from_world.tolist() if self.frozen is not None else None
        settings = self.layer.value, self.warp.value, self.offset.value, frozen, window.depths
        with self.lock:
            state = b"".join(t.cpu().numpy().tobytes() for t in self.scene.state_dict().values())
        key = film_key(state, cameras, *settings)
        work = partial(write_film, count=len(cameras), draw=draw, key=key, fps=self.fps.value)
        self._try(event.client, folder / f"{number:03d}.mp4", partial(work, quality=int(self.quality.value)))
        self._tell_keys()

    def _try(self, client: Any, path: Path, work: Any) -> None:
        try:
            work(path)
            client.add_notification("Saved", str(path), auto_close_seconds=8)
        except UserError as error:
            client.add_notification(error.found, error.remedy, color="red")

    # What is drawn over the picture ----------------------------------------------------------------------------------

    def _show_cameras(self) -> None:
        self.frusta = []
        for i, shown in enumerate(self.capture.views):
            camera = shown.camera
            frustum = self.server.scene.add_camera_frustum(
                f"/cameras/{i}",
                fov=2 * np.arctan(camera.height / 2 / camera.fy),
                aspect=camera.width / camera.height,
                scale=0.06 * self.reach,
                thickness=0.003 * self.reach,
                color=(245, 184, 61) if i < len(self.capture.train) else (76, 195, 255),
                wxyz=_quaternion(camera.camera_from_world[:3, :3].T),
                position=camera.center,
                visible=False,
            )
            frustum.on_click(lambda event, index=i: self._go(event.client, index))
            self.frusta.append(frustum)

    def _show_scene(self) -> None:
        scene = self.server.scene
        self.meshes = []
        self.clouds_stale = True
        for volume in self.scene.volumes:
            self.meshes.append(
                scene.add_mesh_simple(
                    f"/volumes/{volume.name}",
                    volume.vertices,
                    volume.faces,
                    color=(245, 184, 61),
                    opacity=0.35,
                    visible=False,
                )
            )
        self._choose_shown()

    def _send_clouds(self) -> None:
        """The clouds' points to the browsers, at most _SHOWN_POINTS of each: only once they are wanted."""
        eye = np.mean([v.camera.center for v in self.capture.train], axis=0)
        self.clouds_stale, self.clouds = False, {}
        for name, cloud in [("primary", self.scene.primary), *_reflections(self.scene)]:
            rows = torch.randperm(len(cloud), generator=torch.Generator().manual_seed(0))[:_SHOWN_POINTS]
            rows = rows.to(self.scene.device)
            positions = cloud.positions.detach()[rows].float().cpu().numpy()
            colors = to_bytes(point_colors(self.scene, cloud, eye, rows))
            self.clouds[name] = self.server.scene.add_point_cloud(
                f"/points/{name}", positions, colors, point_size=0.004 * self.reach, visible=False
            )

    # Windows ---------------------------------------------------------------------------------------------------------

    def _connect(self, client: Any) -> None:
        window = self.windows[client.client_id] = _Window(self, client)
        self.threads = [thread for thread in self.threads if thread.is_alive()] + [window.thread]
        self._go(client, 0)

    def _disconnect(self, client: Any) -> None:
        window = self.windows.pop(client.client_id, None)
        if window is not None:
            window.close()


class _Window:
    """One browser window: a thread that draws it whenever something changed."""

    def __init__(self, viewer: Viewer, client: Any):
        self.viewer, self.client = viewer, client
        self.changed, self.open = threading.Event(), True
        self.share = 0.3  # of a still picture's width, for pictures of a moving camera
        self.depths = (0.0, 1.0)
        client.camera.on_update(lambda _: self.changed.set())
        self.thread = threading.Thread(target=self._work, daemon=True)
        self.thread.start()

    def close(self) -> None:
        self.open = False
        self.changed.set()

    def camera(self, size: int) -> Camera:
        """The window's camera with this many pixels on its longer side."""
        state = self.client.camera
        aspect = state.aspect
        width, height = (size, round(size / aspect)) if aspect >= 1 else (round(size * aspect), size)
        return window_camera(np.array(state.wxyz), np.array(state.position), state.fov, max(width, 8), max(height, 8))

    def picture(self, output: RenderOutput) -> UInt8[np.ndarray, "height width 3"]:
        """The chosen layer as a picture."""
        return to_bytes(layer_image(output, self.viewer.layer.value, self.depths))

    def _work(self) -> None:
        while self.open:
            self.changed.wait()
            self.changed.clear()
            if not self.open:
                return
            self._draw(self.share)
            # It moves on: another quick picture. It stands still: sharper ones, up to the full size.
            share = self.share
            while share < 1 and self.open and not self.changed.wait(_STILL_SECONDS):
                share = min(2.5 * share, 1.0)
                self._draw(share)

    def _draw(self, share: float) -> None:
        size = max(int(self.viewer.size.value * share), 32)
        start = time.perf_counter()
        output = self.viewer.render(self.camera(size))
        if share == 1:
            self.depths = depth_range(output)
        picture = self.picture(output)
        if not self.open:
            return
        self.client.scene.set_background_image(picture, "jpeg", jpeg_quality=92 if share == 1 else 80)
        seconds = time.perf_counter() - start
        self.viewer.drawing_seconds += seconds
        height, width = picture.shape[:2]
        self.viewer.status.content = f"{1 / seconds:.1f} frames/s at {width} x {height}"
        if share == self.share:
            self.share = float(np.clip(share * np.sqrt(np.clip(_FRAME_SECONDS / seconds, 0.25, 4)), 0.1, 1.0))


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """w, x, y, z."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat()[[3, 0, 1, 2]]


def _reflections(scene: Scene) -> list[tuple[str, PointParameters]]:
    """Reflection clouds, named so that no reflector's name is taken for the primary cloud's."""
    clouds = [cloud for cloud in scene.reflections if isinstance(cloud, PointParameters)]
    return [(f"reflection {volume.name}", cloud) for volume, cloud in zip(scene.volumes, clouds, strict=True)]
