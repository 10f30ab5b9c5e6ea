"""Data sets for refraction baking: what a frame holds, the files, runs that are stopped, bad input."""

import errno
import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from catacaustics import cli
from catacaustics.config import RefractDataConfig
from catacaustics.errors import UserError
from catacaustics.files import read_json, write_json
from catacaustics.geometry import normalize
from catacaustics.refraction import data, stage
from catacaustics.refraction.contact import true_colour
from catacaustics.refraction.data import make_data, make_frame
from catacaustics.refraction.frames import Frame, open_frames, read_frame, write_shard
from catacaustics.refraction.scenes import SCENES, draw, find_scene, ranges, values, with_ranges
from catacaustics.refraction.variants import VECTORISED, choose_variant

pytest.importorskip("mitsuba")

# One resolution in most tests: it is compiled into Mitsuba's kernels.
TINY = RefractDataConfig(
    "tir", Path(), train=3, val=2, test=2, generator=3, resolution=24, screen=64, spp=1, processes=1
)


@pytest.fixture(autouse=True, scope="module")
def _mitsuba():
    try:
        choose_variant("auto", VECTORISED)
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    """A finished data set."""
    folder = tmp_path_factory.mktemp("tir")
    make_data(replace(TINY, out=folder))
    return folder


@pytest.fixture(scope="module")
def checker() -> Frame:
    config = replace(TINY, scene="checker", resolution=64, screen=256, spp=36)
    return make_frame(find_scene("checker"), config, "train", 1)


def copied(folder: Path, out: Path) -> Path:
    import shutil

    return Path(shutil.copytree(folder, out / "copy"))


# What a frame holds


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_fills_every_buffer_with_sense(name):
    frame = make_frame(find_scene(name), replace(TINY, scene=name), "train", 0)
    lands = frame.landing_object >= 0
    assert frame.refractive.mean() > 0.1
    assert lands.sum() > 0.9 * frame.refractive.sum()
    assert not (lands & ~frame.refractive).any()
    assert (frame.object_mask.any(0) == frame.refractive).mean() > 0.97  # opaque things hide little of the glass
    assert np.abs(frame.landing).max() <= 1 + 1e-5
    assert frame.landing_uv.min() >= 0
    assert frame.landing_uv.max() < 1
    assert frame.events[lands].min() >= 1
    assert (frame.events[~frame.refractive] == 0).all()
    np.testing.assert_allclose(np.linalg.norm(frame.normal, axis=-1), 1, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(frame.landing_normal[lands], axis=-1), 1, atol=1e-4)
    assert (frame.landing_normal[~lands] == 0).all()
    assert frame.object_ior.min() > 1.2
    size = np.linalg.norm(frame.object_to_world[:, :, 0], axis=-1)[:, None, None]
    turned = frame.object_to_world[:, :, :3] / size
    np.testing.assert_allclose(turned @ turned.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turned.shape), atol=1e-5)
    assert frame.parameters.min() >= 0
    assert frame.parameters.max() <= 1
    assert frame.reference.mean() > 0.2


def test_projected_positions_are_the_pixels_they_were_seen_at(checker):
    h, w = checker.depth.shape
    p = np.concatenate([checker.position, np.ones((h, w, 1))], -1) @ checker.world_to_clip.T
    ndc = p[..., :2] / p[..., 3:]
    x, y = np.meshgrid((np.arange(w) + 0.5) / w * 2 - 1, 1 - (np.arange(h) + 0.5) / h * 2)
    np.testing.assert_allclose(ndc, np.stack([x, y], -1), atol=2e-5)
    np.testing.assert_allclose(p[..., 3], checker.depth, atol=1e-5)


def test_objects_alone_lie_on_their_pixels_rays_in_front_of_the_camera(checker):
    for mask, position, depth in zip(checker.object_mask, checker.object_position, checker.object_depth, strict=True):
        p = np.concatenate([position[mask], np.ones((mask.sum(), 1))], -1) @ checker.world_to_clip.T
        rows, columns = np.nonzero(mask)
        np.testing.assert_allclose(p[:, 0] / p[:, 3], (columns + 0.5) / 32 - 1, atol=2e-5)
        np.testing.assert_allclose(p[:, 1] / p[:, 3], 1 - (rows + 0.5) / 32, atol=2e-5)
        np.testing.assert_allclose(p[:, 3], depth[mask], atol=1e-5)
        assert (position[~mask] == 0).all()


def test_colours_at_true_landing_points_are_what_the_path_tracer_sees_through_the_glass():
    """Where neighbouring pixels land close together, so that one ray stands for its pixel; light is not even, hence
    compared by correlation, and against the same colours a few pixels further."""
    scene, side = find_scene("hemisphere"), 64
    frame = make_frame(scene, replace(TINY, resolution=side, spp=36), "train", 1)
    colour = true_colour(frame, [body.texture() for body in scene.opaque])
    steps = [np.linalg.norm(np.diff(frame.landing, axis=i), axis=-1)[: side - 1, : side - 1] for i in (0, 1)]
    calm = np.zeros((side, side), bool)
    calm[:-1, :-1] = np.maximum(*steps) < 0.05
    there = calm & (frame.landing_object >= 0)
    looked_up, reference = colour[there], frame.reference[there]
    assert there.sum() > 300
    assert np.corrcoef(looked_up.ravel(), reference.ravel())[0, 1] > 0.75
    assert abs(np.corrcoef(np.roll(looked_up, 7, 0).ravel(), reference.ravel())[0, 1]) < 0.2


def test_a_landing_point_that_is_seen_directly_has_the_screens_colour_and_depth(checker):
    textures = [body.texture() for body in find_scene("checker").opaque]
    p = np.concatenate([checker.landing, np.ones((64, 64, 1))], -1) @ checker.world_to_clip.T
    x = ((p[..., 0] / p[..., 3] + 1) * 128).astype(int)
    y = ((1 - p[..., 1] / p[..., 3]) * 128).astype(int)
    on = (checker.landing_object >= 0) & (p[..., 3] > 0) & (x >= 0) & (x < 256) & (y >= 0) & (y < 256)
    x, y = x[on], y[on]
    visible = np.abs(checker.screen_depth[y, x] / p[..., 3][on] - 1) < 0.01
    assert visible.mean() > 0.5
    looked_up = true_colour(checker, textures)[on][visible]
    on_screen = checker.screen[y, x][visible] / 255
    assert np.median(np.abs(looked_up - on_screen)) < 0.02


def test_the_probe_shows_off_screen_landing_points_as_their_textures_are(checker):
    towards = normalize(checker.landing - checker.probe_position)
    row = np.arccos(towards[..., 2]) / np.pi * 128
    column = (np.arctan2(towards[..., 1], towards[..., 0]) / np.pi + 1) * 128
    found = checker.probe[np.minimum(row.astype(int), 127), np.minimum(column.astype(int), 255)] / 255
    textures = [body.texture() for body in find_scene("checker").opaque]
    p = np.concatenate([checker.landing, np.ones((64, 64, 1))], -1) @ checker.world_to_clip.T
    off = (checker.landing_object >= 0) & (np.abs(p[..., :2]) > p[..., 3:]).any(-1)
    miss = np.abs(true_colour(checker, textures) - found).mean(-1)[off]
    other = np.abs(true_colour(checker, textures) - np.roll(found, 20, 1)).mean(-1)[off]
    assert off.sum() > 100
    assert np.median(miss) < 0.05
    assert np.median(miss) < 0.3 * np.median(other)


def test_hemisphere_lands_much_off_screen_and_tir_reflects_much_inside():
    frames = [make_frame(find_scene("hemisphere"), TINY, "generator", i) for i in range(4)]
    outside = []
    for frame in frames:
        p = np.concatenate([frame.landing, np.ones((24, 24, 1))], -1) @ frame.world_to_clip.T
        on = (np.abs(p[..., :2]) < p[..., 3:]).all(-1)
        outside.append(~on[frame.landing_object >= 0])
    assert np.concatenate(outside).mean() > 0.3
    frames = [make_frame(find_scene("tir"), TINY, "generator", i) for i in range(4)]
    assert np.concatenate([f.internal_reflection[f.refractive] for f in frames]).mean() > 0.4


# Files


def test_a_shard_gives_back_what_was_written_within_the_stated_rounding(checker, tmp_path):
    write_shard(tmp_path / "shard.npz", [checker, checker])
    again = read_frame(tmp_path / "shard.npz", 1)
    exact = ("landing", "landing_uv", "landing_object", "refractive", "events", "world_to_clip", "screen", "probe")
    for name in exact:
        np.testing.assert_array_equal(getattr(again, name), getattr(checker, name), err_msg=name)
    for name in ("position", "normal", "object_position", "object_normal", "landing_normal"):
        np.testing.assert_allclose(getattr(again, name), getattr(checker, name), atol=2e-5, err_msg=name)
    for name in ("albedo", "direct"):
        np.testing.assert_allclose(getattr(again, name), getattr(checker, name), atol=2.1e-3, err_msg=name)
    for name in ("depth", "object_depth", "reference"):
        np.testing.assert_allclose(getattr(again, name), getattr(checker, name), rtol=5e-4, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(again.screen_depth, checker.screen_depth, rtol=2e-4)
    assert again.has_reference


def test_a_data_set_opens_with_its_card_textures_and_splits(tiny):
    frames = open_frames(tiny)
    assert len(frames) == 10
    assert frames.damaged == []
    assert {s: len(frames.split(s)) for s in ("train", "val", "test", "generator")} == frames.card["splits"]
    assert frames.card["mitsuba"]
    assert frames.card["seed"] == 0
    assert len(frames.textures) == len(frames.card["opaque"])
    assert frames.split("train")[0].has_reference
    generator = frames.split("generator")[0]
    assert not generator.has_reference
    assert generator.screen.shape == (0, 0, 3)
    assert len(frames[0].parameters) == len(frames.card["parameters"])
    assert (tiny / "contact.jpg").stat().st_size > 5000
    with pytest.raises(UserError, match="no split"):
        frames.split("trian")


def test_a_data_set_of_an_older_format_is_neither_read_nor_continued(tiny, tmp_path):
    folder = copied(tiny, tmp_path)
    card = read_json(folder / "card.json")
    del card["format"]
    write_json(folder / "card.json", card)
    for use in (open_frames, lambda out: make_data(replace(TINY, out=out))):
        with pytest.raises(UserError, match=r"(?s)format 1.*format 3.*empty folder"):
            use(folder)


def test_no_frame_of_one_split_is_drawn_as_one_of_another(tiny):
    drawn = [tuple(frame.parameters.tolist()) for frame in open_frames(tiny)]
    assert len(set(drawn)) == len(drawn)


def test_missing_and_corrupt_shards_are_named_once_and_the_rest_is_usable(tiny, tmp_path):
    folder = copied(tiny, tmp_path)
    (folder / "shards" / "val_0000.npz").unlink()
    path = folder / "shards" / "test_0000.npz"
    path.write_bytes(path.read_bytes()[:-100] + bytes(100))
    with pytest.warns(UserWarning, match=r"2 of 4 shards .*val_0000\.npz, .*test_0000\.npz") as seen:
        frames = open_frames(folder)
    assert len(seen) == 1
    assert sorted(frames.damaged) == ["shards/test_0000.npz", "shards/val_0000.npz"]
    assert len(frames) == 6
    assert frames.split("train")[2].refractive.any()
    assert len(frames.split("val")) == 0


def test_a_shard_that_breaks_after_opening_is_named(tiny, tmp_path):
    folder = copied(tiny, tmp_path)
    frames = open_frames(folder).split("train")
    (folder / "shards" / "train_0000.npz").write_bytes(b"PK nothing")
    with pytest.raises(UserError, match=r"train_0000\.npz cannot be read"):
        frames[0]


def test_a_folder_without_a_usable_shard_is_refused(tiny, tmp_path):
    folder = copied(tiny, tmp_path)
    for path in (folder / "shards").iterdir():
        path.unlink()
    with pytest.raises(UserError, match="No shard"):
        open_frames(folder)
    with pytest.raises(UserError, match=r"card\.json"):
        open_frames(tmp_path)


def test_running_again_makes_only_what_is_missing_or_damaged_and_the_same_frames(tiny, tmp_path, capsys):
    folder = copied(tiny, tmp_path)
    before = {p.name: p.stat().st_mtime_ns for p in (folder / "shards").iterdir()}
    truth = open_frames(tiny).split("val")[1]
    path = folder / "shards" / "val_0000.npz"
    path.write_bytes(path.read_bytes()[:1000])
    make_data(replace(TINY, out=folder))
    assert "val_0000.npz is corrupt" in capsys.readouterr().out
    after = {p.name: p.stat().st_mtime_ns for p in (folder / "shards").iterdir()}
    assert {n for n in after if after[n] != before[n]} == {"val_0000.npz"}
    again = open_frames(folder).split("val")[1]
    for field in fields(Frame):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(truth, field.name), err_msg=field.name)
    make_data(replace(TINY, out=folder))
    assert "finished already" in capsys.readouterr().out


def test_an_interrupted_run_keeps_what_is_finished_even_what_the_card_does_not_know_yet(tmp_path, monkeypatch):
    config = replace(TINY, out=tmp_path / "set")
    whole, made = data.make_frame, []

    def interrupted(scene, config, split, index):
        if split == "train":
            raise KeyboardInterrupt
        made.append((split, index))
        return whole(scene, config, split, index)

    monkeypatch.setattr(data, "make_frame", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_data(config)
    assert made == [("val", 0), ("val", 1), ("test", 0), ("test", 1)]
    with pytest.warns(UserWarning, match="unfinished"):
        assert len(open_frames(config.out)) == 4
    card = read_json(config.out / "card.json")
    card["shards"][0]["sha256"] = None  # as if the run had ended between shard and card
    (config.out / "card.json").write_text(json.dumps(card))
    made.clear()
    monkeypatch.setattr(data, "make_frame", lambda *a: made.append(a[2:]) or whole(*a))
    make_data(config)
    assert {split for split, _ in made} == {"train", "generator"}
    assert len(open_frames(config.out)) == 10


def test_a_full_disk_is_one_clear_message_and_finished_shards_stay(tmp_path, monkeypatch):
    config = replace(TINY, out=tmp_path / "set")
    replaced = Path.replace

    def full(self, target):
        if Path(target).name.startswith("train"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replaced(self, target)

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(UserError, match=r"No space left while writing .*train_0000\.npz"):
        make_data(config)
    monkeypatch.undo()
    assert sorted(p.name for p in (config.out / "shards").iterdir()) == ["test_0000.npz", "val_0000.npz"]
    make_data(config)
    assert open_frames(config.out).damaged == []


def test_several_processes_make_the_same_frames_as_one(tiny, tmp_path):
    config = replace(TINY, out=tmp_path / "set", train=1, val=1, test=0, generator=0, processes=2)
    make_data(config)
    one, two = open_frames(tiny).split("train")[0], open_frames(config.out).split("train")[0]
    np.testing.assert_array_equal(one.landing, two.landing)
    np.testing.assert_allclose(one.reference, two.reference, atol=1e-3)


# Bad input


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["chekcer"], ["no scene chekcer", "checker", "hemisphere"]),
        (["tir", "--ranges", "eye.distance=1.6:1.8"], ["no room", "outside the walls", "eye.distance"]),
        (["tir", "--ranges", "eye.distance=0.02", "eye.target.x=-0.27"], ["no room", "is inside cube"]),
        (["tir", "--ranges", "eye.distnace=1:2"], ["eye.distnace", "eye.distance"]),
        (["tir", "--ranges", "eye.distance=2:1"], ["runs backwards"]),
        (["tir", "--ranges", "eye.distance"], ["no range"]),
        (["tir", "--ranges", "cube.center.x=0.9"], ["cube", "reaches to"]),
        (["tir", "--train", "-1"], ["-1"]),
        (["tir", "--spp", "0"], ["spp 0"]),
    ],
)
def test_bad_input_is_one_message_and_leaves_nothing_behind(tmp_path, capsys, arguments, words):
    small = ["--val", "0", "--test", "0", "--generator", "0", "--resolution", "8"]
    command = ["refract", "data", arguments[0], str(tmp_path / "out"), *small, *arguments[1:]]
    assert cli.main(command) == 2
    message = capsys.readouterr().err
    assert "Traceback" not in message
    assert "what to do:" in message
    for word in words:
        assert word in message
    assert not (tmp_path / "out").exists()


def test_a_folder_begun_with_other_settings_is_refused(tiny):
    with pytest.raises(UserError, match="other settings: seed 0"):
        make_data(replace(TINY, out=tiny, seed=1))


def test_a_missing_llvm_library_is_named_with_the_package_to_install(tmp_path):
    code = (
        "import os, sys; os.environ['DRJIT_LIBLLVM_PATH'] = '/nothing/here.so';"
        "from catacaustics import cli;"
        f"sys.exit(cli.main(['refract', 'data', 'tir', {str(tmp_path / 'out')!r}, '--variant', 'llvm_ad_rgb']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert "apt-get install -y libllvm19" in done.stderr
    assert "scalar" not in done.stderr


# Scenes


def test_a_scene_names_its_numbers_draws_them_within_their_ranges_and_takes_others():
    scene = find_scene("hemisphere")
    known = ranges(scene)
    assert known["egg.ior"] == (1.8, 2.1)
    assert "eye.azimuth" in known
    for seed in range(20):
        drawn, share = draw(scene, np.random.default_rng(seed))
        numbers = dict(values(drawn))
        assert not ranges(drawn)
        for (name, (low, high)), s in zip(known.items(), share, strict=True):
            assert low <= numbers[name] <= high
            assert numbers[name] == pytest.approx(low + s * (high - low))
    other = with_ranges(scene, ["egg.ior=1.2:1.3", "eye.fov=40", "lamp.radiance=2"])
    assert ranges(other)["egg.ior"] == (1.2, 1.3)
    assert dict(values(other))["eye.fov"] == 40
    assert len(ranges(other)) == len(known) - 1


@pytest.mark.parametrize("name", SCENES)
def test_glass_is_closed_and_its_faces_look_outward(name):
    """A ray that enters a body without an end would refract at one side only."""
    for body in find_scene(name).transparent:
        if body.mesh is None:
            continue
        mesh = body.mesh()
        _, same = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
        faces = same.reshape(-1)[mesh.faces]
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        there, back = Counter(map(tuple, edges.tolist())), Counter(map(tuple, edges[:, ::-1].tolist()))
        assert there == back, body.name
        a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
        assert (a * np.cross(b, c)).sum() / 6 > 0, body.name


def test_the_rabbits_atlas_is_discontinuous_while_its_surface_is_not():
    mesh = find_scene("checker").bodies[4].mesh()
    assert mesh.uv.min() >= 0
    assert mesh.uv.max() <= 1
    _, same = np.unique(np.round(mesh.vertices, 7), axis=0, return_inverse=True)
    order = np.argsort(same.reshape(-1))
    twin = np.flatnonzero(np.diff(same.reshape(-1)[order]) == 0)
    jump = np.linalg.norm(mesh.uv[order[twin]] - mesh.uv[order[twin + 1]], axis=-1)
    assert len(twin) > 1000  # vertices where charts meet
    assert np.median(jump) > 0.2


def test_a_body_inside_another_moves_with_it():
    scene = find_scene("hemisphere")
    drawn, _ = draw(with_ranges(scene, ["hemisphere.turn=90"]), np.random.default_rng(0))
    named = {b.name: b for b in drawn.bodies}
    outer, inner = (stage._pose(named[n], named) for n in ("hemisphere", "egg"))
    offset = np.array(inner.center) - outer.center
    local = np.array(outer.rotation).T @ offset / outer.size
    np.testing.assert_allclose(local, named["egg"].center, atol=1e-12)
    assert inner.size == pytest.approx(outer.size * named["egg"].size)
