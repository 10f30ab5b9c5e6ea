"""Model selection: the rule, and the choice on a capture whose answer is known."""

import json
import shutil
from unittest import mock

import numpy as np
import pytest
from toy import make_toy_capture

from catacaustics.capture.dataset import open_capture
from catacaustics.config import TrainConfig
from catacaustics.errors import UserError
from catacaustics.points import write_ply
from catacaustics.reflectors.volume import ReflectionVolume, build_volume
from catacaustics.training import mirrors, selection
from catacaustics.training.initialize import named_reflectors
from catacaustics.training.selection import LADDER, LEAST_GAIN, Trial, best, choose_models, finalists, gain
from catacaustics.training.train import train


def test_a_more_complex_candidate_wins_only_by_more_than_the_noise():
    base = [20.0, 22.0, 19.0, 25.0]
    assert best([base, [v + 1 for v in base]]) == 1
    assert best([base, [v + LEAST_GAIN / 2 for v in base]]) == 0  # steady, but too little
    assert best([base, [20.0 + 4, 22.0 - 3, 19.0 + 4, 25.0 - 3]]) == 0  # a mean of 0.5 that four views cannot prove
    assert best([base, [v + 1 for v in base], [v + 1.1 for v in base]]) == 1
    assert best([base, [v - 1 for v in base], [v + 3 for v in base]]) == 2


def test_the_finalists_are_the_rules_pick_and_what_is_close_to_it_or_above():
    base = [20.0, 22.0, 19.0, 25.0]
    scores = [[v + d for v in base] for d in (0.0, -0.2, 0.1, -2.0, 0.15)]
    assert best(scores) == 0
    assert finalists(scores, 4) == [0, 1, 2, 4]
    assert finalists(scores, 3) == [0, 2, 4]  # the best ones
    assert finalists([scores[0], scores[3]], 4) == [0]


def test_views_that_do_not_show_a_reflector_do_not_count():
    assert gain([21.0, None, 21.0], [20.0, 5.0, 20.0]) == (pytest.approx(1.0), LEAST_GAIN)
    assert gain([None], [None])[0] == 0


def test_as_many_models_as_reflectors_or_one_for_all():
    nothing = np.zeros((0, 4)), np.zeros((0, 3)), np.zeros((0, 3), int)
    volumes = [ReflectionVolume(name, *nothing) for name in "ab"]
    assert [r.model for r in named_reflectors(volumes, ("plane",))] == ["plane", "plane"]
    assert [r.model for r in named_reflectors(volumes, ("plane", "sphere"))] == ["plane", "sphere"]
    with pytest.raises(UserError, match="3 models are named for 2 reflectors"):
        named_reflectors(volumes, ("plane", "sphere", "none"))


@pytest.fixture(scope="module")
def chosen(tmp_path_factory):
    """A ball of one flat colour needs no reflection that moves."""
    root = tmp_path_factory.mktemp("selection")
    capture = make_toy_capture(root / "capture")
    config = TrainConfig(
        capture, root / "run", iterations=10, image_size=64, environment_width=20, warp_width=16, refine_poses=False
    )
    with mock.patch.object(mirrors, "_SHAPE_STEPS", 3), mock.patch.object(mirrors, "is_turned", return_value=True):
        train(config)
    return config, json.loads((root / "run" / "model_choice.json").read_text())


def test_every_rung_is_tried_and_the_choice_is_kept_with_its_reasons(chosen):
    config, choice = chosen
    assert [t["name"] for t in choice["trials"] if t["question"] == "model" and t["rounds"] == 1] == list(LADDER)
    assert set(choice["taken"]) == {"model", "environment", "reflection points", "primary points", "photographs"} - (
        {"reflection points"} if choice["chosen"]["model"] == ["none"] else set()
    )
    settings = json.loads((config.run / "config.json").read_text())
    assert settings["model"] == choice["chosen"]["model"]
    page = (config.run / "model_choice.html").read_text()
    assert all(rung in page for rung in LADDER)
    assert "standard error" in page
    assert all(np.isfinite(t["whole"]).all() for t in choice["trials"])


def test_a_rung_that_cannot_fit_trains_and_reports_its_score(chosen):
    _, choice = chosen
    plane = next(t for t in choice["trials"] if t["name"] == "plane")
    assert plane["steps"] > 0
    assert all(v is None or np.isfinite(v) for v in plane["inside"][0])


def test_a_choice_once_made_is_not_made_again(chosen, monkeypatch, capsys):
    config, choice = chosen
    (config.run / "scene.safetensors").unlink()
    (config.run / "checkpoint.safetensors").unlink()
    monkeypatch.setattr(mirrors, "is_turned", lambda volume, capture: True)
    train(config)
    assert "model selection: model," not in capsys.readouterr().out
    assert json.loads((config.run / "model_choice.json").read_text()) == choice


def test_a_capture_without_masks_trains_the_primary_cloud_alone(tmp_path, capsys):
    capture = make_toy_capture(tmp_path / "capture", masks=False)
    scene = train(TrainConfig(capture, tmp_path / "run", iterations=4, image_size=64, environment_width=20))
    assert "no reflector" in capsys.readouterr().out
    assert len(scene.reflections) == 0


@pytest.fixture
def choose(tmp_path, monkeypatch):
    """Chooses models for the toy by trials that score as a function of name and rounds tells, without training.
    Returns the configuration chosen, and the trials as (name, rounds)."""
    capture = open_capture(make_toy_capture(tmp_path / "capture"))

    def choose(score, **settings):
        tried = []

        def run(trials, name, question, changes, rounds=1):
            tried.append((name, rounds))
            scores = [score(name, rounds)] * 2
            trials.done.append(Trial(name, question, changes, rounds, 1.0, 80, 100, 10, [scores], scores))
            return trials.done[-1]

        monkeypatch.setattr(selection._Trials, "run", run)
        config = TrainConfig(capture.root, tmp_path / "run", minutes=4.0, **settings)
        config.run.mkdir()
        return choose_models(capture, [build_volume(capture, name) for name in capture.reflectors], config), tried

    return choose


def test_a_short_training_does_not_try_networks_and_says_so(choose, capsys):
    chosen, tried = choose(lambda name, _: 30.0 if name == "sphere" else 20.0)
    assert chosen.model == ("sphere",)
    assert ("plane", 1) in tried
    assert not {"neural", "quadric+neural"} & {name for name, _ in tried}
    said, page = capsys.readouterr().out, (chosen.run / "model_choice.html").read_text()
    for network in ("neural", "quadric+neural"):
        assert f"{network} is not tried for ball: takes more than 30 minutes" in said
        assert f"{network} (takes more than 30 minutes)" in page


def test_a_flat_reflector_is_no_ball_and_the_ellipsoid_of_a_bent_sheet_has_no_rival_in_it(choose, monkeypatch):
    monkeypatch.setattr(mirrors, "fit_bent_sheet", lambda volume: ["a cylinder"])
    chosen, tried = choose(lambda name, _: {"sphere": 25.0, "ellipsoid": 24.0}.get(name, 20.0))
    assert not {"sphere", "revolution"} & {name for name, _ in tried}
    assert chosen.model == ("ellipsoid",)


def test_a_surface_of_revolution_is_tried_only_where_the_masks_show_one(choose, capsys, monkeypatch):
    chosen, tried = choose(lambda *_: 20.0)
    assert "revolution" not in {name for name, _ in tried}
    assert "revolution is not tried for ball: the masks show an ellipsoid" in capsys.readouterr().out
    shutil.rmtree(chosen.run)
    monkeypatch.setattr(mirrors, "is_turned", lambda volume, capture: True)
    chosen, tried = choose(lambda name, _: 25.0 if name == "revolution" else 20.0)
    assert ("revolution", 1) in tried
    assert chosen.model == ("revolution",)


@pytest.mark.parametrize("gain", [-1.0, 0.1, 1.0])
def test_guesses_of_stereo_are_taken_only_where_a_trial_gains_by_them(choose, tmp_path, gain):
    points = open_capture(tmp_path / "capture").points()
    write_ply(tmp_path / "capture" / "guesses.ply", points)
    chosen, tried = choose(lambda name, _: 20.0 + gain * (name == "guesses too"))
    assert ("guesses too", 1) in tried
    assert chosen.guesses == (gain == 1.0)


def test_a_capture_without_guesses_or_a_user_who_decided_needs_no_trial_of_them(choose):
    chosen, tried = choose(lambda *_: 20.0)
    assert "guesses too" not in {name for name, _ in tried}
    assert not chosen.guesses


@pytest.mark.parametrize(("minutes", "steps"), [(2.0, 50), (15.0, 125), (30.0, 250), (None, 250)])
def test_trials_are_as_long_as_the_training_can_afford(tmp_path, minutes, steps):
    capture = open_capture(make_toy_capture(tmp_path / "capture"))
    config = TrainConfig(capture.root, tmp_path / "run", minutes=minutes)
    assert selection._Trials(capture, [], config).config.iterations == steps


def test_a_lead_that_only_a_longer_trial_shows_decides(choose):
    chosen, tried = choose(
        lambda name, rounds: {"none": 20.0, "concave": 20.1 + 0.2 * (rounds - 1)}.get(name, 18.0), environment_width=0
    )
    assert chosen.model == ("concave",)
    assert [t for t in tried if t[1] > 1] == [("none", 2), ("concave", 2), ("none", 4), ("concave", 4)]


def test_a_finalist_goes_on_from_where_its_trial_ended(chosen):
    _, choice = chosen
    longer = [t for t in choice["trials"] if t["rounds"] > 1]
    assert longer  # on a ball of one flat colour the rungs are close to each other
    assert all(t["steps"] == t["rounds"] * 10 for t in longer)
    assert {t["rounds"] for t in longer} <= {2, 4}
