"""Oriented, coloured point clouds and their PLY files."""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catacaustics.errors import UserError
from catacaustics.files import write_bytes
from catacaustics.shapes import Float, Int


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points as float32 arrays: positions, unit normals, RGB colours in [0, 1]."""

    positions: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    colors: Float[np.ndarray, "n 3"]

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, index: np.ndarray) -> "PointCloud":
        """The points chosen by a boolean mask or an index array."""
        return PointCloud(self.positions[index], self.normals[index], self.colors[index])

    def joined(self, other: "PointCloud") -> "PointCloud":
        """The points of both clouds."""
        pairs = ((self.positions, other.positions), (self.normals, other.normals), (self.colors, other.colors))
        return PointCloud(*(np.concatenate(pair) for pair in pairs))


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write binary PLY with x y z nx ny nz (float32) and red green blue (8 bits)."""
    types = [(name, "f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(n, "u1") for n in ("red", "green", "blue")]
    table = np.empty(len(cloud), types)
    for i, axis in enumerate("xyz"):
        table[axis], table["n" + axis] = cloud.positions[:, i], cloud.normals[:, i]
    for i, channel in enumerate(("red", "green", "blue")):
        table[channel] = np.clip(cloud.colors[:, i], 0, 1) * 255 + 0.5
    write_tables(path, vertex=table)


def write_mesh(path: Path, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
    """Write a triangle mesh as binary PLY."""
    corners = np.empty(len(vertices), [(axis, "f4") for axis in "xyz"])
    for i, axis in enumerate("xyz"):
        corners[axis] = vertices[:, i]
    triangles = np.empty(len(faces), [("vertex_indices", "i4", (3,))])
    triangles["vertex_indices"] = faces
    write_tables(path, vertex=corners, face=triangles)


def write_tables(path: Path, **elements: np.ndarray) -> None:
    """Write a binary PLY file of structured arrays, one an element."""
    from plyfile import PlyData, PlyElement

    buffer = io.BytesIO()
    PlyData([PlyElement.describe(table, name) for name, table in elements.items()]).write(buffer)
    write_bytes(path, buffer.getvalue())


def read_ply(path: Path) -> PointCloud:
    """Read a PLY point cloud with normals; colours default to mid-gray.

    Raises:
        UserError: the file is missing, is not a complete PLY, or lacks positions or normals.
    """
    from plyfile import PlyData, PlyParseError

    try:
        table = PlyData.read(path)["vertex"]
        names = {p.name for p in table.properties}
    except FileNotFoundError as error:
        raise UserError(f"There is no point cloud {path}.", "a PLY file", "run `catacaustics calibrate`") from error
    except (PlyParseError, KeyError, ValueError, UnicodeDecodeError) as error:
        raise UserError(
            f"{path} is not a complete PLY point cloud: {error}.",
            "a PLY file with a vertex element",
            "delete it and run `catacaustics calibrate` again; finished stages are kept",
        ) from error
    missing = {"x", "y", "z", "nx", "ny", "nz"} - names
    if missing:
        raise UserError(
            f"{path} has no properties {', '.join(sorted(missing))}.",
            "positions x y z and normals nx ny nz",
            "export the cloud with normals, or let `catacaustics calibrate` make it",
        )
    positions = np.stack([table[a] for a in "xyz"], -1).astype(np.float32)
    normals = np.stack([table["n" + a] for a in "xyz"], -1).astype(np.float32)
    if {"red", "green", "blue"} <= names:
        channels = np.stack([table[c] for c in ("red", "green", "blue")], -1)
        colors = (channels / 255).astype(np.float32) if channels.dtype == np.uint8 else channels.astype(np.float32)
    else:
        colors = np.full_like(positions, 0.5)
    return PointCloud(positions, normals, colors)
