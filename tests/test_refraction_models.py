"""Refraction baking: lookups, networks, losses, training and its bad inputs, on a room of glass balls made here."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from refraction_toy import interrupt_parts, make_toy_frames, toy_frame, toy_textures

from catacaustics.config import RefractTrainConfig
from catacaustics.errors import UserError
from catacaustics.files import read_json, write_json
from catacaustics.refraction import models as m
from catacaustics.refraction import train as training
from catacaustics.refraction.buffers import BufferCache, frame_buffers, frame_screen, stack
from catacaustics.refraction.evaluate import render_frame
from catacaustics.refraction.frames import open_frames, write_shard
from catacaustics.refraction.lookup import (
    Textures,
    inside_screen,
    project,
    sample_probe,
    sample_screen,
    visibility,
)
from catacaustics.refraction.measures import landing_regions
from catacaustics.refraction.networks import SIZES, ObjectEncoder, back_guesses, object_views, refract

SMALL = {"steps": 8, "batch": 2, "crop": 16, "checkpoint_minutes": 1e-9}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return make_toy_frames(tmp_path_factory.mktemp("toy"))


@pytest.fixture(scope="module")
def smooth_frame():
    """A frame whose textures have no edges, with a large screen: lookups must agree to a fraction of a level."""
    textures = [toy_textures()[0]] * 5
    return toy_frame(np.random.default_rng(5), 48, 512, textures=textures), textures


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """A hybrid of a few steps: folder and model."""
    run = tmp_path_factory.mktemp("run") / "hybrid"
    return run, training.train(RefractTrainConfig(data, run, "hybrid", **SMALL))


def fresh_model(name, textures=5, size="small"):
    torch.manual_seed(1)
    model = m.RefractionModel(name, size, m.Layout("toy", ()), toy_textures()[:textures], "cpu")
    for part in (model.generator, model.renderer):
        if part is not None:
            torch.nn.init.normal_(part.last.weight, std=0.3)
    return model.eval()


# Lookups ---------------------------------------------------------------------------------------------------------


def test_world_to_ndc_lookup_of_exact_coordinates_reproduces_the_texture(smooth_frame):
    frame, textures = smooth_frame
    buffers, screen = frame_buffers(frame), frame_screen(frame)
    ndc, _ = project(buffers.landing, buffers.world_to_clip)
    by_screen = sample_screen(screen.color, ndc)
    by_texture = Textures(textures).sample(buffers.landing_object, buffers.landing_uv)
    seen = torch.from_numpy(landing_regions(frame)["seen"])
    # The toy's screen holds nearest texels: their steps are the coarsest part of the difference.
    levels = 255 * (by_screen - by_texture).abs().mean(1)[0][seen]
    assert seen.sum() > 200
    assert levels.mean() < 1


def test_projection_agrees_with_the_depth_buffer_and_knows_what_lies_behind_the_camera(smooth_frame):
    frame, _ = smooth_frame
    buffers = frame_buffers(frame)
    ndc, depth = project(buffers.position, buffers.world_to_clip)
    side = frame.depth.shape[0]
    centers = (torch.arange(side) + 0.5) / side * 2 - 1
    torch.testing.assert_close(depth, buffers.depth, atol=1e-4, rtol=0)
    torch.testing.assert_close(ndc[0, 0], centers.expand(side, side), atol=1e-4, rtol=0)
    torch.testing.assert_close(ndc[0, 1], -centers[:, None].expand(side, side), atol=1e-4, rtol=0)
    behind = torch.tensor([0.0, 0.0, 5.0]).view(1, 3, 1, 1)
    assert inside_screen(project(behind, buffers.world_to_clip)[0]).item() == 0


def test_a_point_behind_another_is_not_visible_and_one_on_it_is(smooth_frame):
    frame, _ = smooth_frame
    buffers, screen = frame_buffers(frame), frame_screen(frame)
    ndc, depth = project(buffers.position, buffers.world_to_clip)
    inner = (slice(None), slice(None), slice(2, -2), slice(2, -2))
    assert visibility(screen.depth, ndc, depth, 0.05)[inner].min() > 0.99
    assert visibility(screen.depth, ndc, depth + 0.2, 0.05).max() == 0
    assert visibility(screen.depth, ndc, depth + 0.075, 0.05)[inner].mean() == pytest.approx(0.5, abs=0.05)


def test_texture_lookup_is_bilinear_repeats_and_is_exact_at_texel_centres():
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    textures = Textures([np.full((1, 1, 3), 51, np.uint8), image])
    v, u = np.meshgrid((np.arange(5) + 0.5) / 5, (np.arange(7) + 0.5) / 7, indexing="ij")
    uv = torch.tensor(np.stack([u, v])[None], dtype=torch.float32)
    index = torch.ones(1, 5, 7, dtype=torch.long)
    texels = torch.from_numpy(image).movedim(-1, 0)[None] / 255
    torch.testing.assert_close(textures.sample(index, uv), texels, atol=2e-6, rtol=0)
    torch.testing.assert_close(textures.sample(index, uv + 3), texels, atol=1e-5, rtol=0)
    halfway = textures.sample(index, uv + torch.tensor([0.5 / 7, 0]).view(1, 2, 1, 1))
    torch.testing.assert_close(halfway, (texels + texels.roll(-1, 3)) / 2, atol=1e-5, rtol=0)
    assert textures.sample(index - 1, uv).flatten().tolist() == pytest.approx([0.2] * 105)
    assert textures.sample(index - 2, uv).abs().max() == 0


def test_the_probe_shows_every_landing_point_of_an_empty_room_also_where_its_panorama_begins(smooth_frame):
    frame, images = smooth_frame
    buffers, screen = frame_buffers(frame), frame_screen(frame)
    found = sample_probe(screen.probe, screen.probe_position, buffers.landing)
    right = Textures(images).sample(buffers.landing_object, buffers.landing_uv)
    lands = buffers.landing_object >= 0
    assert 255 * (found - right).abs().mean(1)[lands].mean() < 1
    columns = torch.arange(8.0).expand(1, 1, 4, 8)
    seam = torch.tensor([-1.0, 0.0, 0.0]).view(1, 3, 1, 1)
    assert sample_probe(columns, torch.zeros(1, 3), seam).item() == pytest.approx(3.5)
    up = torch.arange(4.0).view(1, 1, 4, 1).expand(1, 1, 4, 8)
    assert sample_probe(up, torch.zeros(1, 3), torch.tensor([0.0, 0.0, 1.0]).view(1, 3, 1, 1)).item() == 0


def test_hybrid_takes_the_screen_where_the_point_is_seen_and_the_probe_elsewhere():
    """The panorama is gray, the screen is white: the colour tells where it came from."""
    frame = toy_frame(np.random.default_rng(2), 48, 128, placed=[(0.3, 0.3, 0.5), (-0.3, -0.1, 0.5)])
    buffers, screen = frame_buffers(frame), frame_screen(frame)
    screen = screen._replace(color=torch.ones_like(screen.color), probe=torch.full_like(screen.probe, 0.4))
    perfect, textures = m.truth("hybrid", buffers, 5), Textures(toy_textures())
    color = m.landing_color("hybrid", perfect, buffers, screen, textures)[0, 0].numpy()
    regions = landing_regions(frame)
    assert regions["off screen"].sum() > 10
    assert np.median(color[regions["seen"]]) == 1
    assert color[regions["off screen"]] == pytest.approx(0.4, abs=1e-5)
    nearer = screen._replace(depth=0.2 * screen.depth)
    hidden = m.landing_color("hybrid", perfect, buffers, nearer, textures)[0, 0].numpy()
    assert (np.abs(hidden[regions["seen"]] - 0.4) < 1e-5).mean() > 0.9


@pytest.mark.parametrize("kind", ["uv", "world", "screen", "hybrid"])
def test_a_perfect_prediction_has_no_loss_but_total_variation_and_finds_the_right_colour(smooth_frame, kind):
    frame, images = smooth_frame
    buffers, screen, textures = frame_buffers(frame), frame_screen(frame), Textures(images)
    perfect = m.truth(kind, buffers, len(images))
    if perfect.logits is not None:
        perfect = perfect._replace(logits=1000 * perfect.logits)
    losses = m.generator_losses(kind, perfect, buffers)
    assert sum(v for k, v in losses.items() if k != "tv") < 1e-5
    assert 0 < losses["tv"] < 1e-3
    color = m.landing_color(kind, perfect, buffers, screen, textures)
    right = textures.sample(buffers.landing_object, buffers.landing_uv)
    seen = torch.from_numpy(landing_regions(frame)["seen"])
    assert 255 * (color - right).abs().mean(1)[0][seen].mean() < 1


# Networks --------------------------------------------------------------------------------------------------------


def pixel(vector):
    return torch.tensor(vector, dtype=torch.float32)


def test_refraction_follows_snell_and_grazes_beyond_the_critical_angle():
    for degrees in (0, 20, 50):
        sine = np.sin(np.radians(degrees))
        bent = refract(pixel([sine, 0, -np.cos(np.radians(degrees))]), pixel([0, 0, 1]), pixel([1 / 1.5])).flatten()
        assert bent[0] == pytest.approx(sine / 1.5, abs=1e-6)
        assert bent.norm() == pytest.approx(1, abs=1e-6)
    grazing = refract(pixel([0.9, 0, -np.sqrt(1 - 0.81)]), pixel([0, 0, 1]), pixel([1.5])).flatten()
    assert grazing[2] == pytest.approx(0, abs=1e-3)


def test_the_guessed_backs_of_a_ball_and_of_a_flat_sheet_bend_rays_as_those_do():
    incidence, ior = np.radians(40), 1.5
    ray = torch.tensor([0.0, 0, -1])
    normal = pixel([np.sin(incidence), 0, np.cos(incidence)])
    inside = refract(ray, normal, pixel([1 / ior]))
    ball, _ = back_guesses(inside, normal, pixel([0, 0, 1]))
    deviation = 2 * (incidence - np.arcsin(np.sin(incidence) / ior))
    bent = refract(inside, -ball, pixel([ior]))
    assert bent.tolist() == pytest.approx([-np.sin(deviation), 0, -np.cos(deviation)], abs=1e-5)
    _, flat = back_guesses(inside, normal, normal)
    torch.testing.assert_close(refract(inside, -flat, pixel([ior])), ray, atol=1e-5, rtol=0)


def test_a_moved_and_turned_body_looks_the_same_from_a_camera_that_moves_along():
    frame = toy_frame(np.random.default_rng(3), balls=1)
    first = object_views(frame_buffers(frame), 4)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    names = ("position", "object_position", "object_normal", "object_to_world", "world_to_clip", "camera_position")
    position, o_position, o_normal, matrix, clip, camera = (getattr(frame, name) for name in names)
    back = np.eye(4, dtype=np.float32)
    back[:3, :3] = turn.T
    turned = replace(
        frame,
        position=position @ turn.T,
        object_position=o_position @ turn.T,
        object_normal=o_normal @ turn.T,
        object_to_world=turn @ matrix,
        world_to_clip=clip @ back,
        camera_position=camera @ turn.T,
    )
    second = object_views(frame_buffers(turned), 4)
    torch.testing.assert_close(second.path, first.path, atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", list(m.MODELS))
def test_no_order_of_four_objects_changes_the_image(name):
    rng = np.random.default_rng(7)
    frame = toy_frame(rng, balls=4, placed=rng.uniform(-0.3, 0.3, (4, 3)))
    buffers, screen = frame_buffers(frame), frame_screen(frame)
    model = fresh_model(name)
    with torch.no_grad():
        first = model(buffers, screen)
        for order in itertools.permutations(range(4)):
            own = {name: getattr(buffers, name)[:, list(order)] for name in ("objects", "poses", "bodies")}
            other = model(buffers._replace(**own), screen)
            assert (other - first).abs().max() < 1e-5


@pytest.mark.parametrize("name", list(m.MODELS))
def test_an_object_out_of_view_changes_nothing(name):
    frame = toy_frame(np.random.default_rng(8), balls=2)
    buffers, screen = frame_buffers(frame), frame_screen(frame)
    more = [torch.cat([0 * x[:, :1], x, 0 * x[:, :1]], 1) for x in (buffers.objects, buffers.poses)]
    bodies = torch.tensor([[-1, 0, 1, -1]])
    model = fresh_model(name)
    with torch.no_grad():
        assert torch.equal(
            model(buffers._replace(objects=more[0], poses=more[1], bodies=bodies), screen), model(buffers, screen)
        )


def test_the_encoder_gives_exactly_zero_for_an_object_out_of_view_also_after_training(trained):
    _, model = trained
    buffers = frame_buffers(toy_frame(np.random.default_rng(8), balls=1))
    empty = buffers._replace(objects=0 * buffers.objects, poses=0 * buffers.poses)
    for encoder in (model.generator.objects, model.renderer.objects):
        assert encoder(object_views(empty, 4)).abs().max() == 0
        assert encoder(object_views(buffers, 4)).abs().max() > 0


def test_a_model_takes_any_number_of_objects_and_a_batch_of_frames_with_different_numbers(trained):
    _, model = trained
    frames = [toy_frame(np.random.default_rng(i), balls=i) for i in range(5)]
    with torch.no_grad():
        alone = [model(frame_buffers(f), frame_screen(f)) for f in frames]
        together = stack([frame_buffers(f) for f in frames])
        screens = [frame_screen(f) for f in frames]
        screen = type(screens[0])(*(torch.cat(v) for v in zip(*screens, strict=True)))
        torch.testing.assert_close(model(together, screen), torch.cat(alone), atol=1e-4, rtol=0)


def test_the_sizes_have_more_and_more_parameters():
    counts = [sum(p.numel() for p in ObjectEncoder(size).parameters()) for size in SIZES.values()]
    assert counts == sorted(counts)
    assert len(SIZES) == 3


# Training --------------------------------------------------------------------------------------------------------


def test_training_learns_and_writes_a_model_that_renders_the_same_when_loaded(data, tmp_path):
    config = RefractTrainConfig(data, tmp_path / "run", "ssnrb", steps=60, batch=2, crop=0)
    model = training.train(config)
    rows = [json.loads(line) for line in (config.run / "metrics.jsonl").read_text().splitlines()]
    for part in ("generator", "renderer"):
        losses = [row["loss"] for row in rows if row["part"] == part]
        assert len(losses) == 6
        assert np.mean(losses[-2:]) < 0.9 * losses[0]
    frames = open_frames(data)
    loaded = m.load_model(config.run, frames)
    frame = frames.split("test")[0]
    with torch.no_grad():
        images = [one(frame_buffers(frame), frame_screen(frame)) for one in (model, loaded)]
    assert torch.equal(*images)


@pytest.mark.parametrize("name", ["glassnet", "hybrid"])
def test_an_interrupted_training_goes_on_to_the_same_weights_bit_for_bit(data, tmp_path, monkeypatch, name):
    config = RefractTrainConfig(data, tmp_path / "whole", name, **SMALL)
    training.train(config)
    cut = replace(config, run=tmp_path / "cut")
    parts = ["generator", "renderer"] if m.MODELS[name] else ["renderer"]
    stops = interrupt_parts(monkeypatch, dict.fromkeys(parts, 5))
    for _ in parts:
        with pytest.raises(KeyboardInterrupt):
            training.train(replace(cut, resume=True))
    training.train(replace(cut, resume=True))
    assert not stops
    for part in parts:
        whole, again = (m.load_part(run / f"{part}.safetensors")[0] for run in (config.run, cut.run))
        assert all(torch.equal(whole[k], again[k]) for k in whole)
    logs = [(run / "metrics.jsonl").read_text().count("\n") for run in (config.run, cut.run)]
    assert logs[0] == logs[1]


def test_the_generator_is_frozen_while_the_renderer_learns_and_can_be_trained_apart(data, tmp_path):
    config = RefractTrainConfig(data, tmp_path / "a", "crystalnet", part="generator", **SMALL)
    training.train(config)
    assert not (tmp_path / "a" / "renderer.safetensors").exists()
    path = tmp_path / "a" / "generator.safetensors"
    training.train(replace(config, run=tmp_path / "b", part="both", generator=path))
    first, second = (m.load_part(p)[0] for p in (path, tmp_path / "b" / "generator.safetensors"))
    assert all(torch.equal(first[k], second[k]) for k in first)


def test_a_model_without_generator_gives_all_its_minutes_to_the_renderer(data, tmp_path, monkeypatch):
    minutes = {}
    monkeypatch.setattr(training, "_loop", lambda state, part, *rest: minutes.update({part.name: part.minutes}))
    for name in ("glassnet", "ssnrb"):
        minutes.clear()
        training.train(RefractTrainConfig(data, tmp_path / name, name, minutes=10.0, generator_share=0.4))
        assert sum(minutes.values()) == pytest.approx(10)
        assert minutes.get("generator", 0) == (4 if name == "ssnrb" else 0)


def test_with_true_coordinates_no_generator_is_trained_and_the_right_colours_are_looked_up(data, tmp_path):
    config = RefractTrainConfig(data, tmp_path / "run", "crystalnet", coordinates="true", **SMALL)
    training.train(config)
    assert not (tmp_path / "run" / "generator.safetensors").exists()
    model, frame = m.load_model(config.run, open_frames(data)), open_frames(data).split("test")[0]
    view = render_frame(model, frame)
    assert np.abs(view.looked_up - view.true_color)[frame.landing_object >= 0].max() < 1e-5
    refused(["true coordinates", "no generator"], training.train, replace(config, part="generator"))


def test_content_keeps_the_colour_or_the_normal_of_the_r_buffer():
    r_buffer = torch.rand(1, 6, 4, 4) + 0.1
    assert torch.equal(training.keep_content(r_buffer, "both"), r_buffer)
    assert training.keep_content(r_buffer, "color")[0].flatten(1).any(1).tolist() == [True] * 3 + [False] * 3
    more = torch.rand(1, 12, 4, 4) + 0.1
    assert training.keep_content(more, "color")[0].flatten(1).any(1).tolist() == [True] * 3 + [False] * 3 + [True] * 6
    assert training.keep_content(r_buffer, "normal")[0].flatten(1).any(1).tolist() == [False] * 3 + [True] * 3


def test_frames_beyond_the_memory_limit_are_read_again(data):
    frames = open_frames(data).split("train")
    one = sum(v.numel() * v.element_size() for v in frame_buffers(frames[0]))
    cache = BufferCache([frames], 2.5 * one)
    for i in range(4):
        assert torch.equal(cache.get(i).reference, frame_buffers(frames[i]).reference)
    assert list(cache.kept) == [2, 3]
    ahead = BufferCache([frames], 2.5 * one)
    ahead.fill()
    assert list(ahead.kept) == [0, 1]
    assert cache.bytes == 2 * one


# Bad input -------------------------------------------------------------------------------------------------------


def refused(words, function, *arguments):
    with pytest.raises(UserError) as caught:
        function(*arguments)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_an_unknown_model_is_refused_with_the_known_ones(data, tmp_path):
    refused(["glossnet", "glassnet", "hybrid"], m.kind_of, "glossnet")


def test_a_model_refuses_frames_of_another_scene_size_or_texture(trained, data, tmp_path):
    run, _ = trained
    other = make_toy_frames(tmp_path / "textures", textures=toy_textures(seed=4))
    refused(["5 textures", "4 of which differ"], m.load_model, run, open_frames(other))
    refused(["28 x 28", "multiple of 8"], m.load_model, run, open_frames(make_toy_frames(tmp_path / "size", side=28)))
    card = read_json(other / "card.json")
    write_json(other / "card.json", card | {"scene": "cave"})
    refused(["'cave'", "'toy'"], m.load_model, run, open_frames(other))


def test_missing_damaged_and_foreign_checkpoints_are_refused(trained, data, tmp_path):
    run, _ = trained
    frames = open_frames(data)
    refused(["There is no trained network", "refract train"], m.load_model, tmp_path, frames)
    whole = (run / "renderer.safetensors").read_bytes()
    (tmp_path / "renderer.safetensors").write_bytes(whole[: len(whole) // 2])
    refused(["not a complete", "--resume"], m.load_model, tmp_path, frames)
    config = RefractTrainConfig(data, tmp_path / "b", "crystalnet", generator=run / "generator.safetensors", **SMALL)
    refused(["generator of hybrid", "that of crystalnet"], training.train, config)


def test_a_finished_run_is_not_overwritten_and_is_kept_with_resume(trained, data, capsys):
    run, _ = trained
    before = (run / "renderer.safetensors").read_bytes()
    refused(["already holds", "--resume"], training.train, RefractTrainConfig(data, run, "hybrid", **SMALL))
    training.train(RefractTrainConfig(data, run, "hybrid", resume=True, **SMALL))
    assert "finished already, kept" in capsys.readouterr().out
    assert (run / "renderer.safetensors").read_bytes() == before


def test_a_crop_that_the_levels_do_not_divide_is_refused(data, tmp_path):
    refused(["12 x 12", "multiple of 8"], training.train, RefractTrainConfig(data, tmp_path / "r", crop=12))


def test_a_buffer_that_is_not_finite_is_named_with_its_step_and_the_checkpoint_stays(tmp_path):
    data = make_toy_frames(tmp_path / "data", train=3, generator=0)
    rng = np.random.default_rng(0)
    frames = [toy_frame(rng) for _ in range(3)]
    frames[1].depth[5, 6] = np.nan
    card = read_json(data / "card.json")
    shard = next(s for s in card["shards"] if s["split"] == "train")
    shard["sha256"] = write_shard(data / shard["file"], frames)
    write_json(data / "card.json", card)
    config = RefractTrainConfig(data, tmp_path / "run", "ssnrb", steps=9, batch=1, crop=0, checkpoint_minutes=1e-9)
    refused(["depth", "frames 1", "step", "checkpoint is kept"], training.train, config)
    checkpoint = tmp_path / "run" / "generator.checkpoint.safetensors"
    if checkpoint.exists():  # the damaged frame was not the first one drawn
        assert all(torch.isfinite(v).all() for v in m.load_part(checkpoint)[0].values())


def test_a_weight_that_is_not_finite_is_named_and_does_not_replace_the_checkpoint(data, tmp_path, monkeypatch):
    config = RefractTrainConfig(data, tmp_path / "run", "glassnet", **SMALL)
    step = training._step

    def poisoned(state, part, *rest):
        record = step(state, part, *rest)
        if state.step == 4:
            with torch.no_grad():
                state.network.reflection.first.weight[0, 0] = torch.nan
        return record

    monkeypatch.setattr(training, "_step", poisoned)
    refused(["reflection.first.weight", "step 5"], training.train, config)
    weights, _, header = m.load_part(tmp_path / "run" / "renderer.checkpoint.safetensors")
    assert header["step"] == 4
    assert all(torch.isfinite(v).all() for v in weights.values())
