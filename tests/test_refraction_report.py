"""Measures, evaluation and comparison of refraction models on a room of glass balls, and the page with sliders."""

from pathlib import Path

import numpy as np
import pytest
import torch
from refraction_toy import make_toy_frames, toy_frame
from starlette.testclient import TestClient

from catacaustics.config import RefractDataConfig, RefractEvaluateConfig, RefractReportConfig, RefractTrainConfig
from catacaustics.errors import UserError
from catacaustics.files import read_json
from catacaustics.refraction import measures, report
from catacaustics.refraction.data import frame_at, make_frame
from catacaustics.refraction.evaluate import evaluate, measure_speed, render_frame
from catacaustics.refraction.frames import open_frames
from catacaustics.refraction.models import load_model
from catacaustics.refraction.scenes import find_scene, with_ranges
from catacaustics.refraction.train import train
from catacaustics.refraction.variants import VECTORISED, choose_variant
from catacaustics.web.refraction import RefractionView, refraction_app


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A comparison of two models with two seeds, of a second or so each."""
    folder = tmp_path_factory.mktemp("compared")
    data = make_toy_frames(folder / "data")
    config = RefractReportConfig(
        data, folder / "out", models=("glassnet", "hybrid"), seeds=(0, 1), minutes=0.015, shown_frames=1
    )
    return config, report.report(config)


# Measures --------------------------------------------------------------------------------------------------------


def test_t_amp_of_a_constant_error_is_its_square_at_any_size_of_image_and_mask():
    for side, glass in ((16, 16), (32, 8), (32, 20)):
        mask = np.zeros((side, side), bool)
        mask[:glass, :glass] = True
        reference = np.full((side, side, 3), 0.4)
        assert measures.t_amplitude(reference + 0.1, reference, mask) == pytest.approx(0.01, rel=1e-9)
    with pytest.raises(ValueError, match="mask with pixels"):
        measures.t_amplitude(reference, reference, np.zeros((side, side), bool))


def test_t_amp_ignores_a_shift_that_l1_punishes():
    image = np.random.default_rng(0).random((24, 24, 3))
    mask = np.ones((24, 24), bool)
    moved = np.roll(image, 5, 0)
    assert np.abs(moved - image).mean() > 0.2
    assert measures.t_amplitude(moved, image, mask) < 1e-20


def test_measures_of_glass_see_only_glass_and_regions_part_the_pixels_that_land():
    frame = toy_frame(np.random.default_rng(2), 48, 64, placed=[(0.3, 0.3, 0.5), (-0.3, -0.1, 0.5)])
    image = frame.reference.copy()
    image[~frame.refractive] += 0.5
    perfect = np.zeros((48, 48, 3), np.float32)
    row, regions, _ = measures.measure_frame(frame, image, perfect + 0.25, perfect)
    assert row["T.L1"] == 0
    assert row["T.PSNR"] == 100
    assert row["T.Amp"] == 0
    assert row["L1"] > 0.1
    assert row["R.L1"] == pytest.approx(0.25)
    lands = frame.landing_object >= 0
    apart = [regions[name].pixels for name in ("seen", "off screen", "hidden")]
    assert sum(apart) == lands.sum()
    assert min(apart[:2]) > 10
    assert regions["internal reflection"].pixels == (frame.internal_reflection & frame.refractive).sum()
    pooled = measures.pool_regions([regions, regions], True)
    assert pooled["seen"] == {"pixels": 2 * apart[0], "T.L1": 0, "R.L1": pytest.approx(0.25)}


# Evaluation and comparison ---------------------------------------------------------------------------------------


def test_the_comparison_has_every_run_its_means_over_seeds_and_a_page_with_pictures(compared):
    config, result = compared
    assert [(r["model"], r["seed"]) for r in result["runs"]] == [
        (model, seed) for seed in (0, 1) for model in ("glassnet", "hybrid")
    ]
    first, second = (r["mean"]["T.L1"] for r in result["runs"] if r["model"] == "hybrid")
    hybrid = next(row for row in result["means"] if row["model"] == "hybrid")
    assert hybrid["mean"]["T.L1"] == pytest.approx((first + second) / 2)
    assert hybrid["spread"]["T.L1"] == pytest.approx(abs(first - second) / 2)
    assert "R.L1" in hybrid["mean"]
    assert "R.L1" not in result["means"][0]["mean"]
    table = (config.out / "table.md").read_text()
    assert "| glassnet |" in table
    assert "seeds 0, 1" in table
    page = (config.out / "report.html").read_text()
    assert "<svg" in page
    assert page.count("<figcaption>") == 8  # one frame: truth and two models, three rows; glassnet looks nothing up
    assert 'src="http' not in page


def test_finished_trainings_are_kept_and_other_settings_refused(compared, monkeypatch):
    config, result = compared
    monkeypatch.setattr(report, "train", lambda settings: pytest.fail("trained again"))
    again = report.report(config)
    assert again["means"] == result["means"]
    other = RefractReportConfig(config.data, config.out, models=("glassnet",), seeds=(0,), minutes=1.0)
    with pytest.raises(UserError, match=r"minutes = 0\.015"):
        report.report(other)


def test_evaluation_writes_metrics_speed_and_pictures_of_the_split(tmp_path, capsys):
    data = make_toy_frames(tmp_path / "data")
    train(RefractTrainConfig(data, tmp_path / "run", "ssnrb", steps=2, batch=1))
    result = evaluate(RefractEvaluateConfig(tmp_path / "run", split="val", shown_frames=1))
    stored = read_json(tmp_path / "run" / "metrics.json")
    assert stored["mean"] == result["mean"]
    assert {"L1", "PSNR", "SSIM", "T.L1", "T.PSNR", "T.SSIM", "T.Amp", "R.L1"} <= set(result["mean"])
    assert len(stored["frames"]) == 2
    assert stored["speed"]["parameters"] > 100_000
    assert stored["speed"]["ms"] > 0
    assert "orthonormal" in stored["protocol"]["metrics"]["T.Amp"]
    assert (tmp_path / "run" / "report.html").read_text().count("<figcaption>") == 6
    assert "ssnrb" in capsys.readouterr().out


def test_the_memory_of_a_frame_counts_what_is_alive_together(compared):
    config, _ = compared
    frames = open_frames(config.data)
    model = load_model(config.out / "runs" / "glassnet_small_0", frames)
    image = 4 * 32 * 32 * 16  # a layer of the first level
    assert 3 * image < 2**20 * measure_speed(model, frames.split("test"))["memory"] < 60 * image


def test_a_split_without_frames_is_refused(tmp_path):
    data = make_toy_frames(tmp_path / "data", test=0)
    train(RefractTrainConfig(data, tmp_path / "run", "glassnet", steps=1, batch=1))
    with pytest.raises(UserError, match="no test frames"):
        evaluate(RefractEvaluateConfig(tmp_path / "run"))


# Page with sliders -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def client(compared):
    config, _ = compared
    frames = open_frames(config.data)
    model = load_model(config.out / "runs" / "hybrid_small_0", frames)
    asked = []

    def make(share, spp):
        if share[0] > 0.9:
            raise UserError("The camera stands in the wall.", "free space", "move it")
        asked.append((share.tolist(), spp))
        return toy_frame(np.random.default_rng(0), reference=True)

    view = RefractionView(model, frames.card, make)
    return TestClient(refraction_app(view)), asked, model


def test_the_page_gets_its_sliders_and_pictures_of_the_model(client):
    web, asked, model = client
    assert "page.js" in web.get("/").text
    assert web.get("/page.js").status_code == 200
    state = web.get("/api/state").json()
    assert [p["name"] for p in state["parameters"]] == ["light_x", "light_y", "light_z"]
    answer = web.post("/api/render", json={"values": [0.25, 0, -9], "shown": "model"}).json()
    assert asked[-1] == ([0.75, 0.5, 0], 0)
    assert answer["picture"].startswith("data:image/png;base64,")
    with torch.no_grad():
        image = render_frame(model, toy_frame(np.random.default_rng(0))).image
    assert image.shape == (32, 32, 3)
    web.post("/api/render", json={"values": [0, 0, 0], "shown": "path traced"})
    assert asked[-1][1] > 0


def test_a_frame_of_given_parameters_is_the_frame_of_the_data_set_that_drew_them():
    config = RefractDataConfig("checker", Path("unused"), resolution=12, screen=24)
    choose_variant("auto", VECTORISED)
    scene = find_scene("checker")
    drawn = make_frame(scene, config, "generator", 3)
    made = frame_at(scene, drawn.parameters.astype(float), 12, 24)
    assert made.screen.shape == (24, 24, 3)
    assert not made.has_reference
    np.testing.assert_allclose(made.depth, drawn.depth, atol=1e-5)
    moved = np.linalg.norm(made.landing - drawn.landing, axis=-1)
    assert (moved < 1e-3).mean() > 0.95  # the card's float32 tips a path at an edge
    with pytest.raises(UserError, match="camera"):
        frame_at(with_ranges(scene, ["eye.distance=0.7:3"]), np.ones(len(drawn.parameters)), 12, 24)


@pytest.mark.parametrize(
    "body",
    [
        {"values": [0, 0], "shown": "model"},
        {"values": [0, 0, "x"], "shown": "model"},
        {"values": [0, 0, 0], "shown": "everything"},
        {"shown": "model"},
    ],
)
def test_wrong_requests_of_the_page_are_refused(client, body):
    web, _, _ = client
    assert web.post("/api/render", json=body).status_code == 400


def test_a_camera_that_stands_badly_is_told_in_words(client):
    web, _, _ = client
    answer = web.post("/api/render", json={"values": [0.5, 0, 0], "shown": "model"})
    assert answer.status_code == 422
    assert answer.json()["found"] == "The camera stands in the wall."
