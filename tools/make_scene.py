"""Make a path-traced capture: photographs, exact cameras, masks and ground truth of a scene with reflectors.

    python tools/make_scene.py ball scenes/ball

Run it again to go on where it was stopped: finished views are kept. Needs Mitsuba 3 (the extra `scenes` of this
package) and, on a CPU, the LLVM library.
"""

import io
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from scene_maker.cameras import HandHeld, held_out_cameras
from scene_maker.catalogue import build
from scene_maker.model import SceneModel
from scene_maker.render import Renderer
from scene_maker.solids import ply_bytes
from tqdm import tqdm

from catacaustics.cameras import Camera
from catacaustics.capture.dataset import View, write_capture
from catacaustics.capture.truth import write_truth
from catacaustics.errors import UserError
from catacaustics.files import read_json, write_bytes, write_json
from catacaustics.geometry import sphere_directions
from catacaustics.images import write_image
from catacaustics.refraction.variants import choose_variant

CLEARANCE = 0.15
"""Free space that every camera needs around it, in metres."""


@dataclass(frozen=True)
class MakeScene:
    """Make a path-traced capture.

    Args:
        scene: ball, vase, bowl, blade, kettle, mirror or pair.
        out: folder of the capture.
        width: width of a view in pixels.
        height: height of a view in pixels.
        train: number of training views.
        held_out: number of held-out views.
        spp: samples a pixel, and a cell of the surfaces' light.
        seed: seed of the scene, its cameras and the noise.
        variant: Mitsuba variant; auto takes the fastest that works.
        quality: JPEG quality.
        truth_every: every n-th training and every m-th held-out view gets ground truth.
    """

    scene: Annotated[str, tyro.conf.Positional]
    out: Annotated[Path, tyro.conf.Positional]
    width: int = 480
    height: int = 320
    train: int = 60
    held_out: int = 12
    spp: int = 64
    seed: int = 0
    variant: Literal["auto", "cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb"] = "auto"
    quality: int = 92
    truth_every: tuple[int, int] = (1, 1)


def camera_problem(renderer: Renderer, camera: Camera) -> str | None:
    """What is wrong with where a camera stands: inside or close to a thing, or no clear view of a reflector."""
    sphere = sphere_directions(400)
    around = renderer.trace(np.broadcast_to(camera.center, sphere.shape), sphere)
    if around.back[around.reflector < 0].mean() > 0.5:  # a few back faces are seen inside lampshades and cups
        return "is inside an object"
    if around.distance.min() < CLEARANCE:
        return f"is {around.distance.min():.2f} m from a surface"
    _, reflector = renderer.truth(camera.resized(48, 32))
    if (reflector >= 0).mean() < 0.02:
        return "has no clear view of a reflector"
    return None


def check_camera(renderer: Renderer, name: str, camera: Camera) -> None:
    """Refuse a camera that no photographer could hold.

    Raises:
        UserError: it is inside or too close to a thing, or sees no reflector.
    """
    problem = camera_problem(renderer, camera)
    if problem:
        place = ", ".join(f"{v:.2f}" for v in camera.center)
        raise UserError(
            f"The camera of {name} at ({place}) {problem}.",
            f"cameras in free space, {CLEARANCE} m or more from every surface, with a clear view of a reflector",
            "use another --seed, or move the arcs of the scene in tools/scene_maker/catalogue.py",
        )


def training_cameras(renderer: Renderer, count: int, width: int, height: int, seed: int) -> list[Camera]:
    """Hand-held cameras; one that stands badly is drawn again, up to 40 times.

    Raises:
        UserError: no good place was found.
    """
    arcs = HandHeld(renderer.model.arcs, count, width, height)
    cameras = []
    for i in range(count):
        rng = np.random.default_rng([seed, 1, i])
        tries = (arcs.draw(i, rng) for _ in range(40))
        camera = next((c for c in tries if camera_problem(renderer, c) is None), arcs.draw(i, rng))
        check_camera(renderer, f"train_{i:03d}.jpg", camera)
        cameras.append(camera)
    return cameras


def develop(radiance: np.ndarray) -> np.ndarray:
    """Linear radiance as sRGB in [0, 1]: highlights above 0.6 roll off as film does instead of clipping."""
    x = np.clip(radiance, 0, None)
    x = np.where(x > 0.6, 0.6 + 0.4 * (1 - np.exp(-(x - 0.6) / 0.4)), x)
    return np.where(x < 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def _write_reflectors(out: Path, model: SceneModel) -> None:
    described = {}
    for reflector in model.reflectors:
        described[reflector.name] = dict(reflector.geometry)
        if reflector.mesh is not None:
            described[reflector.name]["mesh"] = f"{reflector.name}.ply"
            write_bytes(out / "truth" / f"{reflector.name}.ply", ply_bytes(reflector.mesh))
    write_json(out / "truth" / "reflectors.json", described)


def _start(config: MakeScene, variant: str) -> None:
    """Note how the capture is made; refuse a folder that was begun with other settings."""
    import mitsuba as mi

    settings = {k: v for k, v in asdict(config).items() if k not in ("out", "variant")}
    settings["truth_every"] = list(config.truth_every)  # as JSON gives it back
    path = config.out / "scene.json"
    if path.is_file():
        before = read_json(path).get("settings", {})
        changed = [f"{k} {before.get(k)}" for k in settings if before.get(k) != settings[k]]
        if changed:
            raise UserError(
                f"{config.out} holds a capture made with other settings: {', '.join(changed)}.",
                "the settings it was begun with, to go on; or an empty folder",
                "choose another folder, or delete this one",
            )
    else:
        write_json(path, {"settings": settings, "mitsuba": mi.__version__, "variant": variant})


def _illuminate(renderer: Renderer, config: MakeScene) -> Path:
    """Light the scene, or read the light of a run that was stopped. Returns the file that keeps it meanwhile."""
    path = config.out / "light.npz"
    if path.is_file():
        with np.load(path, allow_pickle=False) as file:
            light = [file[name] for name in file.files]
    else:
        light = [part.astype(np.float32) for part in renderer.irradiance(config.spp, config.seed)]
        buffer = io.BytesIO()
        np.savez(buffer, *light)
        write_bytes(path, buffer.getvalue())
    renderer.illuminate(light)
    return path


def make_scene(config: MakeScene, detail: float = 1.0) -> None:
    """Make a capture, or finish one that was begun. `detail` below 1 draws smaller textures, for tests.

    Raises:
        UserError: unknown scene, missing renderer, a folder with another capture, no room for the cameras.
    """
    model = build(config.scene, config.seed, detail)
    variant = choose_variant(config.variant)
    _start(config, variant)
    renderer = Renderer(model)
    size = (config.width, config.height)
    train = training_cameras(renderer, config.train, *size, config.seed)
    held_out = held_out_cameras(model.arcs, config.held_out, *size)
    views = [View(f"train_{i:03d}.jpg", c) for i, c in enumerate(train)]
    views += [View(f"path_{i:03d}.jpg", c) for i, c in enumerate(held_out)]
    for view in views[config.train :]:
        check_camera(renderer, view.name, view.camera)
    # A view's photograph is written last: where it is there, the view is finished.
    pending = [(i, v) for i, v in enumerate(views) if not (config.out / "images" / v.name).is_file()]
    light = _illuminate(renderer, config) if pending else None
    for i, view in tqdm(pending, desc=config.scene, unit="view"):
        truth, reflector = renderer.truth(view.camera)
        for k, r in enumerate(model.reflectors):
            if (reflector == k).any():  # a mask says: here it is seen
                write_image(config.out / "masks" / r.name / Path(view.name).with_suffix(".png"), reflector == k)
        every_train, every_held_out = config.truth_every
        if (i % every_train if i < config.train else (i - config.train) % every_held_out) == 0:
            write_truth(config.out, view.name, truth)
        image = develop(renderer.photograph(view.camera, config.spp, config.seed * len(views) + i))
        write_image(config.out / "images" / view.name, image, config.quality)
    _write_reflectors(config.out, model)
    names = [v.name for v in views]
    write_capture(config.out, views, {"train": names[: config.train], "held_out": names[config.train :]})
    if light:
        light.unlink()


def main(arguments: Sequence[str] | None = None) -> int:
    config = tyro.cli(MakeScene, args=arguments, description=__doc__)
    try:
        make_scene(config)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"{config.out}: {config.train} training and {config.held_out} held-out views of {config.scene}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
