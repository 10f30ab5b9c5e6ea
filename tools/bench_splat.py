"""Time and check the splatter's backends on this machine.

    speed       forward and backward of each backend, in seconds and in yardsticks: one yardstick is `torch.exp` over a
                float32 tensor with as many elements as there are splat-pixel pairs: into memory that is there already,
                and into new memory, which can take four times as long while the system deals out its pages. Ratios to
                them carry over from one machine to another far better than seconds do.
    cut-offs    what the `fast` preset, and each of its knobs, saves in time and costs in error against `exact`.
    growth      time against the number of pairs over three decades, and memory for each pair in flight.
    rounding    float32 against float64: relative error of the image and of every gradient.
    gsplat      forward and backward on a GPU against gsplat of PyPI, on the same splats and channels.

Everything runs in one process with the same number of threads; times are medians after a warm-up, what is compared by
turns.

    python tools/bench_splat.py --json bench.json
"""

import argparse
import ctypes
import importlib.util
import math
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from catacaustics.cameras import Camera
from catacaustics.files import write_json
from catacaustics.kernels import find_library
from catacaustics.splatting import Backend, SplatConfig, reference, splat_points
from catacaustics.splatting.reference import Disks

SIZES = {"20k": (20_000, 320, 213), "200k": (200_000, 1000, 666), "1M": (1_000_000, 1000, 666)}
OPAQUE = (300_000, 1000, 666)
GROWTH = (3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000)
NAMES = Disks._fields
SECTIONS = ("speed", "cut-offs", "growth", "rounding", "gsplat")


def random_splats(count: int, width: int, height: int, channels: int, device: str = "cpu") -> tuple[Disks, Camera]:
    """Disks of any orientation all over the image, with radii from 0.5 to 2.2 pixels, evenly on a log scale."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    camera = Camera(width, height, float(width), float(width), width / 2, height / 2, np.eye(4))
    z = 1 + 4 * uniform(count)
    pixels = uniform(count, 2) * torch.tensor([width, height]) - torch.tensor([width / 2, height / 2])
    positions = torch.cat([pixels / width * z[:, None], z[:, None]], 1)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    radii = 0.5 * (2.2 / 0.5) ** uniform(count)
    footprints = (radii * z / width) ** 2
    scene = Disks(positions, normals, footprints, 0.05 + 0.9 * uniform(count), uniform(count, channels))
    return Disks(*(t.to(device).requires_grad_() for t in scene)), camera


def opaque_splats(count: int, width: int, height: int, channels: int) -> tuple[Disks, Camera]:
    """The same, three times as wide and of opacity 0.8 to 0.99: most are hidden, as in the cloud of a real room."""
    scene, camera = random_splats(count, width, height, channels)
    with torch.no_grad():
        scene.footprints.mul_(9)
        scene.opacities.mul_(0.2).add_(0.8)
    return scene, camera


def count_pairs(scene: Disks, camera: Camera, config: SplatConfig) -> int:
    """Splat-pixel pairs: the area of the ellipses in pixels."""
    with torch.no_grad():
        positions, normals, footprints = scene[:3]
        pose = torch.tensor(camera.camera_from_world, dtype=positions.dtype, device=positions.device)
        focal, center = (camera.fx, camera.fy), (camera.cx, camera.cy)
        forms = reference.project(positions, normals, footprints, pose, focal, center, config.low_pass).forms
        return int((math.pi * config.support**2 / (forms[:, 0] * forms[:, 2]).sqrt()).sum())


def seconds(function: Callable[[], object]) -> float:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    start = time.perf_counter()
    function()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - start


def timed_step(splat: Callable[[], tuple[Tensor, ...]], scene: Sequence[Tensor]) -> tuple[float, float]:
    """Seconds of one forward and one backward pass, with all gradients."""
    outputs: list[Tensor] = []
    forward = seconds(lambda: outputs.extend(splat()[:2]))
    for tensor in scene:
        tensor.grad = None
    g = [torch.ones_like(t) for t in outputs]
    return forward, seconds(lambda: torch.autograd.backward(outputs, g))


def exponentials(values: Tensor) -> tuple[float, float]:
    """Seconds of `torch.exp` into memory that is there, and into memory that is new to the process (Linux)."""
    place = torch.zeros_like(values)
    there = seconds(lambda: torch.exp(values, out=place))
    del place
    if Path("/proc/self/clear_refs").exists():
        ctypes.CDLL(None).malloc_trim(0)
    return there, seconds(lambda: torch.exp(values))


def medians(rows: list[tuple[float, ...]]) -> list[float]:
    """Of each column, but for the first row (the warm-up)."""
    return [statistics.median(column) for column in zip(*rows[1:], strict=True)]


def speed(options: argparse.Namespace) -> list[dict]:
    backends: list[Backend] = ["cpu"] if find_library("cpu").library else []
    if not options.no_reference:
        backends.append("reference")
    results = []
    for size in options.sizes:
        count, width, height = SIZES[size]
        scene, camera = random_splats(count, width, height, options.channels)
        pairs = count_pairs(scene, camera, SplatConfig())
        values, total = -torch.rand(pairs), {}
        # A step of the reference at 1M takes as long as a hundred of the others.
        runs = min(options.runs, 3) if "reference" in backends and count > 200_000 else options.runs
        rows: dict[str, list] = {backend: [] for backend in backends}
        for _ in range(runs + 1):
            for backend in backends:
                step = timed_step(
                    lambda scene=scene, camera=camera, b=backend: splat_points(*scene, camera, backend=b), scene
                )
                rows[backend].append(step)
        yardstick, new = medians([exponentials(values) for _ in range(options.runs + 1)])
        print(
            f"{size:>5} {pairs / 1e6:.1f} M pairs: yardstick {1000 * yardstick:.1f} ms, into new memory"
            f" {1000 * new:.1f} ms"
        )
        for backend in backends:
            forward, backward = medians(rows[backend])
            total[backend] = forward + backward
            print(
                f"{size:>5} {backend:<10} forward {1000 * forward:8.1f} ms ({forward / yardstick:6.2f} yardsticks;"
                f" {forward / new:6.2f})  backward {1000 * backward:8.1f} ms ({backward / yardstick:6.2f};"
                f" {backward / new:6.2f})"
            )
            figures = {"forward": forward, "backward": backward, "yardstick": yardstick, "yardstick_new": new}
            results.append({"size": size, "count": count, "pairs": pairs, "backend": backend} | figures)
        library = find_library("cpu").library
        if library is not None:
            flat = torch.cat([t.detach().flatten() for t in scene])
            times = [seconds(lambda v=flat, lib=library: lib.call("finite", v, v, len(v))) for _ in range(9)]
            check = sorted(times)[4]
            print(f"{size:>5} looking for values that are not finite: {100 * check / total['cpu']:.2f} % of a step")
            results.append({"size": size, "count": count, "backend": "cpu", "finite": check})
        if len(total) == 2:
            print(f"{size:>5} cpu is {total['reference'] / total['cpu']:.1f} times as fast as the reference")
    return results


def gradients(scene: Disks, camera: Camera, config: SplatConfig) -> dict[str, Tensor]:
    """Image, transmittance and gradients of a sum weighted at random, by name."""
    out = splat_points(*scene, camera, config=config)
    generator = torch.Generator().manual_seed(1)
    weights = (torch.rand(out.image.shape, generator=generator) - 0.3).to(out.image)
    loss = (out.image * weights).sum() + out.transmittance.sum()
    grads = torch.autograd.grad(loss, scene)
    return {"image": out.image.detach(), "transmittance": out.transmittance.detach()} | dict(
        zip(NAMES, grads, strict=True)
    )


def cut_offs(options: argparse.Namespace) -> list[dict]:
    """Errors of the image in its units (features lie in [0, 1]); of gradients as a share of the exact ones' norm."""
    configs = {
        "exact": SplatConfig.exact(),
        "fast": SplatConfig.fast(),  # stop_transmittance 1e-4
        "stop 1e-3": SplatConfig(stop_transmittance=1e-3),
        "stop 1e-2": SplatConfig(stop_transmittance=1e-2),
        "alpha_min 1/1000": SplatConfig(alpha_min=1e-3),
        "alpha_min 1/255": SplatConfig(alpha_min=1 / 255),
        "1/255 and 1e-4": SplatConfig.fast(alpha_min=1 / 255),
    }
    results = []
    for size in [*options.sizes, "opaque"]:
        make = opaque_splats if size == "opaque" else random_splats
        scene, camera = make(*SIZES.get(size, OPAQUE), options.channels)
        rows: dict[str, list] = {name: [] for name in configs}
        for _ in range(options.runs + 1):
            for name, config in configs.items():
                rows[name].append(timed_step(lambda s=scene, k=camera, c=config: splat_points(*s, k, config=c), scene))
        exact, whole = gradients(scene, camera, configs["exact"]), sum(medians(rows["exact"]))
        for name, config in configs.items():
            forward, backward = medians(rows[name])
            got = gradients(scene, camera, config)
            error = (got["image"] - exact["image"]).abs()
            gradient = max(float((got[k] - exact[k]).norm() / exact[k].norm()) for k in NAMES)
            saved = 1 - (forward + backward) / whole
            print(
                f"{size:>6} {name:<16} forward {1000 * forward:7.1f} ms  backward {1000 * backward:7.1f} ms"
                f"  saved {100 * saved:5.1f} %  image error max {error.max():.1e} mean {error.mean():.1e}"
                f"  gradient error {gradient:.1e}"
            )
            errors = {"image_max": float(error.max()), "image_mean": float(error.mean()), "gradient": gradient}
            results.append({"size": size, "config": name, "forward": forward, "backward": backward} | errors)
    return results


def working_memory(scene: Disks, camera: Camera) -> float:
    """Bytes by which a forward and a backward pass raise the peak of the process, beyond their results (Linux)."""
    status, reset = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    if not reset.exists():
        return math.nan

    def kibibytes(field: str) -> int:
        return int(status.read_text().split(f"{field}:")[1].split()[0])

    # Memory that is free, but not yet the system's again, would hide ours.
    library = find_library("cpu").library
    if library is not None:
        library.handle.catacaustics_release()
    ctypes.CDLL(None).malloc_trim(0)
    reset.write_text("5")  # the peak starts anew from what is held now
    before = kibibytes("VmRSS")
    timed_step(lambda: splat_points(*scene, camera), scene)
    pixels = camera.width * camera.height * (scene.features.shape[1] + 1)
    results = 4 * (sum(t.numel() for t in scene) + 2 * pixels)  # gradients, image, transmittance and their gradients
    return 1024 * (kibibytes("VmHWM") - before) - results


def growth(options: argparse.Namespace) -> list[dict]:
    results, (width, height) = [], SIZES["1M"][1:]
    for count in GROWTH:
        scene, camera = random_splats(count, width, height, options.channels)
        pairs = count_pairs(scene, camera, SplatConfig())
        runs = options.runs if count < 1_000_000 else min(options.runs, 3)
        rows = [
            timed_step(lambda scene=scene, camera=camera: splat_points(*scene, camera), scene) for _ in range(runs + 1)
        ]
        forward, backward = medians(rows)
        for tensor in scene:
            tensor.grad = None
        memory = working_memory(scene, camera) / pairs
        print(
            f"{pairs / 1e6:8.2f} M pairs  forward {1000 * forward:8.1f} ms  backward {1000 * backward:8.1f} ms"
            f"  {1e9 * (forward + backward) / pairs:6.1f} ns a pair  {memory:5.1f} bytes a pair"
        )
        results.append({"count": count, "pairs": pairs, "forward": forward, "backward": backward, "memory": memory})
    x = np.log([r["pairs"] for r in results])
    y = np.log([r["forward"] + r["backward"] for r in results])
    print(
        f"time grows with the number of pairs to the power {np.polyfit(x, y, 1)[0]:.2f}"
        f" ({np.polyfit(x[-3:], y[-3:], 1)[0]:.2f} over the last decade, where pixels no longer count)"
    )
    return results


def rounding(options: argparse.Namespace) -> list[dict]:
    """Where no pixel lies on the edge of a splat (support 8): there rounding decides whether it is drawn."""
    config, count = SplatConfig(support=8.0), 20_000
    scene, camera = random_splats(count, *SIZES["20k"][1:], options.channels)
    double = Disks(*(t.detach().double().requires_grad_() for t in scene))
    got, want = gradients(scene, camera, config), gradients(double, camera, config)
    errors = {k: float((got[k] - want[k]).norm() / want[k].norm()) for k in want}
    worst = {k: float((got[k] - want[k]).abs().max() / want[k].abs().max()) for k in want}
    for name, error in errors.items():
        print(f"{name:<14} {error:.1e} of its norm; largest error {worst[name]:.1e} of its largest value")
    return [{"result": k, "of_norm": errors[k], "largest": worst[k]} for k in errors]


def against_gsplat(options: argparse.Namespace) -> list[dict]:
    library, problem = find_library("cuda")
    if library is None or not importlib.util.find_spec("gsplat"):
        print(f"not run: {'gsplat is not installed' if library else problem}")
        return []
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    results = []
    for size in options.sizes:
        count, width, height = SIZES[size]
        scene, camera = random_splats(count, width, height, options.channels, "cuda")
        positions, normals, footprints, opacities, features = scene
        # Disks are Gaussians without thickness; the rotation takes z to the normal.
        with torch.no_grad():
            t1, t2 = reference.tangent_basis(normals)
            quaternions = torch.nn.functional.normalize(quaternion(torch.stack([t1, t2, normals], -1)), dim=1)
            scales = torch.stack([footprints.sqrt(), footprints.sqrt(), torch.full_like(footprints, 1e-8)], 1)
        k = torch.tensor(camera.intrinsics, dtype=torch.float32, device="cuda")[None]
        other = [t.detach().clone().requires_grad_() for t in (positions, quaternions, scales, opacities, features)]

        def gsplat(other=other, k=k, width=width, height=height) -> tuple[Tensor, Tensor]:
            pose = torch.eye(4, device="cuda")[None]
            image, alpha, _ = rasterization(*other, pose, k, width, height, eps2d=0.3, packed=False)
            return image, alpha

        for config in (SplatConfig.exact(), SplatConfig.fast()):
            ours = lambda s=scene, c=camera, config=config: splat_points(*s, c, config=config)  # noqa: E731
            rows = []
            for _ in range(options.runs + 3):
                rows.append((*timed_step(ours, scene), *timed_step(gsplat, other)))
            forward, backward, their_forward, their_backward = medians(rows[2:])
            name = "fast" if config == SplatConfig.fast() else "exact"
            print(
                f"{size:>5} {name:<5} forward {1000 * forward:7.2f} ms, gsplat {1000 * their_forward:7.2f}"
                f"  backward {1000 * backward:7.2f} ms, gsplat {1000 * their_backward:7.2f}"
                f"  together {(forward + backward) / (their_forward + their_backward):.2f} of gsplat's time"
            )
            theirs = {"gsplat_forward": their_forward, "gsplat_backward": their_backward}
            results.append({"size": size, "config": name, "forward": forward, "backward": backward} | theirs)
    return results


def quaternion(rotation: Tensor) -> Tensor:
    """(w, x, y, z) of rotation matrices (n, 3, 3), not normalised: of four equivalent forms the best conditioned."""
    m = rotation.flatten(1).unbind(1)
    trace = m[0] + m[4] + m[8]
    forms = torch.stack(
        [
            torch.stack([1 + trace, m[7] - m[5], m[2] - m[6], m[3] - m[1]], 1),
            torch.stack([m[7] - m[5], 1 + 2 * m[0] - trace, m[1] + m[3], m[2] + m[6]], 1),
            torch.stack([m[2] - m[6], m[1] + m[3], 1 + 2 * m[4] - trace, m[5] + m[7]], 1),
            torch.stack([m[3] - m[1], m[2] + m[6], m[5] + m[7], 1 + 2 * m[8] - trace], 1),
        ],
        1,
    )
    best = torch.stack([forms[:, i, i] for i in range(4)], 1).argmax(1)
    return forms[torch.arange(len(forms), device=forms.device), best]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--channels", type=int, default=8)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--no-reference", action="store_true", help="leave out the reference, which is slow")
    parser.add_argument("--json", type=Path, help="file to write all figures to")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    built = {
        device: found.library.description if found.library else found.problem
        for device in ("cpu", "cuda")
        for found in [find_library(device)]
    }
    header = {"threads": options.threads, "channels": options.channels, "torch": torch.__version__} | built
    print(", ".join(f"{name}: {value}" for name, value in header.items()))
    sections = dict(zip(SECTIONS, (speed, cut_offs, growth, rounding, against_gsplat), strict=True))
    results = {}
    for name in options.sections:
        print(f"\n{name}")
        results[name] = sections[name](options)
    if options.json:
        write_json(options.json, {**header, **results})


if __name__ == "__main__":
    main()
