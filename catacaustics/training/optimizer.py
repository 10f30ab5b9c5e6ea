"""Adam with a learning rate a kind of parameter, that leaves points alone which a step did not see.

A patch shows a few thousand of the points. Dense Adam would go on moving all others by their momentum, and a point that
is seen once in a hundred steps would travel 30 learning rates on one gradient. Here a row (a point) with no gradient
keeps its value and its moments, and every row counts its own steps for the bias correction. Rows can be added.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from catacaustics.config import TrainConfig
from catacaustics.kernels import host_kernel
from catacaustics.scene import Scene
from catacaustics.training.corrections import Corrections


def _decay(progress: float, start: float, end: float) -> float:
    return start * math.exp(progress * math.log(end / start))


def _rate(name: str, config: TrainConfig, extent: float, progress: float, warm_up: bool) -> float:
    """Learning rate of a parameter at a progress in [0, 1] (after the warm-up, where geometry stands still)."""
    kind = name.split(".")[-1]
    if name.startswith("corrections."):
        start = config.lr_pose if kind == "poses" else config.lr_exposure
        return 0.0 if warm_up else _decay(progress, start, start / 10)
    if name.startswith("renderer.") or ".network." in name:
        return _decay(progress, config.lr_network, config.lr_network_final)
    if name.startswith("warps."):
        return _decay(progress, config.lr_shape, config.lr_shape / 50)
    if name.startswith("reflections.") and kind == "positions":
        return _decay(progress, config.lr_source, config.lr_source / 100)  # times the row's distance from the reflector
    if name.startswith("environment."):
        return _decay(progress, config.lr_environment, config.lr_environment * config.lr_final_share)
    if kind == "positions":
        return 0.0 if warm_up else extent * _decay(progress, config.lr_position, config.lr_position_final)
    if kind == "normals" and warm_up:
        return 0.0
    start = {
        "normals": config.lr_normal,
        "log_footprints": config.lr_footprint,
        "opacity_logits": config.lr_opacity,
        "rho_logits": config.lr_opacity,
        "features": config.lr_features,
    }[kind]
    return _decay(progress, start, start * config.lr_final_share)


class RowAdam(torch.optim.Optimizer):
    """Adam (Kingma and Ba 2015), decoupled weight decay; in groups with `rows`, rows without a gradient stand still.

    Args:
        groups: one parameter each, with name, lr, weight_decay and rows, the number of leading axes that count rows
            (0: none); where a group has `row_rates` (n,), they multiply the learning rate of each row.
        betas, eps: as in Adam.
    """

    def __init__(self, groups: list[dict], betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15):
        super().__init__(groups, {"betas": betas, "eps": eps, "row_rates": None})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        for group in self.param_groups:
            parameter = group["params"][0]
            if parameter.grad is None or group["lr"] == 0 or parameter.numel() == 0:
                continue
            state = self.state[parameter]
            if not state:
                count = math.prod(parameter.shape[: group["rows"]])
                state["step"] = torch.zeros(count, device=parameter.device)
                state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
            if _native_step(group, parameter, state):
                continue
            if group["rows"]:
                moments = (state["exp_avg"], state["exp_avg_sq"])
                value, gradient, mean, square = (
                    t.flatten(0, group["rows"] - 1) for t in (parameter, parameter.grad, *moments)
                )
                seen = torch.nonzero(gradient.view(len(gradient), -1).any(1))[:, 0]
                tensors = (value, gradient, state["step"], mean, square)
                rows = [t.index_select(0, seen) for t in tensors]
                scale = group["row_rates"]
                _adam(rows, group, 1.0 if scale is None else scale.index_select(0, seen))
                for whole, part in zip(tensors, rows, strict=True):
                    if whole is not gradient:
                        whole.index_copy_(0, seen, part)
            else:
                moments = (state["exp_avg"], state["exp_avg_sq"])
                _adam((parameter, parameter.grad, state["step"], *moments), group)


def _native_step(group: dict, parameter: Tensor, state: dict[str, Tensor]) -> bool:
    """The step in native code, in one pass over the gradient; False where PyTorch is to do it."""
    kernel = host_kernel("adam", parameter)
    tensors = (parameter, state["exp_avg"], state["exp_avg_sq"])
    inputs = [t for t in (parameter.grad, group["row_rates"]) if t is not None]
    alike = all(t.dtype == parameter.dtype and t.is_contiguous() for t in (*inputs, *tensors))
    if kernel is None or not alike:
        return False
    count = math.prod(parameter.shape[: group["rows"]]) if group["rows"] else 0
    rates = (group["lr"], *group["betas"], group["eps"], group["weight_decay"])
    width = parameter.numel() // max(count, 1)
    kernel(count, width, parameter.grad, group["row_rates"], *rates, state["step"], *tensors)
    return True


def _adam(tensors: Sequence[Tensor], group: dict, scale: Tensor | float = 1.0) -> None:
    """One step in place on value, gradient, step, mean and mean square; step and `scale` have one number a row, or one
    for all."""
    value, gradient, step, mean, square = tensors
    beta1, beta2 = group["betas"]
    step += 1
    count = step.double()  # 1 - 0.999 has four digits in single precision
    mean.lerp_(gradient, 1 - beta1)
    square.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    shape = (-1,) + (1,) * (value.ndim - 1) if group["rows"] else ()
    corrections = ((1 - beta2**count).sqrt() / (1 - beta1**count)).to(value.dtype)
    rate = (group["lr"] * scale * corrections).reshape(shape)
    value.mul_(1 - group["lr"] * group["weight_decay"])
    value.sub_(rate * mean / (square.sqrt() + group["eps"]))


def make_optimizer(scene: Scene, config: TrainConfig, corrections: Corrections | None = None) -> RowAdam:
    """One group a parameter, named. Weight decay acts on the warps only (paper section 5.2)."""
    named = [*scene.named_parameters()]
    if corrections is not None:
        named += [(f"corrections.{name}", parameter) for name, parameter in corrections.named_parameters()]
    groups = [
        {
            "params": [parameter],
            "name": name,
            "lr": 0.0,
            "weight_decay": config.warp_weight_decay if ".network." in name else 0.0,
            "rows": _row_axes(name),
            "row_rates": _source_distances(scene, name),
        }
        for name, parameter in named
        if parameter.requires_grad
    ]
    # Losses are weighted by 0.05 and spread over thousands of points: gradients are far below Adam's default eps.
    return RowAdam(groups, eps=1e-15)


def _row_axes(name: str) -> int:
    """Points and photographs are rows, and so are the texels of the environment map."""
    return 2 if name.startswith("environment.") else int(name.startswith(("primary.", "reflections.", "corrections.")))


def _source_distances(scene: Scene, name: str) -> Tensor | None:
    """Distances of reflection points from their reflector: a step changes their direction by equal angles."""
    if not (name.startswith("reflections.") and name.endswith(".positions")):
        return None
    i = int(name.split(".")[1])
    positions = scene.reflections[i].positions.detach()
    center = torch.from_numpy(scene.volumes[i].center).to(positions)
    return (positions - center).norm(dim=1).clamp_min(scene.volumes[i].radius)


def set_rates(optimizer: RowAdam, config: TrainConfig, extent: float, progress: float, warm_up: bool) -> None:
    for group in optimizer.param_groups:
        group["lr"] = _rate(group["name"], config, extent, progress, warm_up)


def append_rows(optimizer: RowAdam, module: nn.Module, prefix: str, rows: dict[str, Tensor]) -> None:
    """Add rows to parameters of a module; the moments of new rows start at zero, those of old rows stay."""
    for group in optimizer.param_groups:
        attribute = group["name"].removeprefix(prefix + ".")
        if not group["name"].startswith(prefix + ".") or attribute not in rows:
            continue
        old = group["params"][0]
        grown = nn.Parameter(torch.cat([old.detach(), rows[attribute]]))
        state = optimizer.state.pop(old, {})
        for key, value in state.items():
            state[key] = torch.cat([value, value.new_zeros(len(rows[attribute]), *value.shape[1:])])
        optimizer.state[grown] = state
        group["params"] = [grown]
        setattr(module, attribute, grown)


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """The moments as named tensors, for the checkpoint."""
    return {
        f"adam.{group['name']}.{key}": value
        for group in optimizer.param_groups
        for key, value in optimizer.state.get(group["params"][0], {}).items()
    }


def restore_optimizer(optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    for group in optimizer.param_groups:
        parameter = group["params"][0]
        state = {k: tensors.get(f"adam.{group['name']}.{k}") for k in ("step", "exp_avg", "exp_avg_sq")}
        if all(v is not None for v in state.values()):
            # In the parameter's memory layout: fused steps go through memory, not through indices.
            optimizer.state[parameter] = {
                k: torch.empty_like(parameter).copy_(v) if v.shape == parameter.shape else v.to(parameter.device)
                for k, v in state.items()
                if v is not None
            }
