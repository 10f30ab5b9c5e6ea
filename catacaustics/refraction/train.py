"""`catacaustics refract train`: the generator alone, on coordinates; then the renderer, with the generator frozen."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from catacaustics.config import RefractTrainConfig
from catacaustics.errors import UserError
from catacaustics.files import write_bytes, write_json
from catacaustics.losses import dssim
from catacaustics.refraction.bodies import spread
from catacaustics.refraction.buffers import BufferCache, Buffers, frame_screen, stack
from catacaustics.refraction.follow import Tracer, bake_tracer
from catacaustics.refraction.frames import Frame, Frames, open_frames
from catacaustics.refraction.lookup import Screen
from catacaustics.refraction.models import (
    Layout,
    LossWeights,
    RefractionModel,
    check_layout,
    fill,
    generator_losses,
    kind_of,
    load_part,
    needs_screen,
    save_part,
    split_output,
)
from catacaustics.refraction.networks import SIZES
from catacaustics.run import choose_device, clock_of
from catacaustics.training.optimizer import optimizer_tensors, restore_optimizer

_LOG_EVERY = 10
_REACH_SHARE = 0.25
"""What a tracer learns takes this share of a network's time, after baking; the rest goes to the renderer."""
_LONGEST_GRADIENT = 1.0
"""Longer gradients are shortened to this; usual ones are a tenth of it."""
Place = tuple[int, int, int]
"""A training crop: frame, first row, first column."""


@dataclass
class PartState:
    """Everything that a part's checkpoint keeps."""

    network: nn.Module
    optimizer: torch.optim.Optimizer
    step: int = 0
    seconds: float = 0.0
    whole: bool = True
    """False while a step changes the weights: such a state is not worth keeping."""


@dataclass(frozen=True)
class _Part:
    """What differs between training a generator and a renderer."""

    name: str
    indices: range
    """Frames to draw from."""
    rate: float
    batch: int
    crop: int
    minutes: float | None
    losses: Callable[[Buffers, list[Place]], dict[str, Tensor]]
    bfloat16: bool
    """Convolutions compute with bfloat16."""
    spent: float = 0.0
    """Seconds that were used before the first step."""


def train(config: RefractTrainConfig) -> RefractionModel:
    """Train a model, or one part of it; finished parts are kept. Writes RUN/generator.safetensors and
    RUN/renderer.safetensors, and checkpoints while at it.

    Raises:
        UserError: no data, unknown model, an unfinished run without --resume, a generator of another layout, or a value
            that is not finite.
        KeyboardInterrupt: after the checkpoint was saved.
    """
    run = Path(config.run)
    frames = open_frames(config.data)
    _check(config, frames)
    write_json(run / "config.json", {k: str(v) if isinstance(v, Path) else v for k, v in asdict(config).items()})
    torch.manual_seed(config.seed)
    model = RefractionModel(
        config.model, config.size, Layout.of(frames), frames.textures, choose_device(config.device), config.coordinates
    )
    train_frames, more = frames.split("train"), frames.split("generator")
    cache = BufferCache([train_frames, more], config.cache_gb * 2**30)
    cache.fill()
    if model.generator is not None and config.part != "renderer" and config.generator is None:
        _train_generator(model, cache, config)
    if config.part != "generator":
        _train_renderer(model, cache, config)
    return model.eval()


def _train_generator(model: RefractionModel, cache: BufferCache, config: RefractTrainConfig) -> None:
    """Bake hybrid's bodies; learn what there is to learn."""
    spent = _bake(model, cache, config)
    minutes = config.minutes and config.minutes * config.generator_share
    if minutes and isinstance(model.generator, Tracer):
        minutes = spent / 60 + _REACH_SHARE * minutes
    every = range(sum(map(len, cache.splits)))
    sizes, step = (config.batch_generator, config.crop_generator), _generator_step(model, config)
    part = _Part("generator", every, config.lr_generator, *sizes, minutes, step, _short(model, config), spent)
    _fit(model.generator, part, cache, model, config)


def _train_renderer(model: RefractionModel, cache: BufferCache, config: RefractTrainConfig) -> None:
    """With the generator frozen; the time that a tracer did not need is the renderer's."""
    run = Path(config.run)
    path = config.generator or run / "generator.safetensors"
    minutes = config.minutes and config.minutes * (1 - config.generator_share * (model.kind is not None))
    if model.generator is not None:
        model.take_generator(path)
        if config.generator is not None:
            write_bytes(run / "generator.safetensors", path.read_bytes())
        if minutes and config.minutes and isinstance(model.generator, Tracer):
            minutes = max(minutes, config.minutes - load_part(path)[2]["seconds"] / 60)
    every = range(len(cache.splits[0]))
    step = _renderer_step(model, _baked(model, cache, every, config), config)
    part = _Part("renderer", every, config.lr_renderer, config.batch, config.crop, minutes, step, _short(model, config))
    _fit(model.renderer, part, cache, model, config)


def _short(model: RefractionModel, config: RefractTrainConfig) -> bool:
    """Whether convolutions compute with bfloat16."""
    return computes_bfloat16(model.device) if config.precision == "auto" else config.precision == "bfloat16"


def computes_bfloat16(device: torch.device) -> bool:
    """Whether bfloat16 is fast: GPUs from Ampere on, processors with AVX-512 BF16 or AMX."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    able = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return bool(able.get("avx512_bf16") or able.get("amx_bf16"))


def _check(config: RefractTrainConfig, frames: Frames) -> None:
    kind, run = kind_of(config.model), Path(config.run)
    side = int(frames.card["resolution"])
    for crop in (config.crop, config.crop_generator):
        check_layout(Layout.of(frames), config.size, frames, min(crop, side) or side)
    if not len(frames.split("train")):
        raise UserError(f"{config.data} has no training frames.", "one or more", "make them: --train of refract data")
    if config.part == "generator" and (kind is None or config.coordinates == "true"):
        found = config.model + " with true coordinates" * (config.coordinates == "true")
        raise UserError(f"{found} has no generator.", "another model or part", "leave --part out")
    parts = ("generator", "renderer") if config.part == "both" else (config.part,)
    found = [p for p in parts for f in (f"{p}.safetensors", f"{p}.checkpoint.safetensors") if (run / f).exists()]
    if found and not config.resume:
        raise UserError(
            f"{run} already holds a {found[0]}.", "an empty folder", "add --resume to go on, or choose another folder"
        )


def _bake(model: RefractionModel, cache: BufferCache, config: RefractTrainConfig) -> float:
    """Give hybrid a tracer, where its bodies can be baked; the seconds that it took."""
    finished = Path(config.run) / "generator.safetensors"
    if finished.exists():
        model.take_generator(finished)
    if finished.exists() or model.kind != "hybrid":
        return 0.0
    frames = [_without_screen(cache.frame(index)) for index in spread(sum(map(len, cache.splits)))]
    clock = clock_of(config.clock)
    started = clock()
    tracer, told = bake_tracer(frames, SIZES[model.size])
    print(f"training: {told}")
    if tracer is not None:
        model.generator = tracer.to(model.device)
    return clock() - started


def _without_screen(frame: Frame) -> Frame:
    """Lighter by what bodies do not need."""
    return replace(frame, screen=frame.screen[:0, :0], screen_depth=frame.screen_depth[:0, :0], probe=frame.probe[:0])


# What a step learns ----------------------------------------------------------------------------------------------


def _generator_step(
    model: RefractionModel, config: RefractTrainConfig
) -> Callable[[Buffers, list[Place]], dict[str, Tensor]]:
    kind, generator = model.kind, model.generator
    assert generator is not None
    assert kind is not None
    weights = LossWeights(
        config.weight_coordinates,
        config.weight_tv,
        config.weight_index,
        config.weight_normal,
        config.weight_direction,
    )

    def losses(batch: Buffers, places: list[Place]) -> dict[str, Tensor]:
        return generator_losses(kind, split_output(kind, generator(batch)), batch, weights)

    return losses


def _baked(model: RefractionModel, cache: BufferCache, indices: range, config: RefractTrainConfig) -> list[Tensor]:
    """The R-buffers of frames, float16. The generator is frozen: each is computed once, before the renderer's time."""
    if (Path(config.run) / "renderer.safetensors").exists():
        return []
    baked = []
    for index in tqdm(indices, desc="R-buffers", unit="frame", disable=model.kind is None):
        screen: Screen | None = None
        if needs_screen(model.kind):
            screen = Screen(*(value.to(model.device) for value in frame_screen(cache.frame(index))))
        with torch.no_grad():
            whole = model.bake(cache.get(index).to(model.device), screen)
        baked.append(keep_content(whole, config.content).half().cpu())
    return baked


def _renderer_step(
    model: RefractionModel, baked: list[Tensor], config: RefractTrainConfig
) -> Callable[[Buffers, list[Place]], dict[str, Tensor]]:
    """L1 + DSSIM."""

    def losses(batch: Buffers, places: list[Place]) -> dict[str, Tensor]:
        side = batch.reference.shape[-1]
        parts = [baked[i][..., y : y + side, x : x + side].to(model.device).float() for i, y, x in places]
        image = model.renderer(batch, torch.cat(parts))
        error = (image - batch.reference).abs().mean()
        b, c, height, width = image.shape
        planes = (x.permute(2, 3, 0, 1).reshape(height, width, b * c) for x in (image, batch.reference))
        return {"l1": config.weight_l1 * error, "dssim": config.weight_dssim * dssim(*planes)}

    return losses


def keep_content(r_buffer: Tensor, content: str) -> Tensor:
    """The R-buffer with colour or normal set to zero, where not both are wanted."""
    if content == "both" or not r_buffer.shape[1]:
        return r_buffer
    keep = torch.full((r_buffer.shape[1],), float(content == "color"), device=r_buffer.device)
    keep[3:6] = float(content == "normal")
    return r_buffer * keep[:, None, None]


# The loop --------------------------------------------------------------------------------------------------------


def _fit(
    network: nn.Module | None, part: _Part, cache: BufferCache, model: RefractionModel, config: RefractTrainConfig
) -> None:
    """Train one part to the end of its steps or minutes; a part that is finished is loaded."""
    assert network is not None
    run = Path(config.run)
    finished = run / f"{part.name}.safetensors"
    if finished.exists():
        fill(network, load_part(finished)[0], finished)
        print(f"training: {finished} is finished already, kept")
        return
    state = _start(network, part, config)
    try:
        _loop(state, part, cache, model, config)
    except KeyboardInterrupt:
        if state.whole:
            _save(state, part, model, config)
        print(f"training: interrupted at step {state.step} of the {part.name}; go on with --resume")
        raise
    _save(state, part, model, config)
    save_part(finished, network, _header(state, model))


def _start(network: nn.Module, part: _Part, config: RefractTrainConfig) -> PartState:
    groups = [{"params": [p], "name": name} for name, p in network.named_parameters()]
    optimizer = torch.optim.AdamW(groups, weight_decay=config.weight_decay, fused=True)
    state = PartState(network, optimizer, seconds=part.spent)
    path = Path(config.run) / f"{part.name}.checkpoint.safetensors"
    if path.exists():
        weights, extra, header = load_part(path)
        fill(network, weights, path)
        restore_optimizer(state.optimizer, extra)
        state.step, state.seconds = header["step"], header["seconds"]
        _trim_log(Path(config.run), part.name, state.step)
        print(f"training: going on from step {state.step} of the {part.name}")
    return state


def _header(state: PartState, model: RefractionModel) -> dict[str, Any]:
    own = {"model": model.name, "size": model.size, "layout": model.layout._asdict(), "coordinates": model.coordinates}
    return own | {"step": state.step, "seconds": state.seconds}


def _save(state: PartState, part: _Part, model: RefractionModel, config: RefractTrainConfig) -> None:
    """Weights, Adam's moments and place in the schedule, in one atomic file. Crops follow from seed and step.

    Raises:
        UserError: a weight is not finite; the older checkpoint stays.
    """
    bad = _first_not_finite(dict(state.network.named_parameters()))
    if bad:
        raise _not_finite(f"weight {bad} of the {part.name}", state.step)
    path = Path(config.run) / f"{part.name}.checkpoint.safetensors"
    save_part(path, state.network, _header(state, model), optimizer_tensors(state.optimizer))


def _trim_log(run: Path, part: str, step: int) -> None:
    """Drop what was logged after the checkpoint: those steps are done again."""
    path = run / "metrics.jsonl"
    if path.exists():
        rows = [json.loads(line) for line in path.read_text().splitlines() if line.endswith("}")]
        kept = [row for row in rows if row["part"] != part or row["step"] <= step]
        path.write_text("".join(json.dumps(row) + "\n" for row in kept))


def _progress(state: PartState, part: _Part, config: RefractTrainConfig) -> float:
    by_step = state.step / config.steps
    return max(by_step, state.seconds / (60 * part.minutes)) if part.minutes else by_step


def _loop(
    state: PartState, part: _Part, cache: BufferCache, model: RefractionModel, config: RefractTrainConfig
) -> None:
    clock = clock_of(config.clock)
    device = next(state.network.parameters()).device
    started, saved = clock() - state.seconds, time.monotonic()
    state.network.train()
    layout = "{desc}: {percentage:3.0f}% |{bar}| {elapsed}, {remaining} left{postfix}"
    begun = int(1000 * _progress(state, part, config))
    bar = tqdm(total=1000, initial=begun, desc=part.name, mininterval=1.0, bar_format=layout)
    with bar, (Path(config.run) / "metrics.jsonl").open("a") as log:
        while (progress := _progress(state, part, config)) < 1:
            low = config.lr_final_share
            for group in state.optimizer.param_groups:
                group["lr"] = part.rate * (low + (1 - low) * (1 + math.cos(math.pi * progress)) / 2)
            batch, places = _draw(state.step, part, cache, config)
            record = _step(state, part, batch.to(device), places)
            state.step, state.whole = state.step + 1, True
            state.seconds = clock() - started
            if state.step % _LOG_EVERY == 0:
                row = {"part": part.name, "step": state.step, "seconds": round(state.seconds, 2)}
                log.write(json.dumps(row | {k: round(v, 6) for k, v in record.items()}) + "\n")
                log.flush()
                bar.set_postfix(step=state.step, loss=f"{record['loss']:.4f}")
                bar.update(int(1000 * min(_progress(state, part, config), 1)) - bar.n)
            if time.monotonic() - saved > 60 * config.checkpoint_minutes:
                _save(state, part, model, config)
                saved = time.monotonic()


def _draw(step: int, part: _Part, cache: BufferCache, config: RefractTrainConfig) -> tuple[Buffers, list[Place]]:
    """The crops of a step. Every frame is drawn once before any is drawn again."""
    crops, places = [], []
    part_seed = [config.seed, int(part.name == "renderer")]
    rng = np.random.default_rng([*part_seed, 0, step])
    for draw in range(step * part.batch, (step + 1) * part.batch):
        epoch, place = divmod(draw, len(part.indices))
        index = int(np.random.default_rng([*part_seed, 1, epoch]).permutation(part.indices)[place])
        whole = cache.get(index)
        y, x, side = _choose_crop(whole, part.crop, config.glass_share, rng)
        crops.append(whole.crop(y, x, side))
        places.append((index, y, x))
    return stack(crops), places


def _choose_crop(whole: Buffers, crop: int, glass_share: float, rng: np.random.Generator) -> Place:
    """First row, first column and side: around a refractive pixel, or anywhere."""
    full = whole.depth.shape[-1]
    side = min(crop, full) or full
    if side == full:
        return 0, 0, side
    glass = whole.refractive[0, 0].flatten().nonzero()
    if len(glass) and rng.random() < glass_share:
        pixel = int(glass[rng.integers(len(glass))])
        y, x = (min(max(at - side // 2, 0), full - side) for at in divmod(pixel, full))
        return y, x, side
    y, x = rng.integers(0, full - side + 1, 2).tolist()
    return y, x, side


def _step(state: PartState, part: _Part, batch: Buffers, places: list[Place]) -> dict[str, float]:
    """One optimiser step.

    Raises:
        UserError: a value that is not finite; the weights are those before the step.
    """
    state.optimizer.zero_grad(set_to_none=True)
    with torch.autocast(batch.depth.device.type, torch.bfloat16, enabled=part.bfloat16):
        losses = part.losses(batch, places)
    total = torch.stack(list(losses.values())).sum()
    total.backward()
    norm = torch.nn.utils.clip_grad_norm_(state.network.parameters(), _LONGEST_GRADIENT)
    if not torch.isfinite(norm + total.detach()):
        raise _not_finite(_culprit(state, part, batch, places, losses), state.step)
    state.whole = False
    state.optimizer.step()
    return {"loss": total.item()} | {name: value.item() for name, value in losses.items()}


def _culprit(state: PartState, part: _Part, batch: Buffers, places: list[Place], losses: dict[str, Tensor]) -> str:
    """The first tensor that is not finite, in the order in which they are computed."""
    frames = ", ".join(str(index) for index, *_ in places)
    bad = _first_not_finite(batch._asdict())
    if bad:
        return f"buffer {bad} of one of the training frames {frames}"
    bad = _first_not_finite(dict(state.network.named_parameters()))
    if bad:
        return f"weight {bad} of the {part.name}"
    bad = _first_not_finite(losses)
    if bad:
        return f"loss {bad} of the {part.name}, frames {frames},"
    gradients = {n: p.grad for n, p in state.network.named_parameters() if p.grad is not None}
    return f"gradient of {_first_not_finite(gradients)} of the {part.name}, frames {frames},"


def _first_not_finite(tensors: dict[str, Tensor]) -> str | None:
    return next((name for name, value in tensors.items() if not torch.isfinite(value).all()), None)


def _not_finite(name: str, step: int) -> UserError:
    return UserError(
        f"The {name} is not finite at step {step}.",
        "finite numbers",
        "the last checkpoint is kept: lower the learning rate and go on with --resume, or make that shard again",
    )
