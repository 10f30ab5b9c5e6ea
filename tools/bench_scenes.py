"""What does physics buy, scene by scene? The chosen warp against no warp and against the network, in equal time.

    python tools/make_scene.py kettle scenes/kettle --size 300 200
    catacaustics calibrate scenes/kettle captures/kettle
    python tools/bench_scenes.py captures/* --scenes scenes --json scenes.json

Trains every capture as `auto` (its trials are part of its time), without reflections (`primary only`) and with the
network alone (`full (neural)`); where a capture has several reflectors, each also alone, the others left to the primary
cloud. Prints PSNR inside the reflectors on held-out views, and the angle between displayed and true directions of
mirrored things where the path-traced scene is given. Finished trainings are kept in OUT.
"""

import statistics
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from catacaustics.ablation import ablate, held_out_scores
from catacaustics.capture.dataset import open_capture
from catacaustics.config import AblateConfig, TrainConfig
from catacaustics.files import read_json, write_json
from catacaustics.reflectors.volume import build_volume
from catacaustics.run import open_run
from catacaustics.training.initialize import named_reflectors
from catacaustics.training.loop import fit

ROWS = ("auto", "primary only", "full (neural)")


@dataclass(frozen=True)
class Bench:
    """Train captures in equal time.

    Args:
        captures: folders made by `catacaustics calibrate`.
        out: folder of the trainings.
        scenes: folder with the path-traced scenes, under the captures' names, for the true directions.
        minutes: of each training.
        seeds: seeds of the trainings.
        clock: what minutes are measured by, wall or cpu: processor time, fair where others compute, too.
        image_size: longer side of the photographs.
        json: write the table to this file too.
    """

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional]
    out: Path = Path("bench_scenes")
    scenes: Path | None = None
    minutes: float = 2.0
    seeds: tuple[int, ...] = (0,)
    clock: Literal["wall", "cpu"] = "wall"
    image_size: int = 300
    json: Path | None = None


def alone(config: Bench, path: Path) -> dict[str, tuple[float, float]]:
    """PSNR inside each of several reflectors: modelled with the others, and modelled alone (seed 0)."""
    capture = open_capture(path)
    volumes = [build_volume(capture, name) for name in capture.reflectors]
    if len(volumes) < 2:
        return {}
    together = config.out / path.name / "together"
    base = TrainConfig(
        path, together, minutes=config.minutes, clock=config.clock, iterations=10**9, image_size=config.image_size
    )
    auto = config.out / path.name / "runs" / f"auto_{config.minutes:g}_min_0".replace(".", "_")
    models = tuple(read_json(auto / "model_choice.json")["chosen"]["model"])
    scores = {}
    for i, volume in enumerate(volumes):
        pair = []
        for folder, shown in ((together, range(len(volumes))), (config.out / path.name / volume.name, [i])):
            if not (folder / "scene.safetensors").exists():
                folder.mkdir(parents=True, exist_ok=True)
                named = named_reflectors([volumes[k] for k in shown], tuple(models[k] for k in shown))
                fit(replace(capture, reflectors=[v.volume.name for v in named]), named, replace(base, run=folder))
                write_json(folder / "config.json", {"capture": str(path.resolve()), "image_size": config.image_size})
            scene = open_run(folder, device="cpu").scene
            pair.append(held_out_scores(scene, capture, [volume], base)["inside"])
        scores[volume.name] = (pair[0], pair[1])
    return scores


def main(config: Bench) -> None:
    table = {}
    for path in config.captures:
        truth = None if config.scenes is None else config.scenes / path.name
        settings = AblateConfig(
            path,
            config.out / path.name,
            minutes=config.minutes,
            rows=ROWS,
            cloud_rungs=(),
            clock=config.clock,
            seeds=config.seeds,
            image_size=config.image_size,
            truth=truth,
        )
        results = ablate(settings)["results"]
        rows = {}
        for name in ROWS:
            same = [r for r in results if r["name"] == name]
            flow = [r["flow_degrees"] for r in same if r["flow_degrees"] is not None]
            rows[name] = {
                "models": [" ".join(r["models"]) for r in same],
                "inside": [r["curve"][-1]["inside"] for r in same],
                "whole": [r["curve"][-1]["whole"] for r in same],
                "flicker": [r["curve"][-1]["flicker"] for r in same],
                "flow": statistics.mean(flow) if flow else None,
            }
        table[path.name] = {"rows": rows, "alone": alone(config, path)}
        if config.json is not None:
            write_json(config.json, {"minutes": config.minutes, "image_size": config.image_size, "scenes": table})
    print(f"{'scene':<10}{'auto chose':<26}{'auto':>7}{'primary':>9}{'neural':>8}{'flow deg':>10}")
    for name, entry in table.items():
        rows = entry["rows"]
        auto, none, neural = (statistics.mean(rows[row]["inside"]) for row in ROWS)
        flow = "-" if rows["auto"]["flow"] is None else f"{rows['auto']['flow']:.2f}"
        chosen = ", ".join(dict.fromkeys(rows["auto"]["models"]))
        print(f"{name:<10}{chosen:<26}{auto:7.2f}{none:9.2f}{neural:8.2f}{flow:>10}")
        for reflector, (together, single) in entry["alone"].items():
            print(f"{'':<10}{reflector + ' alone':<26}{single:7.2f}, with the others {together:.2f}")


if __name__ == "__main__":
    main(tyro.cli(Bench))
