from pathlib import Path

import numpy as np
import pytest
from room import cameras

from catacaustics.capture import sfm
from catacaustics.capture.view_graph import (
    consistent_edges,
    cycle_score,
    rigid_group,
    search_focal,
    strongest,
    triplet_support,
    triplets,
    vote_rotations,
)
from catacaustics.errors import UserError
from catacaustics.geometry import rotation_angle
from catacaustics.images import write_image


def edges_of(rotations: np.ndarray, pairs: list[tuple[int, int]], inliers: int = 50) -> list[sfm.RelativePose]:
    matches = np.zeros((inliers, 2), int)
    return [sfm.RelativePose(i, j, rotations[j] @ rotations[i].T, np.array([1.0, 0, 0]), matches) for i, j in pairs]


@pytest.fixture
def rotations() -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.random(7, random_state=np.random.RandomState(1)).as_matrix()


def all_pairs(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i + 1, n)]


def test_true_relative_rotations_close_every_triplet(rotations):
    edges = edges_of(rotations, all_pairs(7))
    index, error = triplets(edges)
    assert len(index) == 7 * 6 * 5 // 6
    assert error.max() < 1e-6
    assert consistent_edges(edges, 7).all()


def test_a_wrong_pair_with_most_inliers_is_found_by_its_loops(rotations):
    edges = edges_of(rotations, all_pairs(7))
    wrong = 4
    turned = edges[wrong].rotation @ rotations[0]
    edges[wrong] = sfm.RelativePose(
        edges[wrong].first, edges[wrong].second, turned, edges[wrong].direction, np.zeros((500, 2), int)
    )
    assert triplet_support(edges)[wrong] == 0
    keep = consistent_edges(edges, 7)
    assert not keep[wrong]
    assert keep.sum() == len(edges) - 1


def test_wrong_pairs_that_agree_among_themselves_are_outvoted(rotations):
    """A repeated object makes wrong pairs that close a triplet: photograph 6 seen consistently, but elsewhere."""
    edges = edges_of(rotations, all_pairs(6))
    elsewhere = rotations.copy()
    elsewhere[6] = elsewhere[6] @ rotations[0]
    edges += edges_of(elsewhere, [(0, 6), (1, 6)], inliers=40) + edges_of(rotations, [(2, 6), (3, 6), (4, 6)])
    keep = consistent_edges(edges, 7)
    assert keep.tolist() == [True] * 15 + [False] * 2 + [True] * 3


def test_voted_rotations_equal_the_true_ones_up_to_the_world(rotations):
    edges = edges_of(rotations, all_pairs(7))
    voted, agree = vote_rotations(edges, np.ones(len(edges)), 7, trials=5)
    assert agree.all()
    world = voted[0].T @ rotations[0]
    assert rotation_angle(voted @ world @ np.swapaxes(rotations, 1, 2)).max() < 1e-6


def test_of_two_hypotheses_for_a_pair_the_one_that_closes_loops_is_kept(rotations):
    edges = edges_of(rotations, all_pairs(5))
    second = sfm.RelativePose(0, 1, rotations[3], np.array([1.0, 0, 0]), np.zeros((90, 2), int))
    assert consistent_edges([*edges, second], 5).tolist() == [True] * len(edges) + [False]


def test_photographs_in_a_row_without_any_loop_are_believed(rotations):
    assert consistent_edges(edges_of(rotations, [(0, 1), (1, 2)]), 3).all()


def test_the_focal_search_finds_a_peak_within_four_percent():
    for true in (0.6, 0.82, 1.3, 2.0):
        found, clear = search_focal(lambda f, t=true: float(np.exp(-((np.log(f / t) / 0.2) ** 2))))
        assert clear
        assert abs(found / true - 1) < 0.04


def test_the_focal_search_falls_back_where_no_loop_closes():
    assert search_focal(lambda f: 0.0) == (1.2, False)


def test_loops_close_best_at_the_true_focal_length():
    """Geometry estimated from exact projections of random points, as photographs of a scene would give."""
    views = cameras(5)
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1.5, (150, 3))
    keypoints = [v.project(points)[0] + rng.normal(0, 0.2, (150, 2)) for v in views]
    features = sfm.Features(keypoints, [], [], [])
    same = np.stack([np.arange(150)] * 2, -1)
    matches = dict.fromkeys(all_pairs(5), same)
    photo = sfm.Photo("a.jpg", Path("a.jpg"), 320, 240, 1.0, None)

    def score(factor: float) -> float:
        camera = sfm.initial_camera(photo, "SIMPLE_RADIAL", factor)
        return cycle_score(sfm.relative_poses(features, matches, [camera] * 5, trials=500))

    found, clear = search_focal(score)
    assert clear
    assert abs(found / (280 / 320) - 1) < 0.1


def test_a_second_relative_pose_is_found_behind_a_stronger_wrong_one():
    """Two thirds of the matches show one thing that moved between the photographs; the rest shows the true motion."""
    a, b, moved = (cameras(6)[i] for i in (0, 1, 4))
    points = np.random.default_rng(0).uniform(0, 1.5, (120, 3))
    first = a.project(points)[0]
    second = np.where((np.arange(120) < 80)[:, None], moved.project(points)[0], b.project(points)[0])
    camera = sfm.initial_camera(sfm.Photo("a.jpg", Path("a.jpg"), 320, 240, 1.0, 280.0), "PINHOLE", 1.0)
    features = sfm.Features([first, second], [], [], [])
    matches = {(0, 1): np.stack([np.arange(120)] * 2, -1)}
    found = sfm.relative_poses(features, matches, [camera, camera], hypotheses=2)
    true = [v.camera_from_world[:3, :3] @ a.camera_from_world[:3, :3].T for v in (moved, b)]
    assert len(found) == 2
    for pose, rotation in zip(found, true, strict=True):
        assert rotation_angle((pose.rotation @ rotation.T)[None])[0] < np.radians(0.5)


def test_matches_off_the_epipolar_line_of_known_poses_are_left_out():
    a, b = cameras(2)
    points = np.random.default_rng(0).uniform(0, 1.5, (40, 3))
    pixels = [a.project(points)[0], b.project(points)[0]]
    pixels[1][:10] += [0, 25.0]
    rays = [(p - [160, 120]) / 280 for p in pixels]
    matches = {(0, 1): np.stack([np.arange(40)] * 2, -1)}
    poses = {0: a.camera_from_world, 1: b.camera_from_world}
    (kept,) = sfm.epipolar_matches(poses, rays, matches, 280.0, 2.0)
    assert kept.matches[:, 0].tolist() == list(range(10, 40))


def descriptors_of_places(places: int, photos: list[int], rng: np.random.Generator) -> list[np.ndarray]:
    """Photographs of places: a place shows the same kinds of features as any other, each in its own manner."""
    kinds = rng.integers(40, 200, (40, 128))
    manner = rng.integers(-30, 31, (places, 40, 128))
    result = []
    for place in photos:
        kind = rng.integers(0, 40, 300)
        noisy = kinds[kind] + manner[place, kind] + rng.integers(-5, 6, (300, 128))
        result.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return result


def test_look_alikes_have_the_most_similar_global_descriptors():
    descriptors = descriptors_of_places(4, [0, 0, 1, 1, 2, 2, 3, 3], np.random.default_rng(0))
    vectors = sfm.global_descriptors(descriptors)
    likeness = vectors @ vectors.T - 2 * np.eye(8)
    assert likeness.argmax(1).tolist() == [1, 0, 3, 2, 5, 4, 7, 6]


def test_beyond_the_limit_pairs_are_neighbours_and_look_alikes(monkeypatch):
    monkeypatch.setattr(sfm, "EXHAUSTIVE_LIMIT", 5)
    monkeypatch.setattr(sfm, "SEQUENTIAL_NEIGHBORS", 1)
    monkeypatch.setattr(sfm, "RETRIEVED", 1)
    descriptors = descriptors_of_places(4, [0, 1, 2, 3, 0, 1, 2, 3], np.random.default_rng(0))
    pairs = sfm.choose_pairs(sfm.Features([np.zeros((300, 2))] * 8, descriptors, [], []))
    assert {(i, i + 1) for i in range(7)} <= set(pairs)
    assert {(i, i + 4) for i in range(4)} <= set(pairs)
    assert len(pairs) == len(set(pairs)) == 11


def test_groups_that_share_only_one_photograph_are_not_rigid(rotations):
    edges = edges_of(rotations, [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (3, 4), (3, 5), (4, 5)])
    assert rigid_group(edges) == {0, 1, 2, 3}
    edges += edges_of(rotations, [(2, 4)])
    assert rigid_group(edges) == {0, 1, 2, 3, 4, 5}


def test_the_strongest_pairs_come_first():
    matches = {(0, 1): np.zeros((5, 2)), (0, 2): np.zeros((9, 2)), (1, 2): np.zeros((7, 2))}
    assert list(strongest(matches, 2)) == [(0, 2), (1, 2)]


def test_dark_photographs_are_brightened_and_bright_ones_are_not(tmp_path):
    for name, level in (("dark", 0.16), ("bright", 0.5)):
        for k in range(3):
            write_image(tmp_path / name / f"{k}.png", np.full((40, 60, 3), level))
        copies = tmp_path / f"{name}_copies"
        photos, median = sfm.prepare_photos(tmp_path / name, {}, copies, tmp_path / "m", 1600)
        assert abs(median - level) < 0.01
        from catacaustics.images import read_image

        copy = read_image(copies / sfm.copy_name(0)).mean()
        assert abs(copy - (0.4 if name == "dark" else 0.5)) < 0.02
        assert photos[0].reduced == (60, 40)


def test_a_mask_keeps_features_off_the_reflector_and_its_outline(tmp_path):
    for k in range(3):
        write_image(tmp_path / f"{k}.png", np.full((100, 200, 3), 0.5))
    mask = np.zeros((100, 200), bool)
    mask[40:60, 80:120] = True
    write_image(tmp_path / "masks" / "ball.png", mask)
    sfm.prepare_photos(tmp_path, {1: [tmp_path / "masks" / "ball.png"]}, tmp_path / "c", tmp_path / "m", 100)
    from catacaustics.images import read_mask

    allowed = read_mask(tmp_path / "m" / f"{sfm.copy_name(1)}.png")
    assert allowed.shape == (50, 100)
    assert not allowed[19:31, 39:61].any()
    assert allowed.mean() > 0.9
    assert read_mask(tmp_path / "m" / f"{sfm.copy_name(0)}.png").all()


def test_a_mask_of_another_size_is_refused_by_name(tmp_path):
    for k in range(3):
        write_image(tmp_path / f"{k}.png", np.full((100, 200, 3), 0.5))
    write_image(tmp_path / "masks" / "ball.png", np.zeros((50, 100), bool))
    with pytest.raises(UserError, match=r"ball\.png has 100 x 50 pixels"):
        sfm.prepare_photos(tmp_path, {1: [tmp_path / "masks" / "ball.png"]}, tmp_path / "c", tmp_path / "m", 100)
