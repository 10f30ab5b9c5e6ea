"""Exports, read back by other means than they were written by."""

import struct

import numpy as np
import pytest
import torch
from toy import BALL_CENTER, BALL_RADIUS, scene_of, write_run

from catacaustics import cli
from catacaustics.capture.colmap import read_model
from catacaustics.capture.importers import import_capture
from catacaustics.editing import clone_reflector
from catacaustics.export import mirror_mesh, point_colors, sphere_mesh, write_gaussians
from catacaustics.points import read_ply
from catacaustics.reflectors.revolution import Revolution
from catacaustics.reflectors.warps import PlaneWarp, QuadricWarp, RevolutionWarp, mirror_of
from catacaustics.splatting import splat_points


@pytest.fixture(scope="module")
def scene(capture):
    return scene_of(capture, "sphere")


@pytest.fixture(scope="module")
def exported(capture, scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("exported")
    run = write_run(folder / "run", capture, scene)
    assert cli.main(["export", str(run), str(folder / "out"), "--photographs"]) == 0
    return folder / "out"


def floats_of_ply(path) -> dict[str, np.ndarray]:
    """A PLY file of one element of float32 properties, byte by byte."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(next(line for line in lines if line.startswith("element")).split()[2])
    names = [line.split()[2] for line in lines if line.startswith("property")]
    assert {line.split()[1] for line in lines if line.startswith("property")} == {"float"}
    size = 4 * len(names)
    rows = [struct.unpack_from(f"<{len(names)}f", body, i * size) for i in range(count)]
    assert len(body) == count * size
    return {name: np.array(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}


def test_gaussians_have_the_fields_that_viewers_read_and_look_like_the_disks(exported, scene, capture):
    """Read byte by byte, activated as the format says, splatted by our splatter: the picture of the disks."""
    table = floats_of_ply(exported / "gaussians.ply")
    fields = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert list(table) == fields.split()
    positions = np.stack([table[a] for a in "xyz"], -1)
    colors = 0.5 + np.stack([table[f"f_dc_{i}"] for i in range(3)], -1) / (2 * np.sqrt(np.pi))
    opacities = 1 / (1 + np.exp(-table["opacity"]))
    scales = np.exp(np.stack([table[f"scale_{i}"] for i in range(3)], -1))
    w, x, y, z = (table[f"rot_{i}"] for i in range(4))
    np.testing.assert_allclose(w * w + x * x + y * y + z * z, 1, atol=1e-5)
    third = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)
    np.testing.assert_allclose(scales[:, 0], scales[:, 1])
    assert (scales[:, 2] < 0.01 * scales[:, 0]).all()
    cloud, camera = scene.primary, capture.held_out[0].camera.resized(160, 120)
    expected = point_colors(scene, cloud, capture.held_out[0].camera.center)
    arrays = (positions, third, scales[:, 0] ** 2, opacities, colors)
    with torch.no_grad():
        read = splat_points(*(torch.from_numpy(np.float32(a)) for a in arrays), camera)
        disks = (cloud.positions, torch.nn.functional.normalize(cloud.normals, dim=1), cloud.log_footprints.exp())
        own = splat_points(*disks, torch.sigmoid(cloud.opacity_logits), torch.from_numpy(expected), camera)
    torch.testing.assert_close(read.image, own.image, atol=2e-3, rtol=0)
    torch.testing.assert_close(read.transmittance, own.transmittance, atol=2e-3, rtol=0)
    assert float(own.image.std()) > 0.1


def test_colours_are_those_that_a_picture_of_one_point_would_show(scene, capture):
    """One opaque point that fills the picture shows its colour."""
    camera = capture.held_out[0].camera
    rows = torch.tensor([5, 77])
    colors = point_colors(scene, scene.primary, camera.center, rows)
    for row, color in zip(rows, colors, strict=True):
        features = scene.primary.features[row][None, None]
        away = scene.primary.positions[row] - torch.from_numpy(camera.center).float()
        with torch.no_grad():
            decoded = scene.renderer(features, 0 * features, torch.nn.functional.normalize(away, dim=0)[None, None])
        np.testing.assert_allclose(decoded[0, 0].clamp(0, 1).numpy(), color, atol=1e-5)


def test_clouds_come_back_where_they_were(exported, scene):
    for name, cloud in (("primary", scene.primary), ("reflection_ball", scene.reflections[0])):
        np.testing.assert_allclose(
            read_ply(exported / f"{name}.ply").positions, cloud.positions.detach().numpy(), atol=1e-6
        )


def test_cameras_come_back_from_colmap_by_pycolmap_and_by_ourselves(exported, capture):
    import pycolmap

    model, own = pycolmap.Reconstruction(exported / "sparse" / "0"), read_model(exported / "sparse" / "0")
    by_name = {image.name: image for image in model.images.values()}
    assert len(by_name) == len(own.images) == len(capture.views)
    for view in capture.views:
        pose = by_name[view.name].cam_from_world()
        np.testing.assert_allclose(pose.matrix(), view.camera.camera_from_world[:3], atol=1e-9)
        camera = by_name[view.name].camera
        np.testing.assert_allclose(camera.params, [view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy])


def test_cameras_come_back_from_transforms_json_by_our_importer(exported, capture, tmp_path):
    for source in (exported / "transforms.json", exported):
        again = import_capture(source, tmp_path / source.name)
        cameras = {view.name: view.camera for view in again.views}
        assert set(cameras) == {view.name for view in capture.views}
        for view in capture.views:
            found = cameras[view.name]
            np.testing.assert_allclose(found.camera_from_world, view.camera.camera_from_world, atol=1e-9)
            np.testing.assert_allclose(found.intrinsics, view.camera.intrinsics)


def test_without_copies_the_cameras_refer_to_the_captures_photographs(capture, scene, tmp_path):
    run = write_run(tmp_path / "run", capture, scene)
    assert cli.main(["export", str(run), str(tmp_path / "a" / "out")]) == 0
    assert not (tmp_path / "a" / "out" / "images").exists()
    assert len(import_capture(tmp_path / "a" / "out" / "transforms.json", tmp_path / "again").views) == 10


def enclosed(vertices, faces) -> float:
    """Volume by the divergence theorem; positive where faces run counter-clockwise seen from outside."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_a_sphere_of_triangles_is_closed_and_nearly_round():
    vertices, faces = sphere_mesh(4)
    edges = np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    assert len(vertices) - len(edges) + len(faces) == 2
    assert len(faces) == 20 * 4**4
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1)
    assert enclosed(vertices, faces) == pytest.approx(4 / 3 * np.pi, rel=5e-3)


def test_the_mesh_of_an_ellipsoid_lies_on_it_also_after_cloning(scene):
    axes = torch.tensor([[0.3, 0.1, 0.0], [0.0, 0.2, 0.0], [0.0, 0.05, 0.5]])
    mirror = QuadricWarp(torch.tensor([1.0, 2, 3]), axes, sphere=False)
    vertices, faces = mirror_mesh(mirror, scene.volumes[0])
    unit = (vertices - [1.0, 2, 3]) @ np.linalg.inv(axes.numpy()).T
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1, atol=1e-5)
    assert enclosed(vertices, faces) > 0
    shift = np.array([1.0, 0.5, 0])
    cloned = clone_reflector(scene, 0, shift, np.eye(3), 0.5)
    copy, _ = mirror_mesh(mirror_of(cloned.warps[1]), cloned.volumes[1])
    old, _ = mirror_mesh(mirror_of(scene.warps[0]), scene.volumes[0])
    center = scene.volumes[0].center
    np.testing.assert_allclose(copy, center + 0.5 * (old - center) + shift, atol=1e-5)


def test_the_mesh_of_a_turned_mirror_encloses_what_its_profile_does(scene):
    # A cone: q = (1 - z)^2 / 4 between z = -1 and its tip, by the polar form of a quadratic spline.
    cell, z = 2 / 5, -1 + 2 / 5 * (torch.arange(8) - 1)
    squared = (1 - 2 * z + z * z - cell**2 / 3) / 4
    center = torch.tensor([1.0, 2, 3])
    cone = Revolution(center, torch.eye(3), torch.ones(3), torch.tensor([-1.0, 1.0]), squared)
    vertices, faces = mirror_mesh(RevolutionWarp(cone), scene.volumes[0])
    local = vertices - center.numpy()
    np.testing.assert_allclose(np.linalg.norm(local[:, :2], axis=1), (1 - local[:, 2]) / 2, atol=1e-3)
    # Seen from the middle of the open bottom, which adds nothing.
    a, b, c = np.moveaxis(local[faces] - [0, 0, -1], 1, 0)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 == pytest.approx(2 / 3 * np.pi, rel=0.01)


def test_the_mesh_of_a_plane_is_its_part_in_the_volume(scene):
    volume, normal = scene.volumes[0], np.array([0.6, 0.0, 0.8])
    mirror = PlaneWarp(torch.tensor(BALL_CENTER).float(), torch.from_numpy(normal).float(), 1.0)
    vertices, faces = mirror_mesh(mirror, volume)
    np.testing.assert_allclose((vertices - BALL_CENTER) @ normal, 0, atol=1e-6)
    assert volume.scaled(1.0001).contains(vertices).all()
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    crosses = np.cross(b - a, c - a)
    assert (crosses @ normal > 0).all()
    assert np.linalg.norm(crosses, axis=1).sum() / 2 > np.pi * BALL_RADIUS**2  # the volume holds the ball
    away = PlaneWarp(torch.tensor(BALL_CENTER + normal).float(), torch.from_numpy(normal).float(), 1.0)
    assert len(mirror_mesh(away, volume)[1]) > 0


def test_bad_input_is_refused(capture, scene, tmp_path, capsys):
    run = write_run(tmp_path / "run", capture, scene)
    (tmp_path / "file").write_text("in the way")
    for arguments, words in (
        ([str(tmp_path / "nowhere"), str(tmp_path / "out")], "There is no scene"),
        ([str(run), str(tmp_path / "out"), "--view", "nobody.png"], "no view nobody.png"),
        ([str(run), str(tmp_path / "file" / "out")], "Cannot write"),
    ):
        assert cli.main(["export", *arguments]) == 2
        assert words in capsys.readouterr().err


def test_gaussians_of_a_scene_without_an_environment_need_no_view_of_it(scene, tmp_path):
    write_gaussians(tmp_path / "a.ply", scene, np.array([9.0, 9, 9]))
    assert len(floats_of_ply(tmp_path / "a.ply")["x"]) == len(scene.primary)
