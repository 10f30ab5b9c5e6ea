"""Export a scene, read its 3D Gaussians back and compare them with what they came from.

    python tools/export_scene.py RUN OUT

Everything that `catacaustics export` writes goes to OUT, and OUT/gaussians.jpg: the scene without reflections as it is
rendered here, and the same view of gaussians.ply, read as any viewer would read it. They differ where the scene's
network does more than mix the points' colours, and where only the environment map is seen.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from plyfile import PlyData

from catacaustics.cameras import Camera
from catacaustics.config import ExportConfig
from catacaustics.export import export
from catacaustics.images import write_image
from catacaustics.metrics import psnr
from catacaustics.run import named_view, open_run
from catacaustics.splatting import SplatOutput, splat_points


@dataclass(frozen=True)
class Export:
    """Export a run and check its Gaussians.

    Args:
        run: folder that training wrote.
        out: folder to write.
        view: photograph whose camera looks, and from which colours are taken; the first held-out one if none is named.
        width: of each picture in pixels.
    """

    run: Annotated[Path, tyro.conf.Positional]
    out: Annotated[Path, tyro.conf.Positional]
    view: str | None = None
    width: int = 480


def splat_gaussians(path: Path, camera: Camera) -> SplatOutput:
    """The picture of a 3D Gaussian file whose third axes are thin."""
    table = PlyData.read(path)["vertex"]

    def columns(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([np.asarray(table[name]) for name in names], -1))

    w, x, y, z = columns("rot_0", "rot_1", "rot_2", "rot_3").unbind(1)
    normals = torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
    colors = 0.5 + 0.5 / np.sqrt(np.pi) * columns("f_dc_0", "f_dc_1", "f_dc_2")
    return splat_points(
        columns("x", "y", "z"),
        torch.nn.functional.normalize(normals, dim=1),
        torch.exp(2 * columns("scale_0")[:, 0]),
        torch.sigmoid(columns("opacity")[:, 0]),
        colors,
        camera,
    )


def main(settings: Export) -> None:
    export(ExportConfig(settings.run, settings.out, settings.view))
    run = open_run(settings.run, device="cpu")
    camera = named_view(run.capture, settings.view).camera
    camera = camera.resized(settings.width, round(settings.width * camera.height / camera.width))
    own, read = run.scene.render(camera), splat_gaussians(settings.out / "gaussians.ply", camera)
    image = read.image.clamp(0, 1).numpy()
    write_image(settings.out / "gaussians.jpg", np.concatenate([own.primary_rgb.numpy(), image], 1))
    covered = (own.alpha > 0.9).numpy()
    likeness = psnr(image[covered], own.primary_rgb.numpy()[covered])
    print(
        f"gaussians.ply against the scene without reflections: {likeness:.1f} dB over {covered.mean():.0%} of the view"
    )


if __name__ == "__main__":
    main(tyro.cli(Export))
