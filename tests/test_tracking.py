"""Tracks of reflected points: against brute force on spheres and planes, and on a path-traced ball."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from toy import make_toy_capture, scene_of, write_run

from catacaustics import cli
from catacaustics.cameras import interpolate_path
from catacaustics.capture.dataset import open_capture
from catacaustics.capture.truth import read_reflectors, read_truth, truth_path
from catacaustics.errors import UserError
from catacaustics.geometry import Similarity, normalize, sphere_directions
from catacaustics.reflectors.volume import build_volume
from catacaustics.reflectors.warps import QuadricWarp
from catacaustics.renderer import NeuralRenderer
from catacaustics.run import Run
from catacaustics.scene import PointParameters, Scene
from catacaustics.splatting import splat_points
from catacaustics.splatting.config import SplatConfig
from catacaustics.tracking import (
    blending_weights,
    draw_dots,
    follow_points,
    point_at,
    run_from_truth,
    sources_at,
    spread_points,
    track_errors,
    true_pixels,
)

BALL = Path(__file__).parents[1] / "data_samples" / "ball"
SAME = Similarity(1.0, np.eye(3), np.zeros(3))


def cloud(positions, normals, radius, rho=None) -> PointParameters:
    n = len(positions)
    colors = torch.rand(n, 6, generator=torch.Generator().manual_seed(0))
    weights = None if rho is None else torch.full((n,), rho)
    places, normals = (torch.as_tensor(np.asarray(a), dtype=torch.float32) for a in (positions, normals))
    return PointParameters(places, normals, torch.full((n,), radius**2), torch.full((n,), 0.9), colors, weights)


@pytest.fixture(scope="module")
def capture():
    return open_capture(BALL)


@pytest.fixture(scope="module")
def ball(capture) -> Scene:
    """The true ball, a mirror all over, that mirrors the true sources."""
    geometry = read_reflectors(BALL)["ball"]
    center, radius = np.array(geometry["center"]), geometry["radius"]
    views = [v for v in capture.train if truth_path(BALL, v.name).is_file()]
    sources = np.concatenate([read_truth(BALL, v.name).source.reshape(-1, 3)[::13] for v in views])
    sources = sources[np.isfinite(sources).all(1)]
    normals = sphere_directions(8000)
    warp = QuadricWarp(torch.tensor(center).float(), radius * torch.eye(3), sphere=True)
    primary = cloud(center + radius * normals, normals, 0.01, 0.99)
    reflection = cloud(sources, np.ones_like(sources), 0.07)
    volume = build_volume(capture, "ball")
    return Scene(primary, [reflection], [warp], [volume], None, NeuralRenderer(8, 3), SplatConfig())


def test_a_points_weight_at_a_pixel_is_its_share_of_the_picture(ball, capture):
    """Brute force: the picture with a point's feature at 1 and all others at 0."""
    camera = capture.held_out[0].camera
    pixel = np.array([240.5, 150.5])
    rows, weights = blending_weights(ball, 0, camera, pixel)
    disks = ball.reflection_disks(0, camera)
    place = {row: i for i, row in enumerate(disks.rows.tolist())}
    order = weights.argsort(descending=True)
    for k in order[:5].tolist():
        feature = torch.zeros(len(disks.rows), 1)
        feature[place[int(rows[k])]] = 1
        with torch.no_grad():
            image = splat_points(*disks[1:5], feature, camera, config=ball.splatting).image
        assert float(image[150, 240]) == pytest.approx(float(weights[k]), rel=1e-4)
    assert float(weights.sum()) == pytest.approx(1, abs=0.05)
    assert point_at(ball, 0, camera, pixel) == int(rows[order[0]])


def test_true_pixels_of_a_sphere_lie_where_the_lights_path_is_shortest():
    camera = open_capture(BALL).held_out[3].camera
    center, radius = np.array([0.0, 0, 0.966]), 0.22
    rng = np.random.default_rng(0)
    sources = center + normalize(rng.normal(size=(12, 3))) * rng.uniform(0.5, 3, (12, 1))
    found = true_pixels({"type": "sphere", "center": center.tolist(), "radius": radius}, sources, camera, SAME)
    normals = sphere_directions(400_000)
    surface = center + radius * normals
    facing = ((camera.center - surface) * normals).sum(1) > 0
    checked = 0
    for source, pixel in zip(sources, found, strict=True):
        way = np.linalg.norm(surface - source, axis=1) + np.linalg.norm(surface - camera.center, axis=1)
        way[~facing | (((source - surface) * normals).sum(1) < 0)] = np.inf
        if np.isfinite(pixel).all():
            np.testing.assert_allclose(camera.project(surface[way.argmin()])[0], pixel, atol=0.5)
            checked += 1
    assert checked >= 5


def test_true_pixels_of_a_plane_move_with_the_coordinates():
    """The image of a point in the plane x = 0 is at -x; the run's world is the truth's, turned, grown and shifted."""
    camera = open_capture(BALL).held_out[0].camera
    turn = np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    change = Similarity(2.0, turn, np.array([0.3, 0.1, -0.2]))
    here = (np.linalg.inv(turn) @ (camera.center - change.translation)) / 2
    ahead = camera.camera_from_world[2, :3] @ turn
    corners = here + 1.0 * ahead + np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1.0]])
    source = here + [0.2 * np.sign(here[0] - corners[0, 0]), 0.05, 0.1]
    pixel = true_pixels({"type": "plane", "corners": corners.tolist()}, source[None], camera, change)[0]
    image = source.copy()
    image[0] = 2 * corners[0, 0] - source[0]
    np.testing.assert_allclose(pixel, camera.project(change.apply(image[None]))[0][0], atol=1e-9)
    behind = true_pixels({"type": "plane", "corners": corners.tolist()}, image[None], camera, change)
    assert np.isnan(behind).all()
    with pytest.raises(UserError, match="revolution"):
        true_pixels({"type": "revolution"}, source[None], camera, change)


def test_sources_are_interpolated_between_pixel_centres(capture):
    view = next(v for v in capture.held_out if truth_path(BALL, v.name).is_file())
    truth = read_truth(BALL, view.name).source
    rows, columns = np.nonzero(np.isfinite(truth).all(-1))
    middle = np.array([columns.mean().round(), rows.mean().round()]).astype(int)
    centers = np.array([middle + 0.5, middle + [1.0, 0.5]])
    one, between = sources_at(BALL, view, centers, 480)
    x, y = middle
    np.testing.assert_allclose(one, truth[y, x])
    low, high = np.minimum(truth[y, x], truth[y, x + 1]), np.maximum(truth[y, x], truth[y, x + 1])
    assert ((between >= low - 1e-9) & (between <= high + 1e-9)).all()
    np.testing.assert_allclose(sources_at(BALL, view, 2 * centers[:1], 960)[0], one)  # a picture twice as wide
    assert np.isnan(sources_at(BALL, view, np.array([[2.0, 2.0]]), 480)).all()


def test_tracks_on_the_true_ball_follow_the_path_tracer(ball, capture):
    """With the true mirror and true sources what is left is the truth's own resolution."""
    view = capture.held_out[0]
    cameras = [view.camera, *interpolate_path([v.camera for v in capture.held_out], 6)]
    points = spread_points(ball, 0, view.camera, 12)
    assert len(set(points)) == 12
    tracks = follow_points(ball, 0, points, cameras)
    assert tracks.visible[0].mean() > 0.9
    run = Run(BALL, ball, capture, {})
    errors = track_errors(run, 0, tracks, cameras, 0, view, BALL)
    assert np.isfinite(errors).sum() > 30
    assert np.nanmedian(errors) < 0.3
    assert np.nanpercentile(errors, 95) < 1.5
    stuck = np.linalg.norm(tracks.pixels - tracks.pixels[0], axis=-1)[np.isfinite(errors)]
    assert np.median(stuck) > 5  # there was motion to follow


def test_a_point_behind_the_ball_is_not_visible(ball, capture):
    view = capture.held_out[0].camera
    away = ball.reflections[0].positions.detach().numpy() - ball.volumes[0].center
    back = normalize(ball.volumes[0].center - view.center)
    hidden = np.argsort(-normalize(away) @ back)[:5].tolist()
    tracks = follow_points(ball, 0, hidden, [view])
    assert not tracks.visible.any()


def test_dots_are_drawn_on_visible_points_only():
    picture = draw_dots(
        np.zeros((40, 60, 3), np.float32), np.array([[10.5, 20.5], [40.5, 20.5]]), np.array([True, False]), 3.0
    )
    assert picture[20, 10].max() > 200
    assert picture[:, 30:].max() == 0


def test_a_calibration_of_other_photographs_has_no_truth(capture, tmp_path):
    other = open_capture(make_toy_capture(tmp_path))
    with pytest.raises(UserError, match="0 views in common"):
        run_from_truth(other, capture)


def test_the_command_writes_tables_a_picture_and_a_film_and_refuses_bad_input(tmp_path, capsys):
    capture = open_capture(make_toy_capture(tmp_path / "capture"))
    run = write_run(tmp_path / "run", capture, scene_of(capture, "sphere"))
    out = tmp_path / "out"
    command = ["track", str(run), str(out), "--width", "64", "--seconds", "0.5", "--fps", "8", "--count", "3"]
    assert cli.main(command) == 0
    rows = list(csv.DictReader((out / "tracks.csv").read_text().splitlines()))
    table = json.loads((out / "tracks.json").read_text())
    assert len(rows) == 4 * len(table["tracks"]) == 4 * 3
    assert {row["visible"] for row in rows} <= {"0", "1"}
    assert float(rows[0]["x"]) == pytest.approx(table["tracks"][0]["pixels"][0][0], abs=1e-3)
    assert (out / "tracks.jpg").stat().st_size > 500
    assert (out / "tracks.mp4").read_bytes()[4:8] == b"ftyp"
    point = table["tracks"][0]["point"]
    pixel = [str(v) for v in table["tracks"][0]["pixels"][0]]
    capsys.readouterr()
    assert cli.main([*command, "--no-film", "--points", str(point), "--pixels", *pixel]) == 0
    for wrong, words in (
        (["--pixels", "1", "1"], "Nothing is reflected"),
        (["--pixels", "1", "1", "1"], "pairs X Y"),
        (["--points", "100000"], "no reflection point 100000"),
        (["--reflector", "kettle"], "no reflector kettle"),
        (["--truth", str(BALL)], "views in common"),
        (["--truth", str(tmp_path / "nowhere")], "nowhere"),
        (["--fps", "0"], "positive seconds"),
    ):
        assert cli.main([*command, "--no-film", *wrong]) == 2, wrong
        assert words in capsys.readouterr().err
