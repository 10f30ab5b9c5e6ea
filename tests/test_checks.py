from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from room import cameras

from catacaustics.cameras import pixel_centers
from catacaustics.capture import sfm
from catacaustics.capture.checks import Landmarks, check_camera, localise, repair, silhouette_overlap
from catacaustics.geometry import normalize, rigid, rigid_inverse


class ExactMarks(Landmarks):
    """Stands in for a model's landmarks: exact points seen by every view, poses as given."""

    def __init__(self, points, poses, camera, count):
        self.points, self.poses = points, poses
        self.point_of = [np.arange(len(points)) for _ in range(count)]
        self.seen = np.ones((len(points), count), bool)
        self.cameras = [camera] * count


@pytest.fixture
def scene():
    """8 exact cameras, 120 points, features at exact projections, all matches right."""
    views = cameras(8)
    points = np.random.default_rng(0).uniform(0, 1.5, (120, 3))
    camera = sfm.initial_camera(sfm.Photo("a.jpg", Path("a.jpg"), 320, 240, 1.0, 280.0), "PINHOLE", 1.0)
    features = sfm.Features([v.project(points)[0] for v in views], [], [], [])
    same = np.stack([np.arange(120)] * 2, -1)
    matches = {(i, j): same for i in range(8) for j in range(i + 1, 8)}
    poses = {k: v.camera_from_world for k, v in enumerate(views)}
    return views, points, camera, features, matches, poses


def displaced(pose: np.ndarray, by: float) -> np.ndarray:
    world = rigid_inverse(pose)
    world[:3, 3] += by * world[:3, 0]
    return rigid_inverse(world)


def test_true_cameras_are_confirmed(scene):
    _, points, camera, features, matches, poses = scene
    marks = ExactMarks(points, poses, camera, 8)
    for view in range(8):
        check, winner = check_camera(view, marks, features, matches)
        assert check.verdict == "confirmed"
        assert check.votes == 120
        assert max(check.difference, check.halves) < 1e-4
        assert winner is not None


def test_a_misplaced_camera_is_found_and_its_true_pose_returned(scene):
    views, points, camera, features, matches, poses = scene
    marks = ExactMarks(points, poses | {3: displaced(poses[3], 0.4)}, camera, 8)
    check, winner = check_camera(3, marks, features, matches)
    assert check.verdict == "misplaced"
    assert 0.05 < check.difference < 0.3
    np.testing.assert_allclose(winner.pose, views[3].camera_from_world, atol=1e-4)


def test_a_camera_that_two_poses_explain_equally_is_ambiguous(scene):
    views, points, camera, features, matches, poses = scene
    elsewhere = views[6].project(points)[0]
    features.keypoints[2][60:] = elsewhere[60:]
    check, winner = check_camera(2, ExactMarks(points, poses, camera, 8), features, matches)
    assert check.verdict == "ambiguous"
    assert (check.votes, check.rival) == (60, 60)
    assert winner is None


def test_a_camera_with_hardly_any_matches_is_not_confirmed(scene):
    _, points, camera, features, matches, poses = scene
    few = {pair: m[:4] if 5 in pair else m for pair, m in matches.items()}
    check, winner = check_camera(5, ExactMarks(points, poses, camera, 8), features, few)
    assert check.verdict == "unconfirmed"
    assert not check.good
    assert winner is None


def test_points_that_hang_on_the_camera_itself_do_not_vote(scene):
    _, points, camera, features, matches, poses = scene
    marks = ExactMarks(points, poses, camera, 8)
    marks.seen[:, 2:] = False
    marks.seen[:, 0] = marks.seen[:, 1] = True  # every point was placed by views 0 and 1 alone
    check, _ = check_camera(0, marks, features, matches)
    assert check.votes == 0


def test_localisation_survives_half_of_the_matches_being_wrong(scene):
    views, points, camera, features, *_ = scene
    rng = np.random.default_rng(1)
    pixels = features.keypoints[4].copy()
    pixels[:60] = rng.uniform(0, [320, 240], (60, 2))
    (best, *_) = localise(camera, pixels, points, hypotheses=1)
    np.testing.assert_allclose(best.pose, views[4].camera_from_world, atol=1e-3)


class FakeModel:
    """The little of a reconstruction that `repair` asks for, so that its decisions can be tested alone."""

    def __init__(self, poses, scene):
        self.poses, (_, self.points, self.camera, *_) = poses, scene
        self.cameras = {}


def test_repair_moves_a_misplaced_camera_adds_a_missing_one_and_says_so(scene, monkeypatch):
    _, points, camera, features, matches, poses = scene
    monkeypatch.setattr("catacaustics.capture.checks.registered", lambda model, features: dict(model.poses))
    monkeypatch.setattr(
        "catacaustics.capture.checks.Landmarks", lambda model, features: ExactMarks(points, model.poses, camera, 8)
    )
    start = {k: p for k, p in poses.items() if k != 6} | {1: displaced(poses[1], 0.5)}
    model, checks, changes = repair(
        FakeModel(start, scene), lambda cams, poses: FakeModel(poses, scene), features, matches
    )
    assert sorted((c.index, c.action) for c in changes) == [(1, "moved"), (6, "added")]
    assert all(c.verdict == "confirmed" for c in checks)
    for k, pose in poses.items():
        np.testing.assert_allclose(model.poses[k], pose, atol=1e-4)


def test_repair_drops_a_camera_that_nothing_confirms(scene, monkeypatch):
    _, points, camera, features, matches, poses = scene
    monkeypatch.setattr("catacaustics.capture.checks.registered", lambda model, features: dict(model.poses))
    monkeypatch.setattr(
        "catacaustics.capture.checks.Landmarks", lambda model, features: ExactMarks(points, model.poses, camera, 8)
    )
    few = {pair: m[:4] if 5 in pair else m for pair, m in matches.items()}
    model, _, changes = repair(FakeModel(poses, scene), lambda cams, poses: FakeModel(poses, scene), features, few)
    assert [(c.index, c.action) for c in changes] == [(5, "dropped")]
    assert sorted(model.poses) == [0, 1, 2, 3, 4, 6, 7]


def test_silhouettes_of_a_ball_agree_and_a_turned_camera_stands_out():
    views, center, radius = cameras(8), np.array([0.5, 0.5, 0.6]), 0.3
    masks, project, centers, rays = {}, {}, {}, {}
    for k, view in enumerate(views):
        directions = normalize(view.ray_directions(pixel_centers(view.viewport)))
        to = center - view.center
        masks[k] = (to @ to) - (directions @ to) ** 2 < radius**2
        project[k], centers[k], rays[k] = view.project, view.center, normalize(to)
    overlap = silhouette_overlap(masks, project, centers, rays)
    # The first and last view alone bound the ball on their sides: a hull of the others reaches out there.
    assert min(overlap.values()) > 0.7
    assert np.median(list(overlap.values())) > 0.95
    turn = rigid(np.array([[0.98, 0, 0.199], [0, 1, 0], [-0.199, 0, 0.98]]), np.zeros(3))
    wrong = replace(views[3], camera_from_world=turn @ views[3].camera_from_world)
    project[3], rays[3] = wrong.project, turn[:3, :3].T @ rays[3]
    overlap = silhouette_overlap(masks, project, centers, rays)
    assert overlap[3] < 0.3
    assert min(v for k, v in overlap.items() if k != 3) > 0.7
