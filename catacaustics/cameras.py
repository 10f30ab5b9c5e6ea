"""Cameras, viewports and camera paths: the one place for conventions.

- OpenCV axes: x right, y down, z forward. `camera_from_world` takes world coordinates to camera coordinates.
- Pixel centres at +0.5: the top-left pixel's centre is (0.5, 0.5), as in COLMAP. An image is (height, width, channels).
- A view is rendered into a viewport of its camera, so that a training patch costs what its pixels cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from catacaustics.geometry import normalize, rigid, rigid_inverse, rotation_angle, transform
from catacaustics.shapes import Float


class Viewport(NamedTuple):
    """A rectangle of pixels: columns x0 to x0 + width, rows y0 to y0 + height. It may reach outside the image."""

    x0: int
    y0: int
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Args:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels, (0, 0) being the top-left corner of the top-left pixel.
        camera_from_world: 4x4 rigid transform, float64.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_world: Float[np.ndarray, "4 4"]

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Camera centre in world coordinates."""
        return rigid_inverse(self.camera_from_world)[:3, 3]

    @property
    def viewport(self) -> Viewport:
        """The whole image."""
        return Viewport(0, 0, self.width, self.height)

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def resized(self, width: int, height: int) -> "Camera":
        """The same view with another number of pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def displaced(self, offset: Float[np.ndarray, "3"]) -> "Camera":
        """The camera displaced along its own axes (right, down, forward; world units). As a warp camera it moves
        reflections and nothing else."""
        pose = self.camera_from_world.copy()
        pose[:3, 3] -= offset
        return replace(self, camera_from_world=pose)

    def project(self, points: Float[np.ndarray, "*n 3"]) -> tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray, "*n"]]:
        """Pixel coordinates (x, y) and depth z of world points. Points with z <= 0 are behind the camera: check z."""
        p = transform(self.camera_from_world, points)
        z = p[..., 2]
        safe = np.where(np.abs(z) > 1e-12, z, 1e-12)
        pixels = np.stack([self.fx * p[..., 0] / safe + self.cx, self.fy * p[..., 1] / safe + self.cy], -1)
        return pixels, z

    def ray_directions(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """World directions through pixel coordinates, scaled so that depth z = 1: point = center + z * direction."""
        local = np.stack(
            [
                (pixels[..., 0] - self.cx) / self.fx,
                (pixels[..., 1] - self.cy) / self.fy,
                np.ones(pixels.shape[:-1]),
            ],
            -1,
        )
        return local @ self.camera_from_world[:3, :3]

    def unproject(self, pixels: Float[np.ndarray, "*n 2"], depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
        """World points at depth z along the rays through pixel coordinates."""
        return self.center + self.ray_directions(pixels) * depth[..., None]


def up_direction(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """Up in the world as photographers hold cameras: the mean of the cameras' own."""
    return normalize(-np.mean([c.camera_from_world[1, :3] for c in cameras], axis=0))


def pixel_centers(viewport: Viewport) -> Float[np.ndarray, "height width 2"]:
    """Coordinates (x, y) of the centres of a viewport's pixels."""
    x = np.arange(viewport.x0, viewport.x0 + viewport.width) + 0.5
    y = np.arange(viewport.y0, viewport.y0 + viewport.height) + 0.5
    return np.stack(np.meshgrid(x, y), -1)


def interpolate_path(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A smooth path through the poses of key cameras at even speed.

    Splines of centres (natural cubic) and of rotations over the keys' distances, walked in equal steps. A distance
    counts translation in units of the keys' mean step and rotation in units of 30 degrees, so a path that only turns
    advances too. Keys that coincide with the one before are passed once.

    Args:
        cameras: key cameras in order; intrinsics and size of all returned cameras are the first one's.
        frames: number of cameras returned; the first and last have the poses of the first and last key.

    Raises:
        ValueError: fewer than two keys or frames.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    if len(cameras) < 2 or frames < 2:
        raise ValueError(f"interpolate_path needs 2 or more cameras and frames, got {len(cameras)} and {frames}")
    centers = np.array([c.center for c in cameras])
    matrices = np.array([c.camera_from_world[:3, :3].T for c in cameras])
    scale = max(np.linalg.norm(np.diff(centers, axis=0), axis=1).mean(), 1e-12)
    steps = _pose_steps(centers, matrices, scale)
    keep = np.concatenate([[True], steps > 1e-4])
    if keep.sum() < 2:
        return [cameras[0]] * frames
    time = np.concatenate([[0], np.cumsum(steps[keep[1:]])])
    center_spline = CubicSpline(time, centers[keep], bc_type="natural")
    rotation_spline = RotationSpline(time, Rotation.from_matrix(matrices[keep]))
    # Even speed: measure the way along the splines and invert it.
    dense = np.linspace(0, time[-1], 32 * (frames + len(time)))
    steps = _pose_steps(center_spline(dense), rotation_spline(dense).as_matrix(), scale)
    way = np.concatenate([[0], np.cumsum(steps)])
    samples = np.interp(np.linspace(0, way[-1], frames), way, dense)
    return [
        replace(cameras[0], camera_from_world=rigid(r.T, -r.T @ c))
        for r, c in zip(rotation_spline(samples).as_matrix(), center_spline(samples), strict=True)
    ]


def _pose_steps(
    centers: Float[np.ndarray, "n 3"], world_from_camera: Float[np.ndarray, "n 3 3"], scale: float
) -> Float[np.ndarray, "n_minus_1"]:
    """Distances between successive poses: translation over `scale`, and rotation over 30 degrees."""
    turns = rotation_angle(world_from_camera[:-1].swapaxes(-1, -2) @ world_from_camera[1:])
    return np.hypot(np.linalg.norm(np.diff(centers, axis=0), axis=1) / scale, turns / np.radians(30))
