"""Edits: pure functions from a scene to a scene, and the commands that apply them to runs."""

import copy
from pathlib import Path

import numpy as np
import torch
from torch import nn

from catacaustics.config import CloneConfig, EditConfig
from catacaustics.environment import texels
from catacaustics.errors import UserError
from catacaustics.files import write_json
from catacaustics.images import read_image
from catacaustics.reflectors.warps import MovedWarp, NeuralWarp, StaticWarp
from catacaustics.run import Run, open_run
from catacaustics.scene import PointParameters, Scene
from catacaustics.shapes import Float

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
    scene: Scene, index: int, shift: Float[np.ndarray, "3"], rotation: Float[np.ndarray, "3 3"], scale: float = 1.0
) -> Scene:
    """A second copy of a reflector: its primary points (those in its volume), its cloud, warp and volume.

    The copy is at x_new = c + scale * rotation (x - c) + shift, c the volume's centre. It mirrors what the original
    mirrors, as if its surroundings had moved along: right for small moves and far surroundings. What both would see of
    each other is not there.
    """
    edited = copy.deepcopy(scene)
    volume = scene.volumes[index]
    offset = volume.center + shift - scale * rotation @ volume.center
    turn, move = (torch.from_numpy(np.asarray(a, np.float32)).to(scene.device) for a in (rotation, offset))
    inside = volume.scaled(1.03).contains(scene.primary.positions.detach().cpu().numpy().astype(np.float64))
    rows = torch.from_numpy(np.flatnonzero(inside)).to(scene.device)
    primary = edited.primary
    with torch.no_grad():
        columns = {name: parameter[rows].clone() for name, parameter in primary.named_parameters()}
        columns["positions"] = scale * columns["positions"] @ turn.T + move
        columns["normals"] = columns["normals"] @ turn.T
        columns["log_footprints"] += 2 * np.log(scale)
        for name, parameter in list(primary.named_parameters()):
            setattr(primary, name, nn.Parameter(torch.cat([parameter, columns[name]])))
    edited.reflections.append(copy.deepcopy(scene.reflections[index]))
    edited.warps.append(MovedWarp(copy.deepcopy(scene.warps[index]), scale, turn, move))
    edited.volumes = [*edited.volumes, volume.moved(scale, rotation, offset, f"{volume.name} copy")]
    return edited


def adjust_reflections(
    scene: Scene, index: int, strength: float = 1.0, tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Scene:
    """Dim (strength below 1), strengthen or tint a reflector's reflections; strength 0 erases them, and its surface
    shows what was learned of it."""
    edited = copy.deepcopy(scene)
    cloud: PointParameters = edited.reflections[index]  # pyright: ignore[reportAssignmentType]
    with torch.no_grad():
        if strength == 0:
            cloud.opacity_logits.fill_(_HIDDEN)
        else:
            cloud.features *= strength
            cloud.features[:, :3] *= torch.tensor(tint, device=scene.device)
    return edited


def replace_surroundings(scene: Scene, index: int, panorama: Float[np.ndarray, "height width 3"]) -> Scene:
    """Let a reflector mirror another place: its points take the colours of a latitude-longitude image around it (y is
    up at the top row, as in environment.py), looked up in the direction of what they mirror.

    Raises:
        UserError: the model does not keep world positions of what is mirrored.
    """
    warp = scene.warps[index]
    inner = warp.warp if isinstance(warp, MovedWarp) else warp
    if isinstance(inner, NeuralWarp | StaticWarp):
        raise UserError(
            f"The reflections of {scene.volumes[index].name} do not know what they mirror ({type(inner).__name__}).",
            "a plane, sphere, ellipsoid, concave or quadric+neural model",
            "train with one of these models",
        )
    edited = copy.deepcopy(scene)
    cloud: PointParameters = edited.reflections[index]  # pyright: ignore[reportAssignmentType]
    with torch.no_grad():
        center = torch.from_numpy(scene.volumes[index].center).to(cloud.positions)
        directions = torch.nn.functional.normalize(cloud.positions - center, dim=1)
        colors = torch.from_numpy(np.ascontiguousarray(panorama, np.float32)).to(scene.device)
        cloud.features.zero_()
        cloud.features[:, :3] = colors[texels(directions, *panorama.shape[:2])]
    return edited


def edit(config: EditConfig) -> None:
    """Write OUT, a run with adjusted reflections.

    Raises:
        UserError: no such run or reflector, a strength below 0, or surroundings that the model cannot replace.
    """
    run = _open(config.run, config.out, config.device)
    index = reflector_index(run.scene, config.reflector)
    if config.strength < 0 or min(config.tint) < 0:
        raise UserError(
            f"Strength {config.strength:g}, tint {config.tint}.", "0 or more", "correct --strength or --tint"
        )
    scene = run.scene
    if config.surroundings is not None:
        scene = replace_surroundings(scene, index, read_image(config.surroundings))
    _write(run, adjust_reflections(scene, index, config.strength, config.tint), config.out)


def clone(config: CloneConfig) -> None:
    """Write OUT, a run with a copy of a reflector.

    Raises:
        UserError: no such run or reflector, or a scale that is not positive.
    """
    from scipy.spatial.transform import Rotation

    run = _open(config.run, config.out, config.device)
    if config.scale <= 0:
        raise UserError(f"Scale {config.scale:g}.", "more than 0", "correct --scale")
    index = reflector_index(run.scene, config.reflector)
    rotation = Rotation.from_rotvec(np.radians(config.turn)).as_matrix()
    _write(run, clone_reflector(run.scene, index, np.array(config.shift), rotation, config.scale), config.out)


def _open(folder: Path, out: Path, device: str) -> Run:
    if (Path(out) / "scene.safetensors").exists():
        raise UserError(f"{out} already holds a run.", "a new folder", "choose another one, or remove it")
    return open_run(folder, None, device)


def _write(run: Run, scene: Scene, out: Path) -> None:
    scene.save(Path(out) / "scene.safetensors")
    write_json(Path(out) / "config.json", run.config | {"run": str(Path(out).resolve())})
    print(f"edited: {out}; look at it with `catacaustics view` or film it with `catacaustics render`")
