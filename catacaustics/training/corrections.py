"""What real photographs need: small corrections of camera poses, and exposure and white balance per photograph.

A pose correction moves the world by x -> c + R (x - c) + t in front of the camera as it was calibrated (c its centre):
the same picture as the corrected camera takes of the resting world. Gains multiply the decoded colours.
"""

import numpy as np
import torch
from torch import Tensor, nn

from catacaustics.cameras import Camera
from catacaustics.losses import dssim
from catacaustics.reflectors.warps import rotation_matrix
from catacaustics.scene import Motion, Scene, frozen
from catacaustics.shapes import Float


class Corrections(nn.Module):
    """Corrections of n photographs, all zero at the start.

    Args:
        count: photographs.
        poses, exposure: which of them are learned.
        extent: radius of the cameras; unit of the shifts.
    """

    extent: Tensor

    def __init__(self, count: int, poses: bool, exposure: bool, extent: float):
        super().__init__()
        self.register_buffer("extent", torch.tensor(extent))
        self.poses = nn.Parameter(torch.zeros(count, 6)) if poses else None
        self.log_gains = nn.Parameter(torch.zeros(count, 3)) if exposure else None

    def motion(self, index: int) -> Motion | None:
        """The correction of a photograph's pose, for Scene.layers."""
        if self.poses is None:
            return None
        return Motion(rotation_matrix(self.poses[index, :3]), self.poses[index, 3:] * self.extent)

    def expose(self, index: int, image: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 3"]:
        """An image as the photograph's camera would have exposed it."""
        return image if self.log_gains is None else image * self.log_gains[index].exp()

    def render(self, scene: Scene, camera: Camera, index: int = 0) -> Float[Tensor, "height width 3"]:
        """RGB in [0, 1] as a photograph's corrected camera takes it."""
        with torch.no_grad():
            image = scene.decode(scene.layers(camera, motion=self.motion(index)))
            return self.expose(index, image).clamp(0, 1)

    def summary(self, names: list[str]) -> list[dict[str, object]]:
        """Rotation in degrees, shift in world units and gains by photograph, for JSON."""
        rows: list[dict[str, object]] = [{"name": name} for name in names]
        for i, row in enumerate(rows):
            if self.poses is not None:
                pose = self.poses[i].detach()
                row["degrees"] = float(np.degrees(float(pose[:3].norm())))
                row["shift"] = float((pose[3:] * self.extent).norm())
            if self.log_gains is not None:
                row["gains"] = self.log_gains[i].detach().exp().tolist()
        return rows


def align_view(
    scene: Scene,
    camera: Camera,
    photo: Float[Tensor, "height width 3"],
    poses: bool,
    exposure: bool,
    extent: float,
    steps: int = 40,
) -> Corrections:
    """Fit pose and gains of one view to its photograph, with the scene frozen: a held-out view is measured with and
    without, because corrections of the training views leave the others where they were calibrated.

    Args:
        camera, photo: of equal size, that of the training: a coarser image of a cloud looks different, and another pose
            would fit it best.
    """
    corrections = Corrections(1, poses, exposure, extent).to(scene.device)
    if not list(corrections.parameters()):
        return corrections
    with frozen(scene):
        groups = [{"params": [p], "lr": rate} for p, rate in zip(corrections.parameters(), _rates(poses), strict=False)]
        optimizer = torch.optim.Adam(groups)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, 1e-5)
        for _ in range(steps):
            image = corrections.expose(0, scene.decode(scene.layers(camera, motion=corrections.motion(0))))
            loss = (image - photo).abs().mean() + dssim(image, photo)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return corrections


def _rates(poses: bool) -> tuple[float, ...]:
    """Learning rates of the parameters in their order: poses, then gains."""
    return (1e-3, 2e-2) if poses else (2e-2,)
