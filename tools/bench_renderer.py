"""Time and check the neural renderer's native code against PyTorch's on this machine's processor.

    step    forward and backward of a training step of 150 x 150 pixels, with gradients of features and parameters
    image   forward of 480 x 320 pixels without gradients, in the strips that rendering takes
    error   float32 against float64, of both: norm of the error as a share of the norm of each kind of result

The two take turns in one process with the same number of threads; times are medians after a warm-up. Seconds of
processor time are given beside them, as another program that computes at the same time hardly changes those. GFLOP/s
count each multiplication and addition of the network once, those backward twice as many: not what is computed again.

    python tools/bench_renderer.py --json bench.json
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from catacaustics.files import write_json
from catacaustics.kernels import find_library, host_kernel
from catacaustics.renderer import FEATURES, NeuralRenderer

CHOICES = {"native": "cpu", "torch": "reference"}
CHANNELS = (FEATURES, FEATURES, 3)


def choose(name: str) -> None:
    os.environ["CATACAUSTICS_BACKEND"] = CHOICES[name]


def renderer_and_images(
    options: argparse.Namespace, height: int, width: int, seed: int = 0
) -> tuple[NeuralRenderer, list[Tensor]]:
    """A network without zeros, and images of features and directions."""
    torch.manual_seed(seed)
    renderer = NeuralRenderer(options.width, options.layers)
    with torch.no_grad():
        for parameter in renderer.parameters():
            parameter.add_(torch.randn_like(parameter) * 0.1)
    return renderer, [torch.randn(height, width, c) for c in CHANNELS]


def operations(renderer: NeuralRenderer, pixels: int) -> float:
    """Multiplications and additions of one forward pass."""
    return 2.0 * pixels * sum(p.numel() for p in renderer.parameters() if p.dim() == 2)


def clocks(function: Callable[[], object]) -> tuple[float, float]:
    """Seconds, and seconds of processor time of all threads."""
    wall, processor = time.perf_counter(), time.process_time()
    function()
    return time.perf_counter() - wall, time.process_time() - processor


def by_turns(options: argparse.Namespace, once: Callable[[], tuple[float, ...]]) -> dict[str, list[float]]:
    """Medians of what `once` measures, for each choice."""
    rows: dict[str, list] = {name: [] for name in CHOICES}
    for _ in range(options.runs + 2):
        for name, measured in rows.items():
            choose(name)
            measured.append(once())
    return {name: [statistics.median(c) for c in zip(*measured[2:], strict=True)] for name, measured in rows.items()}


def step(options: argparse.Namespace) -> dict:
    renderer, images = renderer_and_images(options, 150, 150)
    g = torch.randn(150, 150, 3)

    def once() -> tuple[float, ...]:
        inputs, image = [t.clone().requires_grad_(i < 2) for i, t in enumerate(images)], []
        renderer.zero_grad()
        return *clocks(lambda: image.append(renderer(*inputs))), *clocks(lambda: image[0].backward(g))

    found, work = by_turns(options, once), operations(renderer, 150 * 150)
    for name, (forward, forward_cpu, backward, backward_cpu) in found.items():
        print(
            f"step  {name:<6} forward {1e3 * forward:6.1f} ms ({1e3 * forward_cpu:6.1f} of processors,"
            f" {work / forward / 1e9:5.1f} GFLOP/s)  backward {1e3 * backward:6.1f} ms"
            f" ({1e3 * backward_cpu:6.1f} of processors, {2 * work / backward / 1e9:5.1f} GFLOP/s)"
        )
    n, t = found["native"], found["torch"]
    ratios = {"forward": t[0] / n[0], "backward": t[2] / n[2], "together": (t[0] + t[2]) / (n[0] + n[2])}
    ratios["processors"] = (t[1] + t[3]) / (n[1] + n[3])
    print("step  native is faster by: " + ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items()))
    return found | {"ratios": ratios}


def image(options: argparse.Namespace) -> dict:
    renderer, images = renderer_and_images(options, 320, 480)
    strips = list(zip(*(t.split(16_384 // 480) for t in images), strict=True))

    def once() -> tuple[float, ...]:
        with torch.no_grad():
            return clocks(lambda: [renderer(*strip) for strip in strips])

    found, work = by_turns(options, once), operations(renderer, 320 * 480)
    for name, (forward, processors) in found.items():
        print(
            f"image {name:<6} forward {1e3 * forward:6.1f} ms ({1e3 * processors:6.1f} of processors,"
            f" {work / forward / 1e9:5.1f} GFLOP/s)"
        )
    ratio = found["torch"][0] / found["native"][0]
    print(f"image native is faster by: {ratio:.2f}")
    return found | {"ratio": ratio}


def error(options: argparse.Namespace) -> dict:
    """Medians over networks: in some, rounding decides whether a ReLU passes a pixel, in either implementation."""
    rows: dict[str, list] = {name: [] for name in CHOICES}
    for seed in range(7):
        renderer, images = renderer_and_images(options, 100, 100, seed)

        def results(name: str, dtype: torch.dtype, renderer=renderer, images=images, seed=seed) -> list[Tensor]:
            choose(name)
            network = NeuralRenderer(options.width, options.layers).to(dtype)
            network.load_state_dict(renderer.state_dict())
            inputs = [t.clone().to(dtype).requires_grad_() for t in images]
            rgb = network(*inputs)
            generator = torch.Generator().manual_seed(seed)
            rgb.backward(torch.randn(rgb.shape, generator=generator).to(dtype))
            kinds = inputs, network.parameters()
            return [rgb.detach(), *(torch.cat([t.grad.flatten() for t in k if t.grad is not None]) for k in kinds)]

        exact = results("torch", torch.float64)
        for name in CHOICES:
            pairs = zip(results(name, torch.float32), exact, strict=True)
            rows[name].append([float((got.double() - want).norm() / want.norm()) for got, want in pairs])
    kinds, found = ("image", "inputs", "parameters"), {}
    for name, measured in rows.items():
        found[name] = dict(zip(kinds, map(statistics.median, zip(*measured, strict=True)), strict=True))
        print(f"error {name:<6} " + ", ".join(f"{kind} {value:.1e}" for kind, value in found[name].items()))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=32)
    parser.add_argument("--layers", type=int, default=5)
    parser.add_argument("--runs", type=int, default=15)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--json", type=Path, help="file to write all figures to")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if host_kernel("network", torch.zeros(1)) is None:
        library, problem = find_library("cpu")
        raise SystemExit(f"no native renderer: {'CATACAUSTICS_BACKEND leaves it out' if library else problem}")
    library = find_library("cpu").library
    assert library is not None
    header = {"threads": options.threads, "width": options.width, "layers": options.layers}
    header |= {"torch": torch.__version__, "cpu": library.description}
    print(", ".join(f"{name}: {value}" for name, value in header.items()))
    results = {"step": step(options), "image": image(options), "error": error(options)}
    if options.json:
        write_json(options.json, {**header, **results})


if __name__ == "__main__":
    main()
