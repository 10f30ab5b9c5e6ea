"""Rigid and similarity transforms. A transform named `b_from_a` takes coordinates in a to coordinates in b."""

from typing import NamedTuple

import numpy as np

from catacaustics.shapes import Float


class Similarity(NamedTuple):
    """x_b = scale * rotation @ x_a + translation."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        return self.scale * points @ self.rotation.T + self.translation


def normalize(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Unit vectors; a zero vector stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def rigid(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """The 4x4 matrix of x -> rotation @ x + translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def rigid_inverse(b_from_a: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    rotation = b_from_a[:3, :3].T
    return rigid(rotation, -rotation @ b_from_a[:3, 3])


def transform(b_from_a: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return points @ b_from_a[:3, :3].T + b_from_a[:3, 3]


def look_at(
    eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """camera_from_world (OpenCV axes: x right, y down, z forward) of a camera at `eye` that looks at `target`.

    Raises:
        ValueError: `up` is parallel to the line of sight, or eye and target coincide.
    """
    forward = normalize(target - eye)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-9 * max(np.linalg.norm(up), 1e-300):
        raise ValueError(f"look_at needs eye, target and up in general position, got {eye}, {target}, {up}")
    right = normalize(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rigid(rotation, -rotation @ eye)


def rotation_angle(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    """Angle of a rotation in radians, accurate near 0 too: |R - I|_F = 2 sqrt(2) sin(angle / 2)."""
    half_sine = np.linalg.norm(rotation - np.eye(3), axis=(-2, -1)) / (2 * np.sqrt(2))
    return 2 * np.arcsin(np.clip(half_sine, 0, 1))


def fit_similarity(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> Similarity:
    """Least-squares similarity target_from_source (Umeyama, PAMI 1991).

    Raises:
        ValueError: fewer than 3 points, or all on one line: the rotation is not determined.
    """
    if len(source) < 3 or len(source) != len(target):
        raise ValueError(f"fit_similarity needs 3 or more matched points, got {len(source)} and {len(target)}")
    source_mean, target_mean = source.mean(0), target.mean(0)
    a, b = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd(b.T @ a / len(a))
    if singular[1] < 1e-12 * singular[0]:
        raise ValueError("fit_similarity needs points that are not all on one line")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((singular * sign).sum() / (a**2).sum(1).mean())
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)
