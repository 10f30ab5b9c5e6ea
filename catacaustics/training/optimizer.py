"""Adam with a learning rate a kind of parameter; rows can be added without losing its moments."""

import math

import torch
from torch import Tensor, nn

from catacaustics.config import TrainConfig
from catacaustics.scene import Scene


def _rate(name: str, config: TrainConfig, extent: float, progress: float, warm_up: bool) -> float:
    """Learning rate of a parameter at a progress in [0, 1] (after the warm-up, where geometry stands still)."""

    def decay(start: float, end: float) -> float:
        return start * math.exp(progress * math.log(end / start))

    kind = name.split(".")[-1]
    if name.startswith(("renderer.", "warps.")):
        return decay(config.lr_network, config.lr_network_final)
    if kind == "positions":
        return 0.0 if warm_up else extent * decay(config.lr_position, config.lr_position_final)
    if kind == "normals" and warm_up:
        return 0.0
    start = {
        "normals": config.lr_normal,
        "log_footprints": config.lr_footprint,
        "opacity_logits": config.lr_opacity,
        "rho_logits": config.lr_opacity,
        "features": config.lr_features,
    }[kind]
    return decay(start, start * config.lr_final_share)


def make_optimizer(scene: Scene, config: TrainConfig) -> torch.optim.AdamW:
    """One group a parameter, named. Weight decay acts on the warps only (paper section 5.2)."""
    groups = [
        {
            "params": [parameter],
            "name": name,
            "lr": 0.0,
            "weight_decay": config.warp_weight_decay if name.startswith("warps.") else 0.0,
        }
        for name, parameter in scene.named_parameters()
        if parameter.requires_grad
    ]
    # Losses are weighted by 0.05 and spread over thousands of points: gradients are far below Adam's default eps.
    return torch.optim.AdamW(groups, eps=1e-15, fused=True)


def set_rates(optimizer: torch.optim.AdamW, config: TrainConfig, extent: float, progress: float, warm_up: bool) -> None:
    for group in optimizer.param_groups:
        group["lr"] = _rate(group["name"], config, extent, progress, warm_up)


def append_rows(optimizer: torch.optim.AdamW, module: nn.Module, prefix: str, rows: dict[str, Tensor]) -> None:
    """Add rows to parameters of a module; the moments of new rows start at zero, those of old rows stay."""
    for group in optimizer.param_groups:
        attribute = group["name"].removeprefix(prefix + ".")
        if not group["name"].startswith(prefix + ".") or attribute not in rows:
            continue
        old = group["params"][0]
        grown = nn.Parameter(torch.cat([old.detach(), rows[attribute]]))
        state = optimizer.state.pop(old, {})
        for key in ("exp_avg", "exp_avg_sq"):
            if key in state:
                state[key] = torch.cat([state[key], torch.zeros_like(rows[attribute])])
        optimizer.state[grown] = state
        group["params"] = [grown]
        setattr(module, attribute, grown)


def optimizer_tensors(optimizer: torch.optim.AdamW) -> dict[str, Tensor]:
    """The moments as named tensors, for the checkpoint."""
    return {
        f"adam.{group['name']}.{key}": value
        for group in optimizer.param_groups
        for key, value in optimizer.state.get(group["params"][0], {}).items()
    }


def restore_optimizer(optimizer: torch.optim.AdamW, tensors: dict[str, Tensor]) -> None:
    for group in optimizer.param_groups:
        parameter = group["params"][0]
        state = {k: tensors.get(f"adam.{group['name']}.{k}") for k in ("step", "exp_avg", "exp_avg_sq")}
        if all(v is not None for v in state.values()):
            optimizer.state[parameter] = {k: v.to(parameter.device) for k, v in state.items() if v is not None}
