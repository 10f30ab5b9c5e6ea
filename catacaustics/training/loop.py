"""Training (paper section 5): multi-resolution warm-up, then everything; progress, checkpoints, resume."""

import ctypes
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from catacaustics.capture.dataset import Capture
from catacaustics.config import TrainConfig
from catacaustics.errors import UserError
from catacaustics.files import write_json
from catacaustics.losses import coverage_loss, dssim, total_variation, weight_loss
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.run import choose_device, clock_of
from catacaustics.scene import Layers, Scene
from catacaustics.training.corrections import Corrections
from catacaustics.training.densification import GradientStatistics, densify
from catacaustics.training.initialize import (
    Reflector,
    Seeds,
    grow_cloud,
    initial_scene,
    primary_seeds,
    reflection_seeds,
    scene_extent,
    stage_count,
    start_warps,
    usual_points,
)
from catacaustics.training.optimizer import RowAdam, make_optimizer, optimizer_tensors, restore_optimizer, set_rates
from catacaustics.training.photographs import PhotographCache, choose_patch, scaled_camera

_LOG_EVERY = 10


class Stage(NamedTuple):
    """Until `end` (share of the training), images at `scale` and the first `points` share of every cloud."""

    end: float
    scale: float
    points: float


STAGES = (Stage(0.05, 0.25, 1 / 32), Stage(0.15, 0.5, 1 / 6), Stage(1.0, 1.0, 1.0))
"""Multi-resolution warm-up: from 1/4 resolution and 1 point in 32, doubled twice (paper section 5.2)."""

_WARM, _DENSIFIED = STAGES[-2].end, 0.8
"""Shares of the training between which the primary cloud is densified."""

PROBES = (0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
Probe = Callable[[Scene, float, int], None]
Watch = Callable[[Scene], None]


@dataclass
class TrainState:
    """Everything that a checkpoint keeps."""

    scene: Scene
    corrections: Corrections
    optimizer: RowAdam
    rng: np.random.Generator
    statistics: GradientStatistics
    step: int = 0
    seconds: float = 0.0
    stage: int = 0
    queue: list[int] = field(default_factory=list)
    gradient_norm: float = 0.0
    densified: int = 0


def fit(
    capture: Capture,
    reflectors: list[Reflector],
    config: TrainConfig,
    probe: Probe | None = None,
    watch: Watch | None = None,
) -> Scene:
    """Train a scene of known models; writes RUN/scene.safetensors and keeps RUN/checkpoint.safetensors while at it.

    Args:
        probe: called with scene, seconds and steps at the shares PROBES of the training; its time does not count.
        watch: called with the scene after every step; its time counts.

    Raises:
        UserError: a value that is not finite.
        KeyboardInterrupt: after the checkpoint was saved.
    """
    _keep_freed_memory()
    run = Path(config.run)
    rng = np.random.default_rng(config.seed)
    usual = usual_points(capture, [r.volume for r in reflectors], config)
    counts = {k: n if getattr(config, k) is None else getattr(config, k) for k, n in usual.items()}
    seeds = [primary_seeds(capture, reflectors, counts["primary_points"], rng, bool(config.guesses))]
    reflectors = [r for r in reflectors if r.model != "none"]
    warps = start_warps(capture, reflectors, config)
    volumes = [r.volume for r in reflectors]
    count = counts["reflection_points"]
    seeds += [reflection_seeds(capture, v, w, count, rng) for v, w in zip(volumes, warps, strict=True)]
    state = _start(capture, volumes, warps, seeds, config, rng)
    try:
        _loop(state, capture, volumes, seeds, config, probe, watch)
    except KeyboardInterrupt:
        save_checkpoint(run, state)
        print(f"training: interrupted at step {state.step}, checkpoint saved; go on with --resume")
        raise
    save_checkpoint(run, state)
    if list(state.corrections.parameters()):
        write_json(run / "corrections.json", state.corrections.summary([v.name for v in capture.train]))
    state.scene.save(run / "scene.safetensors")
    return state.scene


def _keep_freed_memory() -> None:
    """Let the C library keep what a step frees for the next one. By default it returns large blocks at once, and the
    kernel clears them page by page when they are asked for again: a quarter of a step on a CPU."""
    if not sys.platform.startswith("linux"):
        return
    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):  # glibc
        trim_threshold, mmap_max = -1, -4  # M_TRIM_THRESHOLD, M_MMAP_MAX of malloc.h
        library.mallopt(trim_threshold, 2**31 - 1)
        library.mallopt(mmap_max, 0)


def _start(
    capture: Capture,
    volumes: list[ReflectionVolume],
    warps: list[torch.nn.Module],
    seeds: list[Seeds],
    config: TrainConfig,
    rng: np.random.Generator,
) -> TrainState:
    path = Path(config.run) / "checkpoint.safetensors"
    if not path.exists():
        clock = clock_of(config.clock)
        started = clock()  # fitting the mirrors' shapes is training
        scene = initial_scene(capture, volumes, warps, seeds, STAGES[0].points, config).to(choose_device(config.device))
        (Path(config.run) / "metrics.jsonl").unlink(missing_ok=True)
        statistics = GradientStatistics(len(scene.primary), scene.device)
        corrections = _corrections(capture, config)
        optimizer = make_optimizer(scene, config, corrections)
        seconds = clock() - started
        return TrainState(scene, corrections, optimizer, rng, statistics, seconds=seconds)
    scene, tensors, notes = Scene.load_with_extras(path, choose_device(config.device))
    corrections = _corrections(capture, config)
    corrections.load_state_dict({k: tensors[f"corrections.{k}"] for k in corrections.state_dict()})
    optimizer = make_optimizer(scene, config, corrections)
    restore_optimizer(optimizer, tensors)
    statistics = GradientStatistics(len(scene.primary), scene.device)
    for name in vars(statistics):
        setattr(statistics, name, tensors[f"statistics.{name}"].to(scene.device))
    rng.bit_generator.state = notes["rng"]
    _trim_log(Path(config.run), notes["step"])
    print(f"training: going on from step {notes['step']}")
    place = (notes[key] for key in ("step", "seconds", "stage", "queue", "gradient_norm", "densified"))
    return TrainState(scene, corrections, optimizer, rng, statistics, *place)


def _corrections(capture: Capture, config: TrainConfig) -> Corrections:
    poses, exposure = bool(config.refine_poses), bool(config.exposure)
    return Corrections(len(capture.train), poses, exposure, scene_extent(capture)).to(choose_device(config.device))


def save_checkpoint(run: Path, state: TrainState) -> None:
    """Scene, Adam's moments, random state and place in the schedule, in one atomic file."""
    notes = {
        "step": state.step,
        "seconds": state.seconds,
        "stage": state.stage,
        "queue": state.queue,
        "gradient_norm": state.gradient_norm,
        "densified": state.densified,
        "rng": state.rng.bit_generator.state,
    }
    extra = {f"statistics.{name}": value for name, value in vars(state.statistics).items()}
    extra |= {f"corrections.{name}": value for name, value in state.corrections.state_dict().items()}
    state.scene.save(run / "checkpoint.safetensors", extra | optimizer_tensors(state.optimizer), notes)


def _trim_log(run: Path, step: int) -> None:
    """Drop what was logged after the checkpoint: those steps are done again."""
    path = run / "metrics.jsonl"
    if path.exists():
        rows = [line for line in path.read_text().splitlines() if line.endswith("}")]
        path.write_text("".join(line + "\n" for line in rows if json.loads(line)["step"] <= step))


def _progress(state: TrainState, config: TrainConfig) -> float:
    by_step = state.step / config.iterations
    return max(by_step, state.seconds / (60 * config.minutes)) if config.minutes else by_step


def _loop(
    state: TrainState,
    capture: Capture,
    volumes: list[ReflectionVolume],
    seeds: list[Seeds],
    config: TrainConfig,
    probe: Probe | None,
    watch: Watch | None,
) -> None:
    run = Path(config.run)
    photographs = PhotographCache(capture)
    extent = scene_extent(capture)
    clock = clock_of(config.clock)
    started, saved = clock() - state.seconds, time.monotonic()
    probed = sum(_progress(state, config) >= share for share in PROBES)
    layout = "{desc}: {percentage:3.0f}% |{bar}| {elapsed}, {remaining} left{postfix}"
    start = int(1000 * _progress(state, config))
    bar = tqdm(total=1000, initial=start, desc="training", mininterval=1.0, bar_format=layout)
    with bar, (run / "metrics.jsonl").open("a") as log:
        while (progress := _progress(state, config)) < 1:
            _enter_stage(state, progress, seeds, config)
            stage = STAGES[state.stage]
            warm_up = state.stage < len(STAGES) - 1
            set_rates(state.optimizer, config, extent, progress, warm_up)
            record = _step(state, capture, volumes, photographs, stage, config)
            state.step += 1
            if int(config.densifications * min(1.0, (progress - _WARM) / (_DENSIFIED - _WARM))) > state.densified:
                densify(state.scene, state.optimizer, state.statistics, config.densify_share, config.max_primary_points)
                state.statistics = GradientStatistics(len(state.scene.primary), state.scene.device)
                state.densified += 1
            if watch is not None:
                watch(state.scene)
            state.seconds = clock() - started
            if probe is not None and _progress(state, config) >= PROBES[min(probed, len(PROBES) - 1)]:
                probe(state.scene, state.seconds, state.step)
                started = clock() - state.seconds
                probed = sum(_progress(state, config) >= share for share in PROBES)
            if state.step % _LOG_EVERY == 0:
                log.write(json.dumps(_log_row(state, stage, record)) + "\n")
                log.flush()
                bar.set_postfix(step=state.step, loss=f"{record['loss']:.4f}", psnr=f"{record['psnr']:.2f}")
                bar.update(int(1000 * min(_progress(state, config), 1)) - bar.n)
            if time.monotonic() - saved > 60 * config.checkpoint_minutes:
                save_checkpoint(run, state)
                saved = time.monotonic()


def _log_row(state: TrainState, stage: Stage, record: dict[str, float]) -> dict:
    return {
        "step": state.step,
        "seconds": round(state.seconds, 2),
        "stage": state.stage,
        "scale": stage.scale,
        **{k: round(v, 6) for k, v in record.items()},
        "primary_points": len(state.scene.primary),
        "reflection_points": sum(len(c.positions) for c in state.scene.reflections),
    }


def _enter_stage(state: TrainState, progress: float, seeds: list[Seeds], config: TrainConfig) -> None:
    """Grow the clouds when progress passes a stage's end. Adam starts anew: its moments belong to other rows."""
    index = next(i for i, s in enumerate(STAGES) if progress < s.end)
    if index == state.stage:
        return
    scene = state.scene
    share = STAGES[index].points
    scene.primary = grow_cloud(scene.primary, seeds[0], stage_count(seeds[0], share))
    for i, cloud_seeds in enumerate(seeds[1:]):
        scene.reflections[i] = grow_cloud(scene.reflections[i], cloud_seeds, stage_count(cloud_seeds, share))
    state.optimizer = make_optimizer(scene, config, state.corrections)
    state.statistics = GradientStatistics(len(scene.primary), scene.device)
    state.stage = index


def _step(
    state: TrainState,
    capture: Capture,
    volumes: list[ReflectionVolume],
    photographs: PhotographCache,
    stage: Stage,
    config: TrainConfig,
) -> dict[str, float]:
    """One optimiser step over `accumulate` patches; returns the mean of what was measured."""
    scene = state.scene
    state.optimizer.zero_grad(set_to_none=True)
    records = []
    for _ in range(config.accumulate):
        if not state.queue:
            state.queue = state.rng.permutation(len(capture.train)).tolist()
        index = state.queue.pop()
        view = capture.train[index]
        camera = scaled_camera(view.camera, config.image_size, stage.scale)
        shown = photographs.masks(view, camera, volumes)
        viewport = choose_patch(camera, shown, config.patch, config.reflector_share, state.rng)
        image = photographs.get(view, camera.width, camera.height)
        x0, y0, width, height = viewport
        patch = np.ascontiguousarray(image[y0 : y0 + height, x0 : x0 + width])
        target = torch.from_numpy(patch).to(scene.device).float() / 255
        layers = scene.layers(camera, viewport, motion=state.corrections.motion(index))
        if layers.splats.screen.requires_grad:
            layers.splats.screen.retain_grad()
        masks = [torch.from_numpy(m[y0 : y0 + height, x0 : x0 + width]).to(scene.device) for m in shown]
        rgb = state.corrections.expose(index, scene.decode(layers))
        losses, psnr = _losses(rgb, layers, target, masks, config)
        total = torch.stack(list(losses.values())).sum() / config.accumulate
        _check_finite(scene, total, state.step, "loss")
        total.backward()
        state.statistics.add_screen(layers.splats)
        records.append(
            {"loss": total.item() * config.accumulate, "psnr": psnr} | {k: v.item() for k, v in losses.items()}
        )
    if scene.primary.positions.grad is not None:
        state.statistics.direction += scene.primary.positions.grad
    clipped = _clip_gradients(state)
    state.optimizer.step()
    return {k: float(np.mean([r[k] for r in records])) for k in records[0]} | {"clipped": clipped}


def _clip_gradients(state: TrainState) -> float:
    """Shorten the networks' gradient where it is 10 times as long as usual; returns the factor (1: nothing done).

    Raises:
        UserError: a gradient is not finite.
    """
    for group in state.optimizer.param_groups:
        gradient = group["params"][0].grad
        if gradient is not None:
            _check_finite(state.scene, gradient.sum(), state.step, f"gradient of {group['name']}")
    shared = [g["params"][0] for g in state.optimizer.param_groups if not g["rows"]]
    limit = 10 * state.gradient_norm or float("inf")
    norm = float(torch.nn.utils.clip_grad_norm_(shared, limit))
    share = 0.05 if state.gradient_norm else 1.0
    state.gradient_norm += share * (min(norm, limit) - state.gradient_norm)
    return min(1.0, limit / max(norm, 1e-30))


def _losses(
    rgb: Tensor, layers: Layers, target: Tensor, masks: list[Tensor], config: TrainConfig
) -> tuple[dict[str, Tensor], float]:
    losses = {
        "l1": config.weight_l1 * (rgb - target).abs().mean(),
        "dssim": config.weight_dssim * dssim(rgb, target),
    }
    if masks:
        inside = torch.stack(masks).any(0)
        losses["coverage"] = config.weight_coverage * coverage_loss(layers.reflection_transmittance, inside)
        losses["rho"] = config.weight_rho * weight_loss(layers.rho, inside)
        losses["tv"] = config.weight_tv * total_variation(layers.rho)
    error = ((rgb.detach().clamp(0, 1) - target) ** 2).mean().item()
    return losses, float(-10 * np.log10(max(error, 1e-10)))


def _check_finite(scene: Scene, loss: Tensor, step: int, name: str) -> None:
    if torch.isfinite(loss):
        return
    bad = [n for n, p in scene.named_parameters() if not torch.isfinite(p).all()]
    where = f"; the parameter {bad[0]} is not finite either" if bad else ""
    raise UserError(
        f"The {name} is not finite at step {step}{where}.",
        "finite numbers",
        "the last checkpoint is kept: lower the learning rates and go on with --resume, or report the capture",
    )
