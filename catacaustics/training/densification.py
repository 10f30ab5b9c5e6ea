"""Densification of the primary cloud: where the image pulls hard at a point, a second one is needed (paper 5.2)."""

import torch

from catacaustics.scene import Scene
from catacaustics.splatting import SplatOutput
from catacaustics.training.optimizer import RowAdam, append_rows


class GradientStatistics:
    """Running sums, a point: length of the view-space position gradient, times seen, and the world-space gradient."""

    def __init__(self, count: int, device: torch.device):
        self.length = torch.zeros(count, device=device)
        self.seen = torch.zeros(count, device=device)
        self.direction = torch.zeros(count, 3, device=device)

    def add_screen(self, splats: SplatOutput) -> None:
        """Add one patch's view-space gradients, after backward; `splats.screen` must have retained its gradient."""
        gradient = splats.screen.grad
        if gradient is not None:
            self.length.index_add_(0, splats.visible, gradient.norm(dim=1))
            self.seen.index_add_(0, splats.visible, torch.ones_like(gradient[:, 0]))


def densify(scene: Scene, optimizer: RowAdam, statistics: GradientStatistics, share: float, cap: int) -> int:
    """The points with the highest mean view-space gradient spawn a copy one radius downhill. Returns how many.

    Args:
        share: share of the points that spawn.
        cap: number of points that is never exceeded.
    """
    cloud = scene.primary
    mean = statistics.length / statistics.seen.clamp_min(1)
    count = min(int(share * len(cloud)), cap - len(cloud), int((mean > 0).sum()))
    if count <= 0:
        return 0
    chosen = torch.topk(mean, count).indices
    downhill = -torch.nn.functional.normalize(statistics.direction[chosen], dim=1)
    with torch.no_grad():
        rows = {
            name: parameter.detach()[chosen].clone()
            for name, parameter in cloud.named_parameters()
            if parameter.requires_grad
        }
        rows["positions"] = rows["positions"] + downhill * rows["log_footprints"].exp().sqrt()[:, None]
        append_rows(optimizer, cloud, "primary", rows)
    return count
