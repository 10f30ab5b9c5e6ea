"""Make a data set: draw a scene again and again, trace its buffers, render its references, write them in shards.

Frame i of a split is drawn with the random generator of (seed, number of the split, i): the splits share no frame, and
a run that was stopped goes on with the same frames.
"""

import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from catacaustics.cameras import Camera
from catacaustics.config import RefractDataConfig
from catacaustics.errors import UserError
from catacaustics.files import write_json
from catacaustics.geometry import normalize
from catacaustics.images import write_image
from catacaustics.refraction.contact import contact_sheet
from catacaustics.refraction.frames import (
    CARD,
    FORMAT,
    SPLITS,
    Frame,
    open_frames,
    read_card,
    sha256_of,
    shard_problem,
    write_shard,
)
from catacaustics.refraction.scenes import Scene, at_shares, draw, find_scene, ranges, with_ranges
from catacaustics.refraction.stage import MAX_DEPTH, Stage, camera_of, camera_rays, srgb, whole_samples, world_to_clip
from catacaustics.refraction.trace import MAX_EVENTS, land
from catacaustics.refraction.variants import VECTORISED, choose_variant
from catacaustics.shapes import Float

SHARD = 10
"""Frames in a shard, at most."""
TRIES = 20
"""Draws of a frame whose camera stands badly."""


class _Job(NamedTuple):
    """A shard to make."""

    file: str
    split: str
    first: int
    frames: int


def make_frame(scene: Scene, config: RefractDataConfig, split: str, index: int) -> Frame:
    """Draw and render one frame; `choose_variant` first.

    Raises:
        UserError: the ranges leave no room for the camera, or put a body outside the world.
    """
    seeds = np.random.SeedSequence([config.seed, SPLITS.index(split), index])
    stage, camera, share = _stand(scene, np.random.default_rng(seeds), config.resolution)
    noise = int(seeds.generate_state(1)[0] >> 1)
    with_reference = split != "generator"
    spp = config.spp if with_reference else 0
    return _render(stage, camera, share, config.screen if with_reference else 0, spp, noise)


def frame_at(scene: Scene, share: Float[np.ndarray, "p"], resolution: int, screen: int, spp: int = 0) -> Frame:
    """Render the frame of given parameters; `choose_variant` first.

    Args:
        share: where each parameter lies in its range, in [0, 1], in the order of the card.
        screen: side of the screen-space buffers.
        spp: samples a pixel of the reference; 0 leaves it out.

    Raises:
        UserError: the camera stands badly.
    """
    drawn = at_shares(scene, share)
    stage, camera = Stage(drawn), camera_of(drawn, resolution)
    problem = stage.problem(camera)
    if problem is not None:
        raise UserError(f"The camera {problem}.", "a camera inside the room, in free space", "move it, or the body")
    return _render(stage, camera, share, screen, spp, 0)


def _render(stage: Stage, camera: Camera, share: np.ndarray, screen: int, spp: int, noise: int) -> Frame:
    """All buffers, with a reference where spp is above 0."""
    opaque = stage.gbuffer(camera)
    colour, depth = _screen(stage, camera, screen)
    probe, probe_position = _probe(stage, screen // 2)
    black = np.zeros((camera.height, camera.width, 3))
    reference = srgb(stage.reference(camera, whole_samples(spp), noise)) if spp else black
    return Frame(
        reference=reference.astype(np.float32),
        has_reference=spp > 0,
        **opaque,
        direct=srgb(stage.direct(camera)).astype(np.float32),
        **stage.alone(camera),
        object_ior=np.array([b.ior for b in stage.scene.transparent], np.float32),
        object_to_world=stage.object_to_world().astype(np.float32),
        **_landing(stage, camera),
        screen=colour,
        screen_depth=depth,
        probe=probe,
        probe_position=probe_position,
        world_to_clip=world_to_clip(camera).astype(np.float32),
        camera_position=camera.center.astype(np.float32),
        parameters=share.astype(np.float32),
    )


def _stand(scene: Scene, rng: np.random.Generator, resolution: int) -> tuple[Stage, Camera, np.ndarray]:
    """A drawn scene whose camera stands free."""
    problem = place = ""
    for _ in range(TRIES):
        drawn, share = draw(scene, rng)
        stage, camera = Stage(drawn), camera_of(drawn, resolution)
        problem = stage.problem(camera)
        if problem is None:
            return stage, camera, share
        place = ", ".join(f"{v:.2f}" for v in camera.center)
    raise UserError(
        f"The ranges of the scene {scene.name} leave its camera no room: at ({place}) it {problem}; {TRIES} draws in a "
        "row stood like this.",
        "cameras inside the room, in free space",
        "narrow the ranges eye.distance, eye.azimuth, eye.elevation or eye.target, or those of the bodies in the way",
    )


def _screen(stage: Stage, camera: Camera, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth of the opaque scene in side x side pixels."""
    if not side:
        return np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0), np.float32)
    found = stage.gbuffer(camera.resized(side, side))
    return np.round(255 * np.clip(found["albedo"], 0, 1)).astype(np.uint8), found["depth"]


def _probe(stage: Stage, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Panorama of the opaque scene and where it is taken."""
    return stage.probe(rows) if rows else (np.zeros((0, 0, 3), np.uint8), np.zeros(3, np.float32))


def _landing(stage: Stage, camera: Camera) -> dict[str, np.ndarray]:
    directions = normalize(camera_rays(camera))
    found = land(stage.intersect, stage.media, np.broadcast_to(camera.center, directions.shape), directions)
    number = np.cumsum(np.isnan(stage.media.inner)) - 1  # of opaque bodies, by body
    size, body = (camera.height, camera.width), found.body
    return {
        "refractive": found.refractive.reshape(size),
        "landing": found.position.reshape(*size, 3).astype(np.float32),
        "landing_uv": found.uv.reshape(*size, 2).astype(np.float32) % 1,  # what is rounded up to 1 is 0
        "landing_normal": found.normal.reshape(*size, 3).astype(np.float32),
        "landing_object": np.where(body >= 0, number[body], -1).reshape(size),
        "events": found.events.reshape(size),
        "internal_reflection": found.internal.reshape(size),
    }


def _jobs(config: RefractDataConfig) -> list[_Job]:
    """All shards; validation and test first, so that a run cut short can be measured."""
    jobs = []
    for split in ("val", "test", "train", "generator"):
        count = getattr(config, split)
        for i, first in enumerate(range(0, count, SHARD)):
            jobs.append(_Job(f"shards/{split}_{i:04d}.npz", split, first, min(SHARD, count - first)))
    return jobs


def _check(config: RefractDataConfig) -> None:
    counts = [getattr(config, s) for s in SPLITS]
    sizes = (config.resolution, config.screen, config.spp, config.processes)
    if min(counts) < 0 or sum(counts) == 0 or min(sizes) < 1 or config.seed < 0:
        raise UserError(
            f"Sizes cannot be used: {dict(zip(SPLITS, counts, strict=True))} frames, resolution {config.resolution}, "
            f"screen {config.screen}, spp {config.spp}, processes {config.processes}, seed {config.seed}.",
            "one frame or more; resolution, screen, spp and processes of 1 or more; no negative number",
            "correct the options",
        )


def _start(config: RefractDataConfig, scene: Scene, variant: str) -> dict[str, Any]:
    """The data card; refuse a folder that was begun with other settings."""
    import mitsuba as mi

    settings = {k: v for k, v in asdict(config).items() if k not in ("out", "processes", "variant")}
    settings["ranges"] = list(config.ranges)
    path = config.out / CARD
    if path.is_file():
        card = read_card(config.out)
        before = card.get("settings", {})
        changed = [f"{k} {before.get(k)}" for k in settings if before.get(k) != settings[k]]
        if changed:
            raise UserError(
                f"{config.out} holds a data set made with other settings: {', '.join(changed)}.",
                "the settings it was begun with, to go on; or an empty folder",
                "choose another folder, or delete this one",
            )
        return card
    textures = [f"textures/{i}_{body.name}.png" for i, body in enumerate(scene.opaque)]
    for file, body in zip(textures, scene.opaque, strict=True):
        write_image(config.out / file, body.texture())
    card = {
        "format": FORMAT,
        "scene": scene.name,
        "about": scene.about,
        "settings": settings,
        "seed": config.seed,
        "seeds": "frame i of split s is drawn with numpy.random.SeedSequence([seed, s, i]); s: " + ", ".join(SPLITS),
        "mitsuba": mi.__version__,
        "variant": variant,
        "splits": {s: getattr(config, s) for s in SPLITS},
        "resolution": config.resolution,
        "screen": config.screen,
        "spp": whole_samples(config.spp),
        "max_depth": MAX_DEPTH,
        "max_events": MAX_EVENTS,
        "branch": "refraction, or reflection where Fresnel's reflectance exceeds 0.5",
        "scene_size": 2.0,
        "parameters": [{"name": n, "low": r.low, "high": r.high} for n, r in ranges(scene).items()],
        "opaque": [b.name for b in scene.opaque],
        "transparent": [b.name for b in scene.transparent],
        "textures": textures,
        "license": "Generated by this program, meshes and textures included: free to use.",
        "shards": [{"file": j.file, "split": j.split, "frames": j.frames, "sha256": None} for j in _jobs(config)],
    }
    write_json(path, card)
    return card


def _pending(config: RefractDataConfig, card: dict[str, Any]) -> list[_Job]:
    """Shards that are missing, unfinished or damaged. A finished one that the card does not know yet is entered."""
    jobs = []
    for job, entry in zip(_jobs(config), card["shards"], strict=True):
        path = config.out / job.file
        problem = shard_problem(path, entry["sha256"])
        if problem is None and entry["sha256"] is None:
            entry["sha256"] = sha256_of(path)
        if problem:
            if entry["sha256"]:
                print(f"{path} {problem}; it is made again")
            jobs.append(job)
    return jobs


def _prepare(variant: str) -> None:
    """Start Mitsuba in a process of its own. An interrupt ends its shard: Mitsuba has stopped a picture half-way."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _single_thread(variant)


def _single_thread(variant: str) -> None:
    choose_variant(variant, VECTORISED)
    import drjit as dr

    dr.set_thread_count(1)


def _make(config: RefractDataConfig, job: _Job) -> tuple[str, str]:
    """Make one shard. Returns its file and SHA-256."""
    scene = with_ranges(find_scene(config.scene), config.ranges)
    frames = [make_frame(scene, config, job.split, i) for i in range(job.first, job.first + job.frames)]
    return job.file, write_shard(config.out / job.file, frames)


def _made(config: RefractDataConfig, jobs: list[_Job], variant: str) -> Iterator[tuple[str, str]]:
    """Shards as they are finished."""
    if min(config.processes, len(jobs)) <= 1:
        yield from (_make(config, job) for job in jobs)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(config.processes, len(jobs)), context, _prepare, (variant,)) as pool:
        try:
            for future in as_completed([pool.submit(_make, config, job) for job in jobs]):
                yield future.result()
        except BrokenProcessPool as error:
            raise UserError(
                "A process that rendered ended by itself.",
                "enough memory for every process (about 1 GB each)",
                "run the same command again, with fewer --processes; what is finished is kept",
            ) from error
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def make_data(config: RefractDataConfig) -> None:
    """Make a data set, or finish one that was begun.

    Raises:
        UserError: unknown scene or range, no room for the camera, no usable Mitsuba, a folder with another data set, a
            full disk. What is finished is kept.
    """
    _check(config)
    scene = with_ranges(find_scene(config.scene), config.ranges)
    variant = choose_variant(config.variant, VECTORISED)
    _single_thread(variant)
    _stand(scene, np.random.default_rng(config.seed), 8)  # before anything is written
    card = _start(config, scene, variant)
    jobs = _pending(config, card)
    if not jobs:
        print(f"{config.out}: finished already")
    entries = {entry["file"]: entry for entry in card["shards"]}
    with tqdm(total=sum(j.frames for j in jobs), desc=config.scene, unit="frame", disable=not jobs) as bar:
        for file, digest in _made(config, jobs, variant):
            entries[file]["sha256"] = digest
            write_json(config.out / CARD, card)
            bar.update(entries[file]["frames"])
    write_json(config.out / CARD, card)
    frames = open_frames(config.out)
    write_image(config.out / "contact.jpg", contact_sheet(frames))
    print(f"{config.out}: " + ", ".join(f"{card['splits'][s]} {s}" for s in SPLITS) + f" frames of {config.scene}")
