"""Held-out evaluation: known errors, masks, the report, and what is missing."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from stand_in import StandInScene, make_run
from toy import ball_mask

from catacaustics import evaluation
from catacaustics.config import EvaluateConfig, TrainConfig
from catacaustics.errors import UserError
from catacaustics.evaluation import evaluate, format_table, reflector_mask
from catacaustics.reflectors.volume import build_volume
from catacaustics.report import definitions_html
from catacaustics.run import open_run, read_log
from catacaustics.scene import Scene
from catacaustics.training.initialize import Reflector, initial_scene, primary_seeds, reflection_seeds, start_warps


@pytest.fixture(scope="module")
def volume(capture):
    return build_volume(capture, "ball")


@pytest.fixture
def run(capture, tmp_path):
    return make_run(tmp_path / "run", capture)


def evaluate_stand_in(monkeypatch, scene, run, **options):
    monkeypatch.setattr(Scene, "load", lambda *_: scene)
    return evaluate(EvaluateConfig(run, **options))


def test_a_render_that_is_off_by_two_hundredths_measures_as_that(capture, run, monkeypatch, capsys):
    result = evaluate_stand_in(monkeypatch, StandInScene(capture, -0.02), run)
    expected = -20 * np.log10(0.02)
    for view in result["views"]:
        assert view["inside"]["psnr"] == pytest.approx(expected, abs=0.05)
        assert view["whole"]["psnr"] == pytest.approx(expected, abs=0.6)  # black pixels are clamped
    for area in ("whole", "inside"):
        for key in ("psnr", "ssim", "flip"):
            mean = np.mean([view[area][key] for view in result["views"]])
            assert result["mean"][area][key] == pytest.approx(mean)
    assert json.loads((run / "metrics.json").read_text()) == result
    assert [view["name"] for view in result["views"]] == [view.name for view in capture.held_out]
    assert f"{result['mean']['inside']['psnr']:.2f} dB" in capsys.readouterr().out


def test_a_perfect_render_has_finite_metrics(capture, run, monkeypatch):
    result = evaluate_stand_in(monkeypatch, StandInScene(capture), run)
    assert result["mean"]["whole"]["psnr"] == 100
    assert "Infinity" not in (run / "metrics.json").read_text()


def test_views_are_measured_at_the_training_resolution(capture, tmp_path, monkeypatch):
    run = make_run(tmp_path / "small", capture, image_size=32)
    result = evaluate_stand_in(monkeypatch, StandInScene(capture), run)
    assert {(view["width"], view["height"]) for view in result["views"]} == {(32, 24)}
    assert result["protocol"]["resolution"] == ["32 x 24"]
    assert "area" in result["protocol"]["resize_filter"]


def test_the_protocol_names_everything_that_the_numbers_depend_on(capture, run, monkeypatch):
    protocol = evaluate_stand_in(monkeypatch, StandInScene(capture), run)["protocol"]
    assert protocol["split"] == {"train": 8, "held_out": 2}
    assert protocol["masks"] == {"painted": 2}
    assert set(protocol["versions"]) == {"catacaustics", "torch", "torchmetrics", "flip-evaluator"}
    assert "unknown" not in protocol["versions"].values()
    assert set(protocol["metrics"]) >= {"psnr", "ssim", "flip", "lpips", "inside", "mean"}
    assert protocol["seconds_per_frame"] >= 0
    assert protocol["device"]


# Masks


def test_the_painted_mask_goes_before_the_projected_volume(capture, volume):
    view = capture.held_out[0]
    scene = StandInScene(capture, volumes=(volume,))
    mask, source = reflector_mask(scene.volumes, capture, view, view.camera)
    assert source == "painted"
    np.testing.assert_array_equal(mask, ball_mask(view.camera))


def test_a_view_without_a_painted_mask_takes_the_projected_volume(capture, volume, monkeypatch):
    view = capture.held_out[0]
    monkeypatch.setattr(type(capture), "mask", lambda *_: None)
    mask, source = reflector_mask([volume], capture, view, view.camera)
    assert source == "projected"
    assert mask[ball_mask(view.camera)].all()  # the volume errs on the large side


def test_the_mask_is_the_union_of_all_reflectors(capture, volume):
    view = capture.held_out[0]
    other = replace(volume, name="other", halfspaces=volume.halfspaces, vertices=volume.vertices)
    mask, source = reflector_mask([volume, other], capture, view, view.camera)
    assert source == "both"
    np.testing.assert_array_equal(mask, ball_mask(view.camera) | other.project_mask(view.camera))


def test_a_scene_without_reflectors_is_measured_as_a_whole_only(capture, run, monkeypatch, capsys):
    bare = replace(capture, reflectors=[])
    monkeypatch.setattr("catacaustics.run.open_capture", lambda _: bare)
    result = evaluate_stand_in(monkeypatch, StandInScene(bare), run)
    assert result["mean"]["inside"] is None
    assert "inside" not in capsys.readouterr().out
    assert "–" in (run / "report.html").read_text()


# The report


class Page(HTMLParser):
    """Collects elements, and checks that they are closed in order."""

    def __init__(self, text: str):
        super().__init__()
        self.elements, self.stack, self.text = [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag not in ("img", "meta", "input", "br"):
            self.stack.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.text += data


def write_log(run, extra=""):
    rows = [
        {"step": i, "seconds": 0.5 * i, "stage": i // 50, "loss": 1 / i, "psnr": 10 + i / 10}
        | {"primary_points": 1000 * i, "reflection_points": 500}
        for i in range(1, 101)
    ]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + extra)


def test_the_report_is_one_file_that_needs_no_network(capture, run, monkeypatch):
    write_log(run)
    evaluate_stand_in(monkeypatch, StandInScene(capture), run)
    text = (run / "report.html").read_text()
    page = Page(text)
    assert page.stack == []
    sources = [a[key] for _, a in page.elements for key in ("src", "href") if key in a]
    assert all(s.startswith("data:image/jpeg;base64,") or s == "metrics.json" for s in sources)
    namespaces = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert set(re.findall(r"https?://[^\"'\s)]*", text)) <= namespaces
    assert "@import" not in text
    assert sum(tag == "svg" for tag, _ in page.elements) == 3
    for words in ("training time (s)", "PSNR (dB)", "inside the reflector", "INTER_AREA", "image_size"):
        assert words in page.text


def test_the_report_shows_photograph_render_error_and_layers_of_every_view(capture, run, monkeypatch):
    evaluate_stand_in(monkeypatch, StandInScene(capture), run)
    page = Page((run / "report.html").read_text())
    captions = [a["alt"] for tag, a in page.elements if tag == "img" and a.get("alt")]
    one = ["Photograph", "Render", "Error (FLIP, reflector outlined)", "Primary", "Reflection", "Reflection weight"]
    assert captions == [*one, "Depth"] * 2


def test_a_report_of_few_views_shows_an_even_spread_and_lists_all(capture, run, monkeypatch):
    many = replace(capture, held_out=capture.views[:7])
    monkeypatch.setattr("catacaustics.run.open_capture", lambda _: many)
    evaluate_stand_in(monkeypatch, StandInScene(many), run, shown_views=3)
    text = (run / "report.html").read_text()
    assert re.findall(r"<h3>([^<]*)</h3>", text) == [many.held_out[i].name for i in (0, 3, 6)]
    assert len(re.findall(r'<tr><th scope="row">view_\d+\.png</th>', text)) == 7


def test_settings_are_listed_as_people_write_them():
    settings = {"minutes": 3.1921017394334434, "model": ["sphere", "plane"], "view": False, "points": None, "seed": 0}
    written = re.findall("<dd>(.*?)</dd>", definitions_html(settings | {"rate": 1.6e-05}))
    assert written == ["3.1921", "sphere, plane", "no", "not set", "0", "1.6e-05"]


def test_names_in_the_report_are_escaped(capture, tmp_path, monkeypatch):
    run = make_run(tmp_path / "a<b>&c", capture)
    evaluate_stand_in(monkeypatch, StandInScene(capture), run)
    text = (run / "report.html").read_text()
    assert "a&lt;b&gt;&amp;c" in text
    assert "a<b>" not in text


def test_the_report_links_the_captures_report_and_notes_beside_it(capture, run, monkeypatch):
    (capture.root / "report.html").write_text("")
    (run / "notes.md").write_text("")
    evaluate_stand_in(monkeypatch, StandInScene(capture), run)
    (capture.root / "report.html").unlink()
    links = [a["href"] for tag, a in Page((run / "report.html").read_text()).elements if tag == "a"]
    assert links[1:] == ["metrics.json", "notes.md"]
    assert not links[0].startswith("/")
    assert (run / links[0]).resolve() == (capture.root / "report.html").resolve()


def test_a_run_without_a_log_has_a_report_that_says_so(capture, run, monkeypatch):
    evaluate_stand_in(monkeypatch, StandInScene(capture), run)
    assert "holds no training log" in (run / "report.html").read_text()


def test_unreadable_log_lines_are_skipped_and_counted(capture, run, monkeypatch):
    write_log(run, '{"step": 101, "secon\n[1]\n{"step": 3}\n\n')
    rows, skipped = read_log(run)
    assert (len(rows), skipped) == (100, 3)
    evaluate_stand_in(monkeypatch, StandInScene(capture), run)
    assert "3 unreadable lines" in (run / "report.html").read_text()


def test_a_log_with_gaps_and_no_numbers_still_makes_curves(capture, run, monkeypatch):
    rows = [{"seconds": i, "loss": None if i % 2 else 0.0, "psnr": float("nan")} for i in range(20)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    evaluate_stand_in(monkeypatch, StandInScene(capture), run)
    assert (run / "report.html").read_text().count("<svg") == 3


# What may be missing


def test_an_unfinished_run_says_how_to_go_on(capture, run):
    (run / "scene.safetensors").rename(run / "checkpoint.safetensors")
    with pytest.raises(UserError, match="--resume"):
        evaluate(EvaluateConfig(run))


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"There is no scene .*scene\.safetensors"):
        evaluate(EvaluateConfig(tmp_path))


def test_a_capture_that_moved_is_named_and_can_be_given(capture, tmp_path, monkeypatch):
    run = make_run(tmp_path / "moved", capture)
    old = tmp_path / "old-place"
    config = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps(config | {"capture": str(old)}))
    with pytest.raises(UserError, match=f"{old}(.|\n)*--capture"):
        evaluate(EvaluateConfig(run))
    result = evaluate_stand_in(monkeypatch, StandInScene(capture), run, capture=capture.root)
    assert len(result["views"]) == 2


def test_a_damaged_config_is_refused_by_name(capture, run):
    (run / "config.json").write_text('{"capture": "x"}')
    with pytest.raises(UserError, match=r"config\.json does not tell"):
        evaluate(EvaluateConfig(run))


def test_a_capture_without_held_out_views_is_refused(capture, run, monkeypatch):
    monkeypatch.setattr("catacaustics.run.open_capture", lambda _: replace(capture, held_out=[]))
    with pytest.raises(UserError, match="holds out no views"):
        evaluate_stand_in(monkeypatch, StandInScene(capture), run)


def test_a_render_that_is_not_finite_is_refused_by_the_views_name(capture, run, monkeypatch):
    with pytest.raises(UserError, match="view_08"):
        evaluate_stand_in(monkeypatch, StandInScene(capture, float("nan")), run)


def test_an_interrupted_evaluation_leaves_the_last_one_intact(capture, run, monkeypatch):
    evaluate_stand_in(monkeypatch, StandInScene(capture), run)
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    with pytest.raises(KeyboardInterrupt):
        evaluate_stand_in(monkeypatch, StandInScene(capture, 0.1, stop_after=1), run)
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before


def test_a_scene_from_its_file_is_evaluated_as_it_was_saved(capture, volume, tmp_path):
    config = TrainConfig(capture.root, tmp_path / "run", primary_points=500, reflection_points=50, environment_width=20)
    rng = np.random.default_rng(0)
    reflector = Reflector(volume, "sphere")
    warps = start_warps(capture, [reflector], config)
    seeds = [
        primary_seeds(capture, [reflector], config.primary_points, rng),
        reflection_seeds(capture, volume, warps[0], config.reflection_points, rng),
    ]
    scene = initial_scene(capture, [volume], warps, seeds, 1.0, config)
    run = make_run(tmp_path / "run", capture)
    scene.save(run / "scene.safetensors")
    result = evaluate(EvaluateConfig(run, device="cpu"))
    expected = evaluation.evaluate_run(open_run(run)._replace(scene=scene))
    assert result["mean"] == expected["mean"]


def test_the_printed_table_has_a_line_an_area():
    mean = {"whole": {"psnr": 20.0, "ssim": 0.5, "flip": 0.25}, "inside": {"psnr": 9.5, "ssim": 0.75, "flip": 0.125}}
    assert format_table({"mean": mean, "views": [1, 2, 3]}).splitlines() == [
        "held-out views: 3          PSNR     SSIM     FLIP",
        "whole image            20.00 dB   0.5000   0.2500",
        "inside the reflector    9.50 dB   0.7500   0.1250",
    ]
