"""Frames as tensors: what the networks take in and what they are compared with."""

from collections import OrderedDict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from catacaustics.refraction.frames import Frame, Frames
from catacaustics.refraction.lookup import Screen
from catacaustics.shapes import Bool, Float, Int


class Buffers(NamedTuple):
    """Frames, channels first; k is the largest number of transparent objects, at least 1, missing ones are all zero."""

    reference: Float[Tensor, "b 3 h w"]
    position: Float[Tensor, "b 3 h w"]
    normal: Float[Tensor, "b 3 h w"]
    albedo: Float[Tensor, "b 3 h w"]
    direct: Float[Tensor, "b 3 h w"]
    depth: Float[Tensor, "b 1 h w"]
    rays: Float[Tensor, "b 3 h w"]
    """Unit directions of the pixels' rays, from the camera."""
    objects: Float[Tensor, "b k 9 h w"]
    """Mask, position, normal, depth and index of refraction, all zero where the object is not seen."""
    refractive: Bool[Tensor, "b 1 h w"]
    internal_reflection: Bool[Tensor, "b 1 h w"]
    landing: Float[Tensor, "b 3 h w"]
    landing_uv: Float[Tensor, "b 2 h w"]
    landing_normal: Float[Tensor, "b 3 h w"]
    landing_object: Int[Tensor, "b h w"]
    poses: Float[Tensor, "b k 17"]
    """How each object stands, zero where it is nowhere seen in the whole image: rotation body to world (9, by rows),
    place (3), size, index of refraction, mean normal of its seen part (3)."""
    bodies: Int[Tensor, "b k"]
    """Which of the scene's transparent bodies each object is, in the order of `Frame.object_mask`; -1 for none."""
    world_to_clip: Float[Tensor, "b 4 4"]

    @property
    def covered(self) -> Bool[Tensor, "b 1 h w"]:
        """Pixels where a transparent object is nearest, by depth: known without tracing a path."""
        front = self.objects[:, :, 7] < self.depth
        return ((self.objects[:, :, 0] > 0) & front).any(1, keepdim=True)

    def crop(self, y: int, x: int, side: int) -> "Buffers":
        """A square part of the images."""
        window = (..., slice(y, y + side), slice(x, x + side))
        return Buffers._make([*(value[window] for value in self[:-3]), *self[-3:]])

    def to(self, device: torch.device | str) -> "Buffers":
        return Buffers(*(value.to(device) for value in self))


def frame_buffers(frame: Frame) -> Buffers:
    """One frame, b = 1."""

    def image(values: np.ndarray) -> Tensor:
        planes = values[..., None] if values.ndim == 2 else values
        return torch.from_numpy(np.ascontiguousarray(np.moveaxis(planes, -1, 0)))[None]

    mask = frame.object_mask[..., None].astype(np.float32)
    ior = frame.object_ior[:, None, None, None] * mask
    parts = [mask, frame.object_position, frame.object_normal, frame.object_depth[..., None], ior]
    objects = np.concatenate(parts, -1, dtype=np.float32) * mask
    if not len(objects):
        objects = np.zeros((1, *objects.shape[1:]), np.float32)
    return Buffers(
        reference=image(frame.reference),
        position=image(frame.position),
        normal=image(frame.normal),
        albedo=image(frame.albedo),
        direct=image(frame.direct),
        depth=image(frame.depth),
        rays=image(_rays(frame)),
        objects=torch.from_numpy(np.moveaxis(objects, -1, 1).copy())[None],
        refractive=image(frame.refractive),
        internal_reflection=image(frame.internal_reflection),
        landing=image(frame.landing),
        landing_uv=image(frame.landing_uv),
        landing_normal=image(frame.landing_normal),
        landing_object=torch.from_numpy(frame.landing_object.astype(np.int64))[None],
        poses=torch.from_numpy(_poses(frame, objects))[None],
        bodies=torch.arange(len(objects))[None] if len(frame.object_mask) else torch.full((1, 1), -1),
        world_to_clip=torch.from_numpy(frame.world_to_clip)[None],
    )


def _poses(frame: Frame, objects: Float[np.ndarray, "k h w 9"]) -> Float[np.ndarray, "k 17"]:
    """`Buffers.poses` of one frame."""
    poses = np.zeros((len(objects), 17), np.float32)
    for pose, image, ior, matrix in zip(poses, objects, frame.object_ior, frame.object_to_world, strict=False):
        if image[..., 0].any():
            size = np.linalg.norm(matrix[:, 0])
            normal = image[..., 4:7].sum((0, 1)) / image[..., 0].sum()
            pose[:] = np.concatenate([(matrix[:, :3] / size).ravel(), matrix[:, 3], [size, ior], normal])
    return poses


def frame_screen(frame: Frame) -> Screen:
    """The screen-space buffers of one frame, b = 1."""
    color = torch.from_numpy(frame.screen).movedim(-1, 0)[None].float() / 255
    probe = torch.from_numpy(frame.probe).movedim(-1, 0)[None].float() / 255
    return Screen(
        color, torch.from_numpy(frame.screen_depth)[None, None], probe, torch.from_numpy(frame.probe_position)[None]
    )


def _rays(frame: Frame) -> Float[np.ndarray, "h w 3"]:
    """Unit directions through the pixel centres."""
    height, width = frame.depth.shape
    x = (np.arange(width) + 0.5) / width * 2 - 1
    y = 1 - (np.arange(height) + 0.5) / height * 2
    ndc = np.stack([*np.meshgrid(x, y), np.full((height, width), 0.5), np.ones((height, width))], -1)
    world = ndc @ np.linalg.inv(frame.world_to_clip.astype(np.float64)).T
    rays = world[..., :3] / world[..., 3:] - frame.camera_position
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return rays.astype(np.float32)


def stack(parts: Sequence[Buffers]) -> Buffers:
    """Join along b; frames with fewer transparent objects get objects that are nowhere seen."""
    most = max(part.objects.shape[1] for part in parts)
    more = [most - part.objects.shape[1] for part in parts]
    parts = [
        p._replace(
            objects=pad(p.objects, (0, 0) * 3 + (0, n)),
            poses=pad(p.poses, (0, 0, 0, n)),
            bodies=pad(p.bodies, (0, n), value=-1),
        )
        for p, n in zip(parts, more, strict=True)
    ]
    return Buffers(*(torch.cat(values) for values in zip(*parts, strict=True)))


class BufferCache:
    """Buffers of the frames of some splits, kept up to a number of bytes; what was not used for longest goes first.

    Frames are numbered through, first those of the first split.
    """

    def __init__(self, splits: Sequence[Frames], most_bytes: float):
        self.splits, self.most = splits, most_bytes
        self.kept: OrderedDict[int, Buffers] = OrderedDict()
        self.bytes = 0

    def frame(self, index: int) -> Frame:
        """Read a frame."""
        for split in self.splits:
            if index < len(split):
                return split[index]
            index -= len(split)
        raise IndexError(f"{index} frames too far")

    def get(self, index: int) -> Buffers:
        """Buffers of one frame, b = 1."""
        if index in self.kept:
            self.kept.move_to_end(index)
            return self.kept[index]
        buffers = self.kept[index] = frame_buffers(self.frame(index))
        self.bytes += _size(buffers)
        while self.bytes > self.most and len(self.kept) > 1:
            self.bytes -= _size(self.kept.popitem(last=False)[1])
        return buffers

    def fill(self) -> None:
        """Read frames in order, as many as are kept, so that no training time is spent on it."""
        for index in range(sum(map(len, self.splits))):
            size = _size(self.get(index))
            if self.bytes + size > self.most:
                break


def _size(buffers: Buffers) -> int:
    return sum(value.numel() * value.element_size() for value in buffers)
