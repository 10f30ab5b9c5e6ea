"""Camera paths, video files, and films that go on where they were interrupted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from stand_in import StandInScene, make_run
from toy import make_toy_capture

from catacaustics import video
from catacaustics.cameras import Camera, interpolate_path
from catacaustics.capture.dataset import open_capture
from catacaustics.config import RenderConfig
from catacaustics.errors import UserError
from catacaustics.geometry import look_at, rigid, rotation_angle
from catacaustics.images import write_video
from catacaustics.run import open_run
from catacaustics.scene import Scene


def camera_at(eye, target=(0.0, 0.0, 0.0)) -> Camera:
    pose = look_at(np.array(eye, float), np.array(target, float), np.array([0.0, -1.0, 0.0]))
    return Camera(64, 48, 60.0, 60.0, 32.0, 24.0, pose)


def ring(angles) -> list[Camera]:
    return [camera_at((3 * np.cos(a), -1.0, 3 * np.sin(a))) for a in angles]


def step_lengths(cameras: list[Camera]) -> np.ndarray:
    return np.linalg.norm(np.diff([c.center for c in cameras], axis=0), axis=1)


def read_mp4(path):
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        return stream.codec_context, float(stream.average_rate), frames


# Paths


def test_a_path_begins_and_ends_at_its_keys_and_passes_the_others():
    keys = ring([0.0, 0.4, 1.0, 1.3])
    path = interpolate_path(keys, 400)
    for end, key in ((path[0], keys[0]), (path[-1], keys[-1])):
        np.testing.assert_allclose(end.camera_from_world, key.camera_from_world, atol=1e-9)
    for key in keys:
        assert min(np.linalg.norm(c.center - key.center) for c in path) < 0.01


def test_a_path_through_uneven_keys_has_even_speed():
    steps = step_lengths(interpolate_path(ring([0.0, 0.05, 0.5, 1.4, 1.5, 2.0]), 200))
    assert steps.max() < 1.05 * steps.min()


def test_a_path_around_a_ring_stays_on_it_and_looks_at_its_middle():
    path = interpolate_path(ring(np.linspace(0, 3, 9)), 100)
    radii = np.array([np.hypot(c.center[0], c.center[2]) for c in path])
    np.testing.assert_allclose(radii, 3, atol=0.03)
    for camera in path:
        pixel, _ = camera.project(np.zeros(3))
        np.testing.assert_allclose(pixel, [32, 24], atol=1)


def test_a_path_along_a_line_never_overshoots_its_keys():
    keys = [camera_at((x, 0.0, -5.0), (x, 0.0, 0.0)) for x in (0.0, 0.1, 4.0, 4.1, 9.0)]
    x = np.array([c.center[0] for c in interpolate_path(keys, 200)])
    assert (np.diff(x) > 0).all()
    assert x.min() >= -1e-9
    assert x.max() <= 9 + 1e-9


def test_a_path_around_a_corner_leaves_its_keys_box_by_little():
    corners = [(0.0, 0.0), (4.0, 0.0), (4.2, 0.0), (4.2, 0.2), (4.2, 4.0)]
    keys = [camera_at((x, 0.0, z), (x, 0.0, z + 1)) for x, z in corners]
    centers = np.array([c.center for c in interpolate_path(keys, 300)])
    assert centers.min() > -0.4
    assert centers.max() < 4.6


def test_keys_that_coincide_do_not_stop_a_path():
    keys = ring([0.0, 0.5, 0.5, 0.5, 1.0])
    steps = step_lengths(interpolate_path(keys, 60))
    assert steps.max() < 1.05 * steps.min()


def test_a_path_between_equal_keys_stands_still():
    keys = ring([0.3, 0.3])
    assert np.ptp([c.center for c in interpolate_path(keys, 5)], axis=0).max() == 0


def test_a_path_that_only_turns_has_even_speed():
    angles = np.radians([0.0, 10.0, 60.0])
    turns = [np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]]) for a in angles]
    keys = [Camera(64, 48, 60.0, 60.0, 32.0, 24.0, rigid(turn, np.zeros(3))) for turn in turns]
    poses = np.array([c.camera_from_world[:3, :3] for c in interpolate_path(keys, 50)])
    speeds = rotation_angle(poses[:-1].swapaxes(1, 2) @ poses[1:])
    assert speeds.max() < 1.05 * speeds.min()
    assert speeds.sum() == pytest.approx(np.radians(60), rel=0.01)


def test_a_path_keeps_the_first_keys_lens():
    keys = [camera_at((0.0, 0.0, -5.0)), camera_at((1.0, 0.0, -5.0)).resized(128, 96)]
    assert {(c.width, c.fx) for c in interpolate_path(keys, 4)} == {(64, 60.0)}


def test_a_tour_visits_every_camera_once_and_untangles_a_shuffled_line():
    rng = np.random.default_rng(0)
    places = rng.permutation(30)
    order = video.tour_order(np.stack([places, 0 * places, 0 * places], 1).astype(float))
    assert sorted(order) == list(range(30))
    visited = places[order]
    assert (np.abs(np.diff(visited)) == 1).all()


def test_no_stretch_of_a_tour_would_be_shorter_reversed():
    centers = np.random.default_rng(1).random((25, 3))
    tour = video.tour_order(centers)

    def length(way):
        return np.linalg.norm(np.diff(centers[way], axis=0), axis=1).sum()

    for i in range(1, 25):
        for j in range(i + 2, 26):
            other = np.concatenate([tour[:i], tour[i:j][::-1], tour[j:]])
            assert length(tour) <= length(other) + 1e-9


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_tour_of_few_cameras_visits_them(count):
    assert sorted(video.tour_order(np.eye(3)[:count])) == list(range(count))


# Files


def test_a_video_is_h264_that_players_open_with_its_size_and_speed(tmp_path):
    frames = [np.full((49, 67, 3), level, np.float32) for level in np.linspace(0.2, 0.8, 12)]
    assert write_video(tmp_path / "a.mp4", iter(frames), 12.5) == 12
    codec, fps, decoded = read_mp4(tmp_path / "a.mp4")
    assert (codec.name, codec.pix_fmt, codec.width, codec.height) == ("h264", "yuv420p", 66, 48)
    assert fps == 12.5
    assert len(decoded) == 12
    for image, expected in zip(decoded, frames, strict=True):
        assert abs(image.mean() - 255 * expected.mean()) < 3
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_a_video_keeps_its_colours(tmp_path):
    import av

    colors = np.array([[0.9, 0.1, 0.1], [0.1, 0.7, 0.2], [0.2, 0.2, 0.9]])
    image = np.repeat(np.repeat(colors[None], 64, 0), 32, 1)
    write_video(tmp_path / "a.mp4", [image] * 3, quality=10)
    with av.open(str(tmp_path / "a.mp4")) as container:
        frame = next(container.decode(video=0))
        assert frame.colorspace == 1  # tagged as BT.709
        decoded = frame.reformat(format="rgb24", src_colorspace="itu709").to_ndarray()
    for i, color in enumerate(colors):
        np.testing.assert_allclose(decoded[32, 32 * i + 16] / 255, color, atol=0.03)


def test_a_lower_rate_factor_makes_a_larger_and_better_video(tmp_path):
    rng = np.random.default_rng(0)
    frames = [rng.random((64, 64, 3)) for _ in range(5)]
    sizes, errors = [], []
    for quality in (10, 40):
        write_video(tmp_path / "a.mp4", frames, quality=quality)
        sizes.append((tmp_path / "a.mp4").stat().st_size)
        decoded = read_mp4(tmp_path / "a.mp4")[2]
        errors.append(np.mean([(d / 255 - f) ** 2 for d, f in zip(decoded, frames, strict=True)]))
    assert sizes[0] > 3 * sizes[1]
    assert errors[0] < errors[1]


def test_a_video_that_is_cut_off_leaves_nothing_half_written(tmp_path):
    def broken():
        yield np.zeros((32, 32, 3))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "a.mp4", broken())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("frames", "message"),
    [([], "one or more"), ([np.zeros((32, 32, 3)), np.zeros((32, 34, 3))], "one size")],
)
def test_frames_that_make_no_video_are_refused(tmp_path, frames, message):
    with pytest.raises(ValueError, match=message):
        write_video(tmp_path / "a.mp4", frames)


# Films


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return open_capture(make_toy_capture(tmp_path_factory.mktemp("film"), masks=False, points=False))


def film(monkeypatch, scene, run, **options):
    monkeypatch.setattr(Scene, "load", lambda *_: scene)
    settings = {"seconds": 0.5, "fps": 12.0, "width": 32}
    return video.render_video(RenderConfig(run, run / "film.mp4", **(settings | options)))


def test_a_film_has_the_asked_length_size_and_layers_side_by_side(capture, tmp_path, monkeypatch):
    run = make_run(tmp_path / "run", capture)
    path = film(monkeypatch, StandInScene(capture), run, layers=("weight", "reflection"))
    codec, fps, frames = read_mp4(path)
    assert (codec.width, codec.height, fps, len(frames)) == (64, 24, 12, 6)
    for frame in frames:
        assert abs(frame[:, 4:28].mean() / 255 - 0.75) < 0.02
        assert abs(frame[:, 36:60].mean() / 255 - 0.25) < 0.02
    assert not list(run.glob("film-frames-*"))


def test_an_interrupted_film_goes_on_with_the_same_command(capture, tmp_path, monkeypatch, capsys):
    run = make_run(tmp_path / "run", capture)
    with pytest.raises(KeyboardInterrupt):
        film(monkeypatch, StandInScene(capture, stop_after=4), run)
    assert not (run / "film.mp4").exists()
    assert len(list(run.glob("film-frames-*/*.png"))) == 4
    scene = StandInScene(capture)
    film(monkeypatch, scene, run)
    assert scene.renders == 2
    assert "4 of 6 frames are finished" in capsys.readouterr().out
    assert len(read_mp4(run / "film.mp4")[2]) == 6


def test_kept_frames_are_not_used_for_another_scene_or_layer(capture, tmp_path, monkeypatch):
    run = make_run(tmp_path / "run", capture)
    with pytest.raises(KeyboardInterrupt):
        film(monkeypatch, StandInScene(capture, stop_after=4), run)
    scene = StandInScene(capture)
    film(monkeypatch, scene, run, layers=("primary",))
    assert scene.renders == 6
    (run / "scene.safetensors").write_bytes(b"trained again")
    scene = StandInScene(capture)
    film(monkeypatch, scene, run)
    assert scene.renders == 6


def test_a_spline_film_tours_the_training_views(capture, tmp_path, monkeypatch):
    run = open_run_of(StandInScene(capture), make_run(tmp_path / "run", capture), monkeypatch)
    path = video.camera_path(run.capture, "spline", video.frame_count(20.0, 24.0), 33)
    assert len(path) == 480
    assert {(c.width, c.height) for c in path} == {(32, 24)}
    for view in capture.train:
        assert min(np.linalg.norm(c.center - view.camera.center) for c in path) < 0.05


def open_run_of(scene, folder, monkeypatch):
    monkeypatch.setattr(Scene, "load", lambda *_: scene)
    return open_run(folder)


def test_depth_is_coloured_over_the_same_range_in_every_frame(capture, tmp_path, monkeypatch):
    run = make_run(tmp_path / "run", capture)
    ranges = []
    original = video.layer_image

    def spy(output, layer, depths):
        ranges.append(depths)
        return original(output, layer, depths)

    monkeypatch.setattr(video, "layer_image", spy)
    film(monkeypatch, StandInScene(capture), run, layers=("depth",))
    assert len(ranges) == 6
    assert len(set(ranges)) == 1


def test_a_path_of_one_held_out_view_is_refused_with_another_path_offered(capture, tmp_path, monkeypatch):
    few = replace(capture, held_out=capture.held_out[:1])
    monkeypatch.setattr("catacaustics.run.open_capture", lambda _: few)
    with pytest.raises(UserError, match="--path spline"):
        film(monkeypatch, StandInScene(few), make_run(tmp_path / "run", few))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seconds": 0.0}, "positive seconds"),
        ({"fps": -1.0}, "positive seconds"),
        ({"width": 4}, "width of 16"),
        ({"quality": 60}, "quality from 0 to 51"),
        ({"layers": ()}, "--layers"),
        ({"video": Path("film.avi")}, r"film\.mp4"),
    ],
)
def test_settings_out_of_range_are_refused(tmp_path, options, message):
    config = RenderConfig(**({"run": tmp_path, "video": tmp_path / "film.mp4"} | options))
    with pytest.raises(UserError, match=message):
        video.render_video(config)
