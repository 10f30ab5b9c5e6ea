"""Time the splatter's backends against a yardstick of the same machine.

The yardstick is `torch.exp` over a float32 tensor with as many elements as there are splat-pixel pairs: ratios to it
carry over from one machine to another far better than seconds do. Everything runs in one process with the same number
of threads; times are medians after a warm-up, yardstick and splatter by turns.

    python tools/bench_splat.py --json bench.json
"""

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from catacaustics.cameras import Camera
from catacaustics.config import SplatConfig
from catacaustics.splatting import native, reference

SIZES = {"20k": (20_000, 320, 213), "200k": (200_000, 1000, 666), "1M": (1_000_000, 1000, 666)}


def random_splats(count: int, width: int, height: int, channels: int) -> tuple[list[torch.Tensor], Camera]:
    """Disks of any orientation all over the image, with radii from 0.5 to 2.2 pixels, evenly on a log scale."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    camera = Camera(width, height, float(width), float(width), width / 2, height / 2, np.eye(4))
    z = 1 + 4 * uniform(count)
    pixels = uniform(count, 2) * torch.tensor([width, height]) - torch.tensor([width / 2, height / 2])
    positions = torch.cat([pixels / width * z[:, None], z[:, None]], 1)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    radii = 0.5 * (2.2 / 0.5) ** uniform(count)
    footprints = (radii * z / width) ** 2
    scene = [positions, normals, footprints, 0.05 + 0.9 * uniform(count), uniform(count, channels)]
    return [t.requires_grad_() for t in scene], camera


def count_pairs(scene: list[torch.Tensor], camera: Camera, config: SplatConfig) -> int:
    """Splat-pixel pairs: the area of the ellipses in pixels."""
    with torch.no_grad():
        positions, normals, footprints = scene[:3]
        pose = torch.tensor(camera.camera_from_world, dtype=torch.float32)
        focal, center = (camera.fx, camera.fy), (camera.cx, camera.cy)
        forms = reference.project(positions, normals, footprints, pose, focal, center, config.low_pass).forms
        return int((math.pi * config.support**2 / (forms[:, 0] * forms[:, 2]).sqrt()).sum())


def seconds(function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def time_splatter(splat: Callable, scene: list[torch.Tensor], camera: Camera, runs: int) -> dict[str, float]:
    """Median seconds of the forward and of the backward pass, and the yardstick's between them."""
    pairs = count_pairs(scene, camera, SplatConfig())
    values, target = -torch.rand(pairs), None
    times: dict[str, list[float]] = {"forward": [], "backward": [], "yardstick": []}
    for run in range(runs + 1):
        start = time.perf_counter()
        output = splat(*scene, camera)
        forward = time.perf_counter() - start
        if target is None:
            target = torch.rand_like(output.image)
        for tensor in scene:
            tensor.grad = None
        outputs, g = [output.image, output.transmittance], [target, target[..., 0].contiguous()]
        backward = seconds(lambda outputs=outputs, g=g: torch.autograd.backward(outputs, g))
        yardstick = seconds(lambda: torch.exp(values))
        if run:
            for name, value in (("forward", forward), ("backward", backward), ("yardstick", yardstick)):
                times[name].append(value)
    return {name: statistics.median(values) for name, values in times.items()} | {"pairs": pairs}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--channels", type=int, default=8)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--no-reference", action="store_true", help="leave out the reference, which is slow")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    library, problem = native.find_library()
    print(
        f"{options.threads} threads, {options.channels} channels; native: {library.description if library else problem}"
    )
    results = []
    for size in options.sizes:
        count, width, height = SIZES[size]
        scene, camera = random_splats(count, width, height, options.channels)
        times = {}
        if library:
            times["native"] = time_splatter(native.splat_points, scene, camera, options.runs)
        if not options.no_reference:
            runs = options.runs if count <= 20_000 else 1
            times["reference"] = time_splatter(reference.splat_points, scene, camera, runs)
        for backend, t in times.items():
            unit = t["yardstick"]
            print(
                f"{size:>5} {backend:<10} forward {1000 * t['forward']:8.1f} ms ({t['forward'] / unit:6.2f} yardsticks)"
                f"  backward {1000 * t['backward']:8.1f} ms ({t['backward'] / unit:6.2f})"
                f"  yardstick {1000 * unit:6.1f} ms for {t['pairs'] / 1e6:.1f} M pairs"
            )
            results.append({"size": size, "count": count, "width": width, "height": height, "backend": backend, **t})
        if len(times) == 2:
            total = {name: t["forward"] + t["backward"] for name, t in times.items()}
            print(f"{size:>5} native is {total['reference'] / total['native']:.1f} times as fast as the reference")
    if options.json:
        header = {"threads": options.threads, "channels": options.channels, "torch": torch.__version__}
        options.json.write_text(
            json.dumps({**header, "library": str(library and library.description), "results": results})
        )


if __name__ == "__main__":
    main()
