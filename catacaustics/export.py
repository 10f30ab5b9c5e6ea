"""A scene for other programs: clouds, 3D Gaussians and meshes as PLY, cameras as COLMAP and transforms.json."""

import os
import shutil
from pathlib import Path

import numpy as np
import torch

from catacaustics.cameras import Camera
from catacaustics.capture.colmap import read_model, write_model
from catacaustics.capture.dataset import Capture
from catacaustics.config import ExportConfig
from catacaustics.files import atomic_path, write_json
from catacaustics.geometry import hull_mesh, rigid_inverse
from catacaustics.points import PointCloud, write_mesh, write_ply, write_tables
from catacaustics.reflectors.revolution import Revolution, profile
from catacaustics.reflectors.volume import ReflectionVolume
from catacaustics.reflectors.warps import Mirror, QuadricWarp, RevolutionWarp, mirror_of
from catacaustics.run import named_view, open_run
from catacaustics.scene import PointParameters, Scene
from catacaustics.shapes import Float, Int

_SH_0 = 0.5 / np.sqrt(np.pi)
"""The constant spherical harmonic."""
_FLAT = 1e-3
"""Thickness of a disk as a Gaussian, as a share of its radius: 3D Gaussians cannot be flat."""


def point_colors(
    scene: Scene, cloud: PointParameters, eye: Float[np.ndarray, "3"], rows: Int[torch.Tensor, "n"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Colours in [0, 1] of a cloud's points, or of some rows of it, as seen from `eye`, each decoded as if it were all
    that a pixel shows."""
    colors, primary = [], cloud.rho_logits is not None
    chosen = torch.arange(len(cloud), device=scene.device) if rows is None else rows
    with torch.no_grad():
        for rows in chosen.split(1 << 16):
            features = cloud.features[rows][None]
            away = cloud.positions[rows] - torch.tensor(eye).to(cloud.positions)
            away, nothing = torch.nn.functional.normalize(away, dim=1)[None], torch.zeros_like(features)
            parts = (features, nothing) if primary else (nothing, features)
            colors.append(scene.renderer(*parts, away)[0].clamp(0, 1))
    return torch.cat(colors).float().cpu().numpy()


def point_cloud(scene: Scene, cloud: PointParameters, eye: Float[np.ndarray, "3"]) -> PointCloud:
    """A cloud with its colours as seen from `eye`. Reflection points are where they are kept: of the plane and of
    quadrics at the world position of what is mirrored, without normals (zero)."""
    primary = cloud.rho_logits is not None
    with torch.no_grad():
        normals = torch.nn.functional.normalize(cloud.normals, dim=1) if primary else torch.zeros_like(cloud.normals)
        arrays = (cloud.positions.float().cpu().numpy(), normals.float().cpu().numpy())
    return PointCloud(*arrays, point_colors(scene, cloud, eye))


def write_gaussians(path: Path, scene: Scene, eye: Float[np.ndarray, "3"]) -> None:
    """Write the primary cloud as 3D Gaussians, in the format of Kerbl et al. (2023) that common viewers open.

    Numbers are stored before their activations: opacity as logit, scales as logarithms of standard deviations,
    rotations as quaternions (w, x, y, z), colours as the constant spherical harmonic, (rgb - 1/2) / 0.2821. Disks are
    Gaussians whose third axis, along the normal, is thin. View-dependent colour is left out: colours are those seen
    from `eye`; reflections, which no Gaussian at a fixed place can show, are left out too.
    """
    from scipy.spatial.transform import Rotation

    cloud = point_cloud(scene, scene.primary, eye)
    with torch.no_grad():
        log_radii = 0.5 * scene.primary.log_footprints.float().cpu().numpy()
        logits = scene.primary.opacity_logits.float().cpu().numpy().clip(-30, 30)
    quaternions = Rotation.from_matrix(_frames(cloud.normals)).as_quat()
    colors = (cloud.colors - 0.5) / _SH_0
    columns = dict(zip(("x", "y", "z"), cloud.positions.T, strict=True))
    columns |= dict(zip(("nx", "ny", "nz"), cloud.normals.T, strict=True))
    columns |= {f"f_dc_{i}": colors[:, i] for i in range(3)} | {"opacity": logits}
    columns |= {"scale_0": log_radii, "scale_1": log_radii, "scale_2": log_radii + np.log(_FLAT)}
    columns |= {f"rot_{i}": quaternions[:, j] for i, j in enumerate((3, 0, 1, 2))}
    table = np.empty(len(cloud), [(name, "f4") for name in columns])
    for name, values in columns.items():
        table[name] = values
    write_tables(path, vertex=table)


def _frames(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotations whose third column is the normal."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(helper, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], -1)


def sphere_mesh(subdivisions: int = 4) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """An icosahedron whose triangles are halved `subdivisions` times, on the unit sphere."""
    golden = (1 + 5**0.5) / 2
    corners = [(0, s, t * golden) for s in (-1, 1) for t in (-1, 1)]
    points = np.array([np.roll(c, k) for k in range(3) for c in corners], float)
    vertices, faces = hull_mesh(points / np.linalg.norm(points, axis=1, keepdims=True))
    for _ in range(subdivisions):
        edges = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]], -1)
        pairs, place = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
        middles = vertices[pairs].mean(1)
        a, b, c = (len(vertices) + place.reshape(-1, 3)).T
        i, j, k = faces.T
        faces = np.concatenate([np.stack(t, -1) for t in ((i, c, b), (c, j, a), (b, a, k), (a, b, c))])
        vertices = np.concatenate([vertices, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
    return vertices, faces


def _turned_mesh(
    surface: Revolution, rings: int = 65, sides: int = 64
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    z = torch.linspace(float(surface.ends[0]), float(surface.ends[1]), rings).to(surface.ends)
    radius = profile(surface, z)[0].clamp_min(0).sqrt()[:, None]
    angle = 2 * torch.pi * torch.arange(sides) / sides
    local = [radius * angle.cos().to(z), radius * angle.sin().to(z), z[:, None].expand(-1, sides)]
    vertices = surface.center + torch.stack(local, -1).reshape(-1, 3) @ surface.frame.T
    ring, side = np.meshgrid(np.arange(rings - 1) * sides, np.arange(sides), indexing="ij")
    a, b = (ring + side).ravel(), (ring + (side + 1) % sides).ravel()
    faces = np.concatenate([np.stack([a, b, b + sides], 1), np.stack([a, b + sides, a + sides], 1)])
    return vertices.cpu().numpy().astype(np.float64), faces


def mirror_mesh(mirror: Mirror, volume: ReflectionVolume) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """The surface of a fitted mirror as triangles: a whole ellipsoid, a surface of revolution between its ends, or the
    plane's part inside the volume (where it misses the volume, the volume's shadow on it)."""
    with torch.no_grad():
        if isinstance(mirror, RevolutionWarp):
            return _turned_mesh(mirror.surface())
        if isinstance(mirror, QuadricWarp):
            center, axes = (t.cpu().numpy().astype(np.float64) for t in mirror.shape())
            vertices, faces = sphere_mesh()
            return center + vertices @ axes.T, faces if np.linalg.det(axes) > 0 else faces[:, ::-1]
        normal, distance = (t.cpu().numpy().astype(np.float64) for t in mirror.plane())
    edges = np.unique(np.sort(volume.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    heights = volume.vertices @ normal - distance
    a, b = edges[heights[edges[:, 0]] * heights[edges[:, 1]] < 0].T
    part = (heights[a] / (heights[a] - heights[b]))[:, None]
    corners = volume.vertices[a] + part * (volume.vertices[b] - volume.vertices[a])
    if len(corners) < 3:
        corners = volume.vertices - heights[:, None] * normal
    # In order around their middle, seen from the front.
    middle = corners.mean(0)
    frame = _frames(normal[None])[0]
    flat = (corners - middle) @ frame[:, :2]
    from scipy.spatial import ConvexHull

    outline = corners[ConvexHull(flat).vertices]
    last = np.arange(2, len(outline))
    return outline, np.stack([0 * last, last - 1, last], -1)


def write_transforms(path: Path, capture: Capture, images: Path) -> None:
    """Write the cameras as transforms.json of nerfstudio: world_from_camera with OpenGL's axes, intrinsics by frame.

    Args:
        images: the folder of the photographs, to which the file refers by a relative path.
    """
    folder = os.path.relpath(Path(images).resolve(), Path(path).parent.resolve())
    frames = [
        {"file_path": f"{Path(folder).as_posix()}/{view.name}"}
        | _intrinsics(view.camera)
        | {"transform_matrix": (rigid_inverse(view.camera.camera_from_world) @ np.diag([1.0, -1, -1, 1])).tolist()}
        for view in capture.views
    ]
    names = {"train_filenames": capture.train, "val_filenames": capture.held_out, "test_filenames": capture.held_out}
    split = {key: [f"{Path(folder).as_posix()}/{view.name}" for view in views] for key, views in names.items()}
    write_json(path, {"camera_model": "PINHOLE", **split, "frames": frames})


def _intrinsics(camera: Camera) -> dict[str, float]:
    sizes = {"w": camera.width, "h": camera.height}
    return {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy} | sizes


def export(config: ExportConfig) -> None:
    """Write OUT/primary.ply, reflection_NAME.ply, gaussians.ply, volume_NAME.ply, mirror_NAME.ply, transforms.json and
    sparse/0.

    Raises:
        UserError: no such run, capture or view, or OUT cannot be written.
    """
    run = open_run(config.run, config.capture, config.device)
    scene, capture, out = run.scene, run.capture, Path(config.out)
    view = named_view(capture, config.view)
    eye = view.camera.center
    written = ["primary.ply", "gaussians.ply"]
    write_ply(out / "primary.ply", point_cloud(scene, scene.primary, eye))
    write_gaussians(out / "gaussians.ply", scene, eye)
    clouds = [cloud for cloud in scene.reflections if isinstance(cloud, PointParameters)]
    for volume, cloud, warp in zip(scene.volumes, clouds, scene.warps, strict=True):
        write_ply(out / f"reflection_{volume.name}.ply", point_cloud(scene, cloud, eye))
        volume.write_mesh(out / f"volume_{volume.name}.ply")
        written += [f"reflection_{volume.name}.ply", f"volume_{volume.name}.ply"]
        mirror = mirror_of(warp)
        if mirror is not None:
            write_mesh(out / f"mirror_{volume.name}.ply", *mirror_mesh(mirror, volume))
            written.append(f"mirror_{volume.name}.ply")
    images = capture.root / "images"
    if config.photographs:
        for one in capture.views:
            with atomic_path(out / "images" / one.name) as temporary:
                shutil.copyfile(images / one.name, temporary)
        images = out / "images"
    write_transforms(out / "transforms.json", capture, images)
    sparse = read_model(capture.root / "sparse" / "0")
    write_model(out / "sparse" / "0", [(v.name, v.camera) for v in capture.views], sparse.points, sparse.colors)
    written += ["transforms.json", "sparse/0"]
    print(f"exported to {out}, colours as seen from {view.name}: {', '.join(written)}")
