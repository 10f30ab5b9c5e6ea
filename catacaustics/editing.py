"""Edits: pure functions from a scene to a scene, and the commands that apply them to runs."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from catacaustics.cameras import up_direction
from catacaustics.config import CloneConfig, EditConfig
from catacaustics.environment import texels
from catacaustics.errors import UserError
from catacaustics.files import write_json
from catacaustics.geometry import normalize
from catacaustics.images import read_image
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.reflectors.warps import (
    DecoupledWarp,
    MovedWarp,
    NeuralWarp,
    StaticWarp,
    inner_warp,
    moved_mirror,
)
from catacaustics.run import Run, named_view, open_run
from catacaustics.scene import PointParameters, Scene
from catacaustics.shapes import Bool, Float

_HIDDEN = -30.0
"""A logit of practically 0."""


def reflector_index(scene: Scene, name: str | None) -> int:
    """The index of a reflector by name; of the only one where no name is given.

    Raises:
        UserError: no reflector of that name, or several and none named.
    """
    names = [v.name for v in scene.volumes]
    if name is None and len(names) == 1:
        return 0
    if name not in names:
        raise UserError(
            f"The scene has no reflector {name}." if name else f"The scene has {len(names)} reflectors.",
            f"one of: {', '.join(names) or 'none, it was trained without'}",
            "name it with --reflector",
        )
    return names.index(name)


def clone_reflector(
    scene: Scene,
    index: int,
    shift: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    scale: float = 1.0,
    box: Float[np.ndarray, "2 3"] | None = None,
    resting: bool = False,
) -> Scene:
    """A second copy of a reflector: its primary points, its cloud, warp and volume.

    The copy is at x_new = c + scale * rotation (x - c) + shift, c the volume's centre. Two bodies are never at one
    place: what was where the copy stands gives way, a reflector whose centre is inside it altogether. So a copy that is
    not moved changes nothing.

    What it mirrors: by default what the original mirrors, as if the surroundings had moved, turned and grown along. Its
    reflection is the original's, computed from the inversely transformed camera. That is right where the surroundings
    are far away compared with the shift, and for turns only where they turn too. `resting` leaves the surroundings at
    their place and moves the mirror alone, which is what happens in nature, for the rungs that are a mirror and world
    points. Neither shows one reflector in the other.

    Args:
        box: two opposite corners: the primary points in it are copied instead of those in the reflection volume, so
            that a stand can come along.

    Raises:
        UserError: `resting` for a rung that has no mirror of its own, or no primary points to copy.
    """
    volume = scene.volumes[index]
    offset = volume.center + shift - scale * rotation @ volume.center
    turn, move = (torch.from_numpy(np.asarray(a, np.float32)).to(scene.device) for a in (rotation, offset))
    positions = scene.primary.positions.detach().cpu().numpy().astype(np.float64)
    copied = _within(positions, volume, box)
    if not copied.any():
        raise UserError(
            f"There are no primary points in {'the box' if box is not None else volume.name}.",
            "a box in world units around something",
            "look up coordinates in `catacaustics view`, or leave --box out",
        )
    moved = volume.moved(scale, rotation, offset, volume.name)
    replaced = [i for i, v in enumerate(scene.volumes) if moved.contains(v.center[None])[0]]
    cleared = _within((positions - offset) @ rotation / scale, volume, box)
    for i in replaced:
        cleared |= _within(positions, scene.volumes[i], None)
    if index not in replaced:
        moved = replace(moved, name=_free_name(scene, volume.name))

    edited = copy.deepcopy(scene)
    primary = edited.primary
    with torch.no_grad():
        for name, parameter in list(primary.named_parameters()):
            rows = parameter[torch.from_numpy(copied)].clone()
            if name == "positions":
                rows = scale * rows @ turn.T + move
            elif name == "normals":
                rows = rows @ turn.T
            elif name == "log_footprints":
                rows += 2 * np.log(scale)
            setattr(primary, name, nn.Parameter(torch.cat([parameter[torch.from_numpy(~cleared)], rows])))
    warp = _moved_warp(edited, index, scale, turn, move, resting)
    kept = [i for i in range(len(scene.volumes)) if i not in replaced]
    clouds = [*(edited.reflections[i] for i in kept), copy.deepcopy(scene.reflections[index])]
    warps = [*(edited.warps[i] for i in kept), warp]
    edited.set_reflectors(clouds, warps, [*(scene.volumes[i] for i in kept), moved])
    return edited


def _within(
    points: Float[np.ndarray, "n 3"], volume: ReflectionVolume, box: Float[np.ndarray, "2 3"] | None
) -> Bool[np.ndarray, "n"]:
    """In the box, or in the volume and a hair around it."""
    if box is None:
        return volume.scaled(1.03).contains(points)
    return ((points >= box.min(0)) & (points <= box.max(0))).all(1)


def _moved_warp(
    scene: Scene, index: int, scale: float, turn: torch.Tensor, move: torch.Tensor, resting: bool
) -> nn.Module:
    warp = copy.deepcopy(scene.warps[index])
    if not resting:
        return MovedWarp(warp, scale, turn, move)
    mirror = moved_mirror(warp, scale, turn, move)
    if mirror is None:
        raise UserError(
            f"The reflections of {scene.volumes[index].name} cannot be seen from another place "
            f"({type(inner_warp(warp)).__name__}{', edited' if inner_warp(warp) is not warp else ''}).",
            "a plane, sphere, ellipsoid, revolution or concave model, not edited before",
            "leave --surroundings at moved: the copy then mirrors what the original mirrors",
        )
    return mirror


def _free_name(scene: Scene, name: str) -> str:
    names = {v.name for v in scene.volumes}
    return next(n for n in (f"{name} copy", *(f"{name} copy {i}" for i in range(2, 10_000))) if n not in names)


def decouple_reflections(
    scene: Scene,
    index: int,
    offset: Float[np.ndarray, "3"],
    gain: float = 1.0,
    pivot: Float[np.ndarray, "3"] | None = None,
    strength: float = 1.0,
) -> Scene:
    """Let a reflector's reflections follow another camera than the view's: from c they are those that
    c + strength ((gain - 1) (c - pivot) + offset) sees, painted on the mirror. No mirror does this.

    A camera path of the warp's own is `Scene.render(camera, warp_camera)`, and `catacaustics render --warp-path`.

    Args:
        offset: world units and axes.
        gain: 2 lets reflections move as if you walked twice as far from the pivot, 0 freezes them as seen from there.
        pivot: left out, the origin.
        strength: 0 leaves reflections as they are.

    Raises:
        UserError: the reflections do not depend on the camera.
    """
    if isinstance(inner_warp(scene.warps[index]), StaticWarp):
        raise UserError(
            f"The reflections of {scene.volumes[index].name} stay where they are, whatever camera sees them.",
            "another model than static",
            "train with a model that moves reflections",
        )
    edited = copy.deepcopy(scene)
    to = scene.primary.positions
    place = np.zeros(3) if pivot is None else pivot
    vectors = (torch.tensor(v, dtype=to.dtype, device=to.device) for v in (np.asarray(offset), place))
    shift, center = vectors
    edited.warps[index] = DecoupledWarp(edited.warps[index], shift, gain, center, strength)
    return edited


def adjust_reflections(
    scene: Scene, index: int, strength: float = 1.0, tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Scene:
    """Dim (strength below 1), strengthen or tint a reflector's reflections; strength 0 erases them, and its surface
    shows what was learned of it."""
    edited = copy.deepcopy(scene)
    cloud = edited.reflections[index]
    with torch.no_grad():
        if strength == 0:
            cloud.opacity_logits.fill_(_HIDDEN)
        else:
            cloud.features.mul_(strength)
            cloud.features[:, :3] *= torch.tensor(tint, device=scene.device)
    return edited


def replace_surroundings(
    scene: Scene,
    index: int,
    panorama: Float[np.ndarray, "height width 3"],
    up: Float[np.ndarray, "3"] | None = None,
    turn: float = 0.0,
) -> Scene:
    """Let a reflector mirror another place: its points take the colours of a latitude-longitude image around it, looked
    up in the direction of what they mirror.

    Args:
        up: the direction of the image's top row; left out, -y, as in environment.py.
        turn: of the image about that direction, in degrees.

    Raises:
        UserError: the model does not keep world positions of what is mirrored.
    """
    inner = inner_warp(scene.warps[index])
    if isinstance(inner, NeuralWarp | StaticWarp):
        raise UserError(
            f"The reflections of {scene.volumes[index].name} do not know what they mirror ({type(inner).__name__}).",
            "a plane, sphere, ellipsoid, revolution, concave or quadric+neural model",
            "train with one of these models",
        )
    edited = copy.deepcopy(scene)
    cloud = edited.reflections[index]
    with torch.no_grad():
        center = torch.from_numpy(scene.volumes[index].center).to(cloud.positions)
        upright = torch.from_numpy(_upright(up, turn)).to(center)
        directions = torch.nn.functional.normalize(_mirrored(scene, index) - center, dim=1) @ upright.T
        colors = torch.from_numpy(np.ascontiguousarray(panorama, np.float32)).to(scene.device)
        cloud.features.zero_()
        cloud.features[:, :3] = colors[texels(directions, *panorama.shape[:2])]
    return edited


def _upright(up: Float[np.ndarray, "3"] | None, turn: float) -> Float[np.ndarray, "3 3"]:
    """The rotation that takes `up` to -y, and then turns about it."""
    from scipy.spatial.transform import Rotation

    down = np.array([0.0, 1.0, 0.0])
    about = Rotation.from_rotvec(np.radians(turn) * down)
    if up is None:
        return about.as_matrix()
    axis, cosine = np.cross(up, -down), float(up @ -down / np.linalg.norm(up))
    if np.linalg.norm(axis) < 1e-9:
        axis = np.array([1.0, 0.0, 0.0])
    return (about * Rotation.from_rotvec(np.arccos(np.clip(cosine, -1, 1)) * normalize(axis))).as_matrix()


def _mirrored(scene: Scene, index: int) -> torch.Tensor:
    """World positions of what a reflector mirrors: with a moved one they moved along."""

    def moved(warp: nn.Module, points: torch.Tensor) -> torch.Tensor:
        if isinstance(warp, DecoupledWarp):
            return moved(warp.warp, points)
        if isinstance(warp, MovedWarp):
            return warp.scale * moved(warp.warp, points) @ warp.rotation.T + warp.shift
        return points

    cloud: PointParameters = scene.reflections[index]  # pyright: ignore[reportAssignmentType]
    return moved(scene.warps[index], cloud.positions)


def edit(config: EditConfig) -> None:
    """Write OUT, a run with adjusted reflections.

    Raises:
        UserError: no such run or reflector, a strength below 0, surroundings that the model cannot replace, or
            reflections that follow no camera.
    """
    run = _open(config.run, config.out, config.device)
    index = reflector_index(run.scene, config.reflector)
    if config.strength < 0 or min(config.tint) < 0:
        raise UserError(
            f"Strength {config.strength:g}, tint {config.tint}.", "0 or more", "correct --strength or --tint"
        )
    scene = run.scene
    if config.surroundings is not None:
        up = up_direction([v.camera for v in run.capture.views])
        panorama = read_image(config.surroundings)
        scene = replace_surroundings(scene, index, panorama, up, config.surroundings_turn)
    scene = adjust_reflections(scene, index, config.strength, config.tint)
    if any(config.warp_offset) or config.warp_gain != 1:
        pivot = config.warp_pivot or named_view(run.capture, None).camera.center
        offset = np.array(config.warp_offset)
        scene = decouple_reflections(scene, index, offset, config.warp_gain, np.array(pivot), config.warp_strength)
    _write(run, scene, config.out)


def clone(config: CloneConfig) -> None:
    """Write OUT, a run with a copy of a reflector.

    Raises:
        UserError: no such run or reflector, a scale that is not positive, an empty box, or a model that cannot be seen
            in resting surroundings.
    """
    from scipy.spatial.transform import Rotation

    run = _open(config.run, config.out, config.device)
    if config.scale <= 0:
        raise UserError(f"Scale {config.scale:g}.", "more than 0", "correct --scale")
    index = reflector_index(run.scene, config.reflector)
    rotation = Rotation.from_rotvec(np.radians(config.turn)).as_matrix()
    box = None if config.box is None else np.array(config.box).reshape(2, 3)
    resting = config.surroundings == "resting"
    _write(
        run,
        clone_reflector(run.scene, index, np.array(config.shift), rotation, config.scale, box, resting),
        config.out,
    )


def _open(folder: Path, out: Path, device: str) -> Run:
    if (Path(out) / "scene.safetensors").exists():
        raise UserError(f"{out} already holds a run.", "a new folder", "choose another one, or remove it")
    return open_run(folder, None, device)


def _write(run: Run, scene: Scene, out: Path) -> None:
    scene.save(Path(out) / "scene.safetensors")
    write_json(Path(out) / "config.json", run.config | {"run": str(Path(out).resolve())})
    print(f"edited: {out}; look at it with `catacaustics view` or film it with `catacaustics render`")
